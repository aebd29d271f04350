r"""Positions that vertices would have if they had moved with the body: their origins for the collision refinement.

    V' = U + q̄ + D (V - U + l n),    U = c + |d| v̄,    n = -sign(d) v̄

where c is the centroid of one face at the vertex, and d, v̄, D, q̄ are the features of that face (face.py): U is the
nearest point of the body, n the outward direction there, D and q̄ the motion of the nearest body face. No query is
needed, as the features of the frame have been computed already. Collision refinement follows a vertex from V' to its
predicted position to find the face by which it entered. Every vertex is first lifted by l along n: from a position
slightly inside, the first surface on the way would be the far one.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, expect, launch, torch_stream
from warpgarment.kernels.operator import allocate

from .channels import FEATURES, LAYOUT

wp.set_module_options(compiling.options())

LIFT = wp.constant(0.005)
"""l [m], more than the depth of almost all vertices after a refinement."""
DISTANCE = wp.constant(LAYOUT["signed_distance"].start)
DIRECTION = wp.constant(LAYOUT["direction_to_body"].start)
DEFORMATION = wp.constant(LAYOUT["body_deformation"].start)
VELOCITY = wp.constant(LAYOUT["body_velocity"].start)


@wp.func
def three(features: wp.array2d[wp.float32], i: int, first: int):
    return wp.vec3(features[i, first], features[i, first + 1], features[i, first + 2])


@wp.kernel(enable_backward=False)
def carried_kernel(
    # Model:
    faces: wp.array[wp.vec3i],
    face_of_vertex: wp.array[wp.int32],
    # In:
    vertices: wp.array[wp.vec3],
    features: wp.array2d[wp.float32],
    # Out:
    carried: wp.array[wp.vec3],
):
    i = wp.tid()
    f = face_of_vertex[i]
    if f < 0:
        carried[i] = wp.vec3(wp.nan)
        return
    corner = faces[f]
    centroid = (vertices[corner[0]] + vertices[corner[1]] + vertices[corner[2]]) / 3.0
    distance = features[f, DISTANCE]
    direction = three(features, f, DIRECTION)
    point = centroid + wp.abs(distance) * direction
    away = vertices[i] - point - wp.sign(distance) * LIFT * direction
    turned = wp.vec3(
        wp.dot(three(features, f, DEFORMATION), away),
        wp.dot(three(features, f, DEFORMATION + 3), away),
        wp.dot(three(features, f, DEFORMATION + 6), away),
    )
    carried[i] = point + three(features, f, VELOCITY) + turned


def face_at_each_vertex(faces: torch.Tensor, vertex_count: int) -> torch.Tensor:
    """The face of lowest index at each vertex, -1 for a vertex without faces; [F,3] -> int32 [V]."""
    numbers = torch.arange(len(faces), dtype=torch.int32, device=faces.device).repeat_interleave(3)
    found = torch.full((vertex_count,), len(faces), dtype=torch.int32, device=faces.device)
    found = found.scatter_reduce(0, faces.reshape(-1).long(), numbers, "amin")
    return torch.where(found < len(faces), found, -1)


def carried(
    vertices: torch.Tensor, faces: torch.Tensor, face_of_vertex: torch.Tensor, features: torch.Tensor
) -> torch.Tensor:
    """Moves vertices of frame t, lifted by `LIFT`, with the body to frame t+1; without gradients.

    Args:
        vertices: Positions in frame t [m], float32 [V,3].
        faces: Vertex indices, int32 [F,3].
        face_of_vertex: A face at each vertex, int32 [V], see `face_at_each_vertex`.
        features: Features of frame t, float32 [F,34].

    Returns:
        Positions [m], float32 [V,3]; NaN at vertices without faces.
    """
    device = vertices.device
    expect("vertices", vertices, (None, 3))
    expect("faces", faces, (None, 3), torch.int32, device)
    expect("face_of_vertex", face_of_vertex, (len(vertices),), torch.int32, device)
    expect("features", features, (len(faces), FEATURES), device=device)
    result = allocate(vertices.shape, torch.float32, device)
    with torch_stream(device) as warp_device:
        launch(
            carried_kernel,
            len(vertices),
            [
                as_argument(faces, wp.vec3i),
                as_argument(face_of_vertex, wp.int32),
                as_argument(vertices.detach(), wp.vec3),
                as_argument(features.detach(), wp.float32),
                as_argument(result, wp.vec3),
            ],
            warp_device,
        )
    return result
