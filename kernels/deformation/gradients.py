"""Deformation gradients of triangles: how a face stretches, shears and turns from the rest pose.

Manifold-aware transformers, supplement 1.1 and 1.2 (after Sumner and Popović 2004).

    Q = [e1, e2, n],  e1 = v1 − v0,  e2 = v2 − v0,  n = e1 × e2 / |e1 × e2|
    Φ = Q Q_rest⁻¹,   Ψ = Φ_next Φ⁻¹

    | paper  | code                          | what                                          |
    | ------ | ----------------------------- | --------------------------------------------- |
    | V, T^g | vertices, faces               | packed: all meshes of a batch lie end to end   |
    | Q      | face_frame                    | columns e1, e2 (metres) and the unit normal n |
    | Φ      | deformation_gradient          | against the rest pose                         |
    | Ψ      | relative_deformation_gradient | from one frame to the next                    |
    | c      | centroid                      | mean of a face's corners                      |

Φ maps unit normals to unit normals, so one of its singular values is always 1. A face without area has no normal: its
n, and with it one column of Q, is zero. A face with an index out of range gives NaN, and no memory is read for it.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import expect
from warpgarment.kernels.operator import row_operator

wp.set_module_options(compiling.options())
_AT_REST = compiling.apart(f"{__name__}.rest")


@wp.func
def corners_exist(face: wp.vec3i, count: int):
    """Whether all three indices lie within [0, count)."""
    return wp.min(face) >= 0 and wp.max(face) < count


@wp.func
def face_frame(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Q = [e1, e2, n]."""
    e1 = b - a
    e2 = c - a
    n = wp.normalize(wp.cross(e1, e2))
    return wp.matrix_from_cols(e1, e2, n)


@wp.func
def face_frame_double(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Q in float64, where it is to be inverted."""
    e1 = wp.vec3d(b) - wp.vec3d(a)
    e2 = wp.vec3d(c) - wp.vec3d(a)
    n = wp.normalize(wp.cross(e1, e2))
    return wp.matrix_from_cols(e1, e2, n)


@wp.kernel
def face_frames_kernel(
    # In:
    vertices: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    # Out:
    frames: wp.array[wp.mat33],
):
    i = wp.tid()
    face = faces[i]
    if not corners_exist(face, vertices.shape[0]):
        frames[i] = wp.mat33(wp.nan)
        return
    frames[i] = face_frame(vertices[face[0]], vertices[face[1]], vertices[face[2]])


@wp.kernel
def face_centroids_kernel(
    # In:
    vertices: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    # Out:
    centroids: wp.array[wp.vec3],
):
    i = wp.tid()
    face = faces[i]
    if not corners_exist(face, vertices.shape[0]):
        centroids[i] = wp.vec3(wp.nan)
        return
    centroids[i] = (vertices[face[0]] + vertices[face[1]] + vertices[face[2]]) / 3.0


@wp.kernel(module=_AT_REST, enable_backward=False)
def inverse_rest_frames_kernel(
    # In:
    rest_vertices: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    # Out:
    inverse_rest: wp.array[wp.mat33],
):
    i, _ = wp.tid()  # see compiling.py
    face = faces[i]
    if not corners_exist(face, rest_vertices.shape[0]):
        inverse_rest[i] = wp.mat33(wp.nan)
        return
    q = face_frame_double(rest_vertices[face[0]], rest_vertices[face[1]], rest_vertices[face[2]])
    inverse_rest[i] = wp.mat33(wp.inverse(q))


@wp.kernel
def deformation_gradient_kernel(
    # In:
    inverse_rest: wp.array[wp.mat33],
    vertices: wp.array[wp.vec3],
    faces: wp.array[wp.vec3i],
    # Out:
    phi: wp.array[wp.mat33],
):
    i = wp.tid()
    face = faces[i]
    if not corners_exist(face, vertices.shape[0]):
        phi[i] = wp.mat33(wp.nan)
        return
    phi[i] = face_frame(vertices[face[0]], vertices[face[1]], vertices[face[2]]) * inverse_rest[i]


@wp.kernel
def relative_deformation_gradient_kernel(
    # In:
    phi_next: wp.array[wp.mat33],
    phi: wp.array[wp.mat33],
    # Out:
    psi: wp.array[wp.mat33],
):
    i = wp.tid()
    psi[i] = wp.mat33(wp.mat33d(phi_next[i]) * wp.inverse(wp.mat33d(phi[i])))


_face_frames = row_operator(
    "face_frames",
    face_frames_kernel,
    {"vertices": wp.vec3, "faces": wp.vec3i},
    {"frames": (wp.mat33, (3, 3))},
    rows="faces",
    gradients=["vertices"],
)
_face_centroids = row_operator(
    "face_centroids",
    face_centroids_kernel,
    {"vertices": wp.vec3, "faces": wp.vec3i},
    {"centroids": (wp.vec3, (3,))},
    rows="faces",
    gradients=["vertices"],
)
_inverse_rest_frames = row_operator(
    "inverse_rest_frames",
    inverse_rest_frames_kernel,
    {"rest_vertices": wp.vec3, "faces": wp.vec3i},
    {"inverse_rest": (wp.mat33, (3, 3))},
    rows="faces",
)
_deformation_gradient = row_operator(
    "deformation_gradient",
    deformation_gradient_kernel,
    {"inverse_rest": wp.mat33, "vertices": wp.vec3, "faces": wp.vec3i},
    {"phi": (wp.mat33, (3, 3))},
    rows="faces",
    gradients=["vertices"],
)
_relative_deformation_gradient = row_operator(
    "relative_deformation_gradient",
    relative_deformation_gradient_kernel,
    {"phi_next": wp.mat33, "phi": wp.mat33},
    {"psi": (wp.mat33, (3, 3))},
    rows="phi",
    gradients=["phi_next", "phi"],
)


def expect_mesh(vertices: torch.Tensor, faces: torch.Tensor, name: str = "vertices") -> None:
    """Refuses arguments that are not vertices float32 [V, 3] and faces int32 [F, 3] on one device.

    Args:
        vertices: Positions to check.
        faces: Vertex indices to check.
        name: Name of the argument `vertices`, for error messages.

    Raises:
        TypeError: Another dtype.
        ValueError: Another shape, or two devices.
    """
    expect(name, vertices, (None, 3))
    expect("faces", faces, (None, 3), torch.int32, vertices.device)


def face_frames(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Frames Q = [e1, e2, n] of faces.

    Args:
        vertices: Positions [m], float32 [V, 3].
        faces: Vertex indices, int32 [F, 3].

    Returns:
        float32 [F, 3, 3]; columns are two edges [m] and the unit normal. Differentiable in the vertices.
    """
    expect_mesh(vertices, faces)
    return _face_frames(vertices, faces)


def face_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Unit normals of faces.

    Args:
        vertices: Positions [m], float32 [V, 3].
        faces: Vertex indices, int32 [F, 3].

    Returns:
        float32 [F, 3]; zero where a face has no area. Differentiable in the vertices.
    """
    return face_frames(vertices, faces)[:, :, 2]


def face_centroids(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Centroids of faces, the means of their corners.

    Args:
        vertices: Positions [m], float32 [V, 3].
        faces: Vertex indices, int32 [F, 3].

    Returns:
        Centroids [m], float32 [F, 3]. Differentiable in the vertices.
    """
    expect_mesh(vertices, faces)
    return _face_centroids(vertices, faces)


def inverse_rest_frames(rest_vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Q_rest⁻¹ of faces, inverted in float64. It is constant per garment and therefore computed once.

    Args:
        rest_vertices: Rest positions [m], float32 [V, 3].
        faces: Vertex indices, int32 [F, 3].

    Returns:
        float32 [F, 3, 3], without gradient; rows 0 and 1 in 1/m, row 2 without unit; zero for a rest face without area.
    """
    expect_mesh(rest_vertices, faces, "rest_vertices")
    return _inverse_rest_frames(rest_vertices.detach(), faces)


def deformation_gradient_from_inverse(
    inverse_rest: torch.Tensor, vertices: torch.Tensor, faces: torch.Tensor
) -> torch.Tensor:
    """Deformation gradients Φ = Q Q_rest⁻¹ from rest frames that were inverted before.

    Args:
        inverse_rest: Inverse rest frames from `inverse_rest_frames`, float32 [F, 3, 3].
        vertices: Positions [m], float32 [V, 3].
        faces: Vertex indices, int32 [F, 3].

    Returns:
        float32 [F, 3, 3], dimensionless. Differentiable in the vertices.
    """
    expect_mesh(vertices, faces)
    expect("inverse_rest", inverse_rest, (faces.shape[0], 3, 3), device=vertices.device)
    return _deformation_gradient(inverse_rest, vertices, faces)


def deformation_gradient(rest_vertices: torch.Tensor, vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Deformation gradients Φ = Q Q_rest⁻¹ of faces.

    Args:
        rest_vertices: Rest positions [m], float32 [V, 3].
        vertices: Positions [m], float32 [V, 3].
        faces: Vertex indices, int32 [F, 3].

    Returns:
        float32 [F, 3, 3], dimensionless. Differentiable in `vertices`.

    Example:
        >>> rest = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> deformation_gradient(rest, 2 * rest, torch.tensor([[0, 1, 2]], dtype=torch.int32))[0].diagonal()
        tensor([2., 2., 1.])
    """
    expect_mesh(vertices, faces)
    expect("rest_vertices", rest_vertices, tuple(vertices.shape), device=vertices.device)
    return deformation_gradient_from_inverse(inverse_rest_frames(rest_vertices, faces), vertices, faces)


def relative_deformation_gradient(phi_next: torch.Tensor, phi: torch.Tensor) -> torch.Tensor:
    """Ψ = Φ_next Φ⁻¹, inverted in float64; zero where phi is singular.

    Args:
        phi_next: Deformation gradients of the later frame, float32 [F, 3, 3].
        phi: Deformation gradients of the earlier frame, float32 [F, 3, 3].

    Returns:
        float32 [F, 3, 3], dimensionless. Differentiable in both arguments.
    """
    expect("phi", phi, (None, 3, 3))
    expect("phi_next", phi_next, tuple(phi.shape), device=phi.device)
    return _relative_deformation_gradient(phi_next, phi)


def segment_mean(values: torch.Tensor, segment: torch.Tensor, count: int) -> torch.Tensor:
    """Means of the rows of each segment, for example of the faces of each component.

    Args:
        values: Rows in any unit, float32 [F, K].
        segment: Segment of each row, int32 [F], within [0, count).
        count: Number of segments.

    Returns:
        Means in the unit of `values`, float32 [count, K]; zero for a segment without rows. Differentiable in `values`.
        The CPU sums in the order of rows, so that its results are repeatable.
    """
    expect("values", values, (None, None))
    expect("segment", segment, (values.shape[0],), torch.int32, values.device)
    index = segment.long()
    # Sums of 10^5 coordinates lose digits in float32.
    total = values.new_zeros((count, values.shape[1]), dtype=torch.float64).index_add(0, index, values.double())
    rows = values.new_zeros(count, dtype=torch.float64).index_add(0, index, torch.ones_like(index, dtype=torch.float64))
    return (total / rows.clamp(min=1.0)[:, None]).to(values.dtype)
