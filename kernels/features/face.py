"""Features of a face for the network: 34 numbers per face and frame.

They are computed in two launches: the result of `body_interaction` can be stored, and `face_features` has gradients.
`frame.frame_features` does both in one launch, for all faces of all garments on all bodies, with the same result.

Manifold-aware transformers, section 4.2; the order is that of f_i in section 4.3.

    f_i = (Φ_i, n_i, c_i − z, d_i, v̄_i, D_i, q̄_i, Σ_i)

    | paper | code                 | what                                                              |
    | ----- | -------------------- | ----------------------------------------------------------------- |
    | Φ     | deformation_gradient | from the rest pose, row-major                                     |
    | n     | normal               | unit normal                                                       |
    | c − z | centroid             | of the face, minus z, the mean centroid of the garment [m]        |
    | d     | signed_distance      | of the centroid to the body [m]                                   |
    | v̄     | direction_to_body    | unit vector from the centroid to the nearest body point           |
    | D     | body_deformation     | of the nearest body face from t to t+1, Q_next Q⁻¹ (there: d_i)   |
    | q̄     | body_velocity        | displacement of that face's centroid from t to t+1 [m per frame]  |
    | Σ     | singular_values      | of Φ, descending                                                  |
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.deformation.gradients import corners_exist, expect_mesh, face_frame
from warpgarment.kernels.deformation.svd import frame_singular_values
from warpgarment.kernels.launch import as_argument, expect, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate, row_operator
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.closest import MAX_DISTANCE, closest_on_body
from warpgarment.kernels.sdf.model import Bodies, exists

from .channels import FEATURES, LAYOUT

wp.set_module_options(compiling.options())

AT = {name: place.start for name, place in LAYOUT.items()}
TOUCHING = wp.constant(1.0e-9)  # metres; closer points have no direction to the body
# Least ratio of height to longest edge of a body face; the motion of thinner faces is mostly rounding
SLIVER = wp.constant(wp.float64(1.0e-4))


class BodyInteraction(NamedTuple):
    """The nearest point of the body and its motion for each garment face; also usable for slightly displaced garments.

    If no body point was found (see `BodyQuery`), closest is NaN, sign is +1, face is -1, deformation is the identity,
    and velocity is zero.
    """

    closest: torch.Tensor
    """Nearest surface point [m], float32 [F, 3]."""
    sign: torch.Tensor
    """+1 outside, -1 inside, float32 [F]."""
    face: torch.Tensor
    """Packed index of the nearest body face, int32 [F]."""
    deformation: torch.Tensor
    """Deformation gradient of that face from t to t+1, float32 [F, 3, 3]; the identity if the face has no area."""
    velocity: torch.Tensor
    """Displacement of that face's centroid from t to t+1 [m per frame], float32 [F, 3]."""


@wp.func
def has_area(area: wp.vec3d, e1: wp.vec3d, e2: wp.vec3d) -> bool:
    """Whether a triangle with these edges and their cross product is finite and no sliver."""
    return wp.length(area) > SLIVER * wp.max(wp.dot(e1, e1), wp.dot(e2, e2))


@wp.func
def motion_of(a0: wp.vec3, a1: wp.vec3, a2: wp.vec3, b0: wp.vec3, b1: wp.vec3, b2: wp.vec3) -> wp.mat33:
    """D = Q_next Q⁻¹ of a triangle a that moves to b, Q = [e1, e2, n], in float64; the identity for slivers.

    The rows of Q⁻¹ are e2 × m / m², m × e1 / m² and n, with m = e1 × e2 and n = m / |m|.
    """
    e1 = wp.vec3d(a1) - wp.vec3d(a0)
    e2 = wp.vec3d(a2) - wp.vec3d(a0)
    f1 = wp.vec3d(b1) - wp.vec3d(b0)
    f2 = wp.vec3d(b2) - wp.vec3d(b0)
    area = wp.cross(e1, e2)
    next_area = wp.cross(f1, f2)
    if not (has_area(area, e1, e2) and has_area(next_area, f1, f2)):
        return wp.identity(n=3, dtype=wp.float32)
    square = wp.dot(area, area)
    turned = next_area / wp.sqrt(square * wp.dot(next_area, next_area))
    rows = wp.outer(f1, wp.cross(e2, area) / square) + wp.outer(f2, wp.cross(area, e1) / square)
    return wp.mat33(rows + wp.outer(turned, area))


@wp.func
def nearest_motion(bodies: wp.array[Bodies], b: int, point: wp.vec3, next_vertices: wp.array[wp.vec3]):
    """The fields of `BodyInteraction` of one point."""
    closest = wp.vec3(wp.nan)
    sign = wp.float32(1.0)
    face = wp.int32(-1)
    deformation = wp.identity(n=3, dtype=wp.float32)
    velocity = wp.vec3(0.0)
    if exists(bodies, b):
        found, side, _weights, position = closest_on_body(bodies, b, point, MAX_DISTANCE)
        if found >= 0:
            closest = wp.vec3(position)
            sign = side
            face = found + bodies[0].face_offsets[b]
            corner = bodies[0].faces[face]
            at = bodies[0].vertices
            a0, a1, a2 = at[corner[0]], at[corner[1]], at[corner[2]]
            b0, b1, b2 = next_vertices[corner[0]], next_vertices[corner[1]], next_vertices[corner[2]]
            velocity = ((b0 - a0) + (b1 - a1) + (b2 - a2)) / 3.0
            deformation = motion_of(a0, a1, a2, b0, b1, b2)
    return closest, sign, face, deformation, velocity


@wp.kernel(enable_backward=False)
def body_interaction_kernel(
    from_row: wp.int32,
    # Model:
    bodies: wp.array[Bodies],
    # In:
    centroids: wp.array[wp.vec3],
    body_of_face: wp.array[wp.int32],
    next_vertices: wp.array[wp.vec3],
    # Out:
    closest: wp.array[wp.vec3],
    sign: wp.array[wp.float32],
    face: wp.array[wp.int32],
    deformation: wp.array[wp.mat33],
    velocity: wp.array[wp.vec3],
):
    i = from_row + wp.tid()
    c, s, f, d, v = nearest_motion(bodies, body_of_face[i], centroids[i], next_vertices)
    closest[i] = c
    sign[i] = s
    face[i] = f
    deformation[i] = d
    velocity[i] = v


@wp.func
def face_and_mean(
    i: int,
    faces: wp.array[wp.vec3i],
    garment_of_face: wp.array[wp.int32],
    vertices: wp.array[wp.vec3],
    garment_mean: wp.array[wp.vec3],
    features: wp.array2d[wp.float32],
):
    """Corners of face i and its garment's mean, and whether all of them exist; if not, the features become NaN."""
    face = faces[i]
    garment = garment_of_face[i]
    exist = corners_exist(face, vertices.shape[0]) and garment >= 0 and garment < garment_mean.shape[0]
    a = wp.vec3(0.0)
    b = wp.vec3(0.0)
    c = wp.vec3(0.0)
    mean = wp.vec3(0.0)
    if exist:
        a = vertices[face[0]]
        b = vertices[face[1]]
        c = vertices[face[2]]
        mean = garment_mean[garment]
    else:
        for k in range(wp.static(FEATURES)):
            features[i, k] = wp.nan
    return exist, a, b, c, mean


@wp.func
def write_features(
    features: wp.array2d[wp.float32],
    i: int,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    inverse_rest: wp.mat33,
    mean: wp.vec3,
    closest: wp.vec3,
    sign: float,
    body_deformation: wp.mat33,
    body_velocity: wp.vec3,
):
    """Row i of the features, for the face with corners a, b, c."""
    q = face_frame(a, b, c)
    phi = q * inverse_rest
    s = frame_singular_values(q, inverse_rest)
    z = (a + b + c) / 3.0

    to_body = closest - z
    distance = wp.length(to_body)
    direction = wp.vec3(0.0)
    if not distance < TOUCHING:
        direction = to_body / distance

    for row in range(3):
        for column in range(3):
            k = 3 * row + column
            features[i, wp.static(AT["deformation_gradient"]) + k] = phi[row, column]
            features[i, wp.static(AT["body_deformation"]) + k] = body_deformation[row, column]
        features[i, wp.static(AT["normal"]) + row] = q[row, 2]
        features[i, wp.static(AT["centroid"]) + row] = z[row] - mean[row]
        features[i, wp.static(AT["direction_to_body"]) + row] = direction[row]
        features[i, wp.static(AT["body_velocity"]) + row] = body_velocity[row]
        features[i, wp.static(AT["singular_values"]) + row] = s[row]
    features[i, wp.static(AT["signed_distance"])] = sign * distance


@wp.kernel
def face_features_kernel(
    # In:
    inverse_rest: wp.array[wp.mat33],
    vertices: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    garment_of_face: wp.array[wp.int32],
    garment_mean: wp.array[wp.vec3],
    closest: wp.array[wp.vec3],
    sign: wp.array[wp.float32],
    body_deformation: wp.array[wp.mat33],
    body_velocity: wp.array[wp.vec3],
    # Out:
    features: wp.array2d[wp.float32],
):
    i = wp.tid()
    exist, a, b, c, mean = face_and_mean(i, faces, garment_of_face, vertices, garment_mean, features)
    if not exist:
        return
    write_features(
        features, i, a, b, c, inverse_rest[i], mean, closest[i], sign[i], body_deformation[i], body_velocity[i]
    )


_face_features = row_operator(
    "face_features",
    face_features_kernel,
    {
        "inverse_rest": wp.mat33,
        "vertices": wp.vec3,
        "faces": wp.vec3i,
        "garment_of_face": wp.int32,
        "garment_mean": wp.vec3,
        "closest": wp.vec3,
        "sign": wp.float32,
        "body_deformation": wp.mat33,
        "body_velocity": wp.vec3,
    },
    {"features": (wp.float32, (FEATURES,))},
    rows="faces",
    gradients=["vertices", "garment_mean"],
    owner="garment_of_face",
    shared=["vertices", "garment_mean"],
)


def body_interaction(
    centroids: torch.Tensor, body_of_face: torch.Tensor | None, bodies: BodyMeshes, next_vertices: torch.Tensor
) -> BodyInteraction:
    """The nearest body point of each garment face, and the motion of the body face there from t to t+1.

    Args:
        centroids: Centroids of the garment's faces [m], float32 [F, 3].
        body_of_face: Body of each garment face, int32 [F]; None if there is one body.
        bodies: The bodies at time t.
        next_vertices: Vertices of the bodies at t+1 [m], float32 [U, 3].

    Returns:
        The interactions, without gradients.
    """
    expect("centroids", centroids, (None, 3), device=bodies.device)
    expect("next_vertices", next_vertices, tuple(bodies.vertices.shape), device=bodies.device)
    body_of_face = bodies.body_of("body_of_face", body_of_face, len(centroids))
    centroids, next_vertices = centroids.detach(), next_vertices.detach()
    rows, device = len(centroids), bodies.device
    found = BodyInteraction(
        closest=allocate((rows, 3), torch.float32, device),
        sign=allocate((rows,), torch.float32, device),
        face=allocate((rows,), torch.int32, device),
        deformation=allocate((rows, 3, 3), torch.float32, device),
        velocity=allocate((rows, 3), torch.float32, device),
    )
    kinds = wp.vec3, wp.float32, wp.int32, wp.mat33, wp.vec3
    if rows:
        with torch_stream(device) as warp_device:
            launch_rows(
                body_interaction_kernel,
                rows,
                inputs=[
                    bodies.argument,
                    as_argument(centroids, wp.vec3),
                    as_argument(body_of_face, wp.int32),
                    as_argument(next_vertices, wp.vec3),
                ],
                outputs=[as_argument(tensor, kind) for tensor, kind in zip(found, kinds, strict=True)],
                device=warp_device,
            )
    return found


def face_features(
    inverse_rest: torch.Tensor,
    vertices: torch.Tensor,
    faces: torch.Tensor,
    garment_of_face: torch.Tensor,
    garment_mean: torch.Tensor,
    interaction: BodyInteraction,
) -> torch.Tensor:
    """Features of one frame, not normalised.

    Distance and direction are computed from the given positions and `interaction.closest`, so an interaction can also
    be used for a slightly displaced garment.

    Args:
        inverse_rest: Result of `deformation.inverse_rest_frames`, float32 [F, 3, 3].
        vertices: Garment positions [m], float32 [V, 3].
        faces: Vertex indices, int32 [F, 3].
        garment_of_face: Garment of each face, int32 [F].
        garment_mean: Mean of the face centroids of each garment [m], float32 [B, 3].
        interaction: Result of `body_interaction`.

    Returns:
        Features, float32 [F, 34]; columns as in `LAYOUT` (channels.py). Differentiable in vertices and garment_mean.
    """
    expect_mesh(vertices, faces)
    rows, device = faces.shape[0], vertices.device
    expect("inverse_rest", inverse_rest, (rows, 3, 3), device=device)
    expect("garment_of_face", garment_of_face, (rows,), torch.int32, device)
    expect("garment_mean", garment_mean, (None, 3), device=device)
    expect("interaction.closest", interaction.closest, (rows, 3), device=device)
    expect("interaction.sign", interaction.sign, (rows,), device=device)
    expect("interaction.deformation", interaction.deformation, (rows, 3, 3), device=device)
    expect("interaction.velocity", interaction.velocity, (rows, 3), device=device)
    return _face_features(
        inverse_rest,
        vertices,
        faces,
        garment_of_face,
        garment_mean,
        interaction.closest,
        interaction.sign,
        interaction.deformation,
        interaction.velocity,
    )
