"""Cotangent Laplacian and connected components of a rest mesh, built once on the host in float64.

Supplement sections 1.3 and 2. With e_k the edge of a triangle opposite to corner k, A its area and θ_k the angle there:

    w_k = ½ cot θ_k = -e_i·e_j / (4 A)        (i, j the other two corners)
    L   = Σ_triangles Σ_k w_k (δ_i - δ_j)(δ_i - δ_j)ᵀ

L is symmetric and positive semi-definite (obtuse triangles give negative weights, never negative energy) and has no
unit. Its null space consists of the functions that are constant on each connected component.

| symbol | code | what |
| --- | --- | --- |
| w_k | `half_cotangents` | [F,3], unitless, indexed by the opposite corner |
| L | `cotangent_laplacian` | [V,V] |
"""

from __future__ import annotations

from collections.abc import Sized

import numpy as np
import scipy.sparse
import torch

SMALLEST_AREA = 1e-10
"""A face whose doubled area is below this share of its squared longest edge has no usable angles."""


def as_numpy(name: str, array: object, dtype: type) -> np.ndarray:
    """A host copy of an array of shape [*,3].

    Args:
        name: Name of the argument, for error messages.
        array: Torch tensor or array-like.
        dtype: NumPy type of the copy; its kind, integer or float, must be that of the array.

    Raises:
        ValueError: The array has another shape.
        TypeError: The array holds numbers of another kind.
    """
    host = array.detach().cpu().numpy() if isinstance(array, torch.Tensor) else np.asarray(array)
    if host.ndim != 2 or host.shape[1] != 3:
        raise ValueError(f"{name} must have shape [*, 3], got {list(host.shape)}")
    kind = "iu" if np.issubdtype(dtype, np.integer) else "f"
    if host.dtype.kind not in kind:
        raise TypeError(f"{name} must hold {'integers' if kind == 'iu' else 'floats'}, got {host.dtype}")
    return host.astype(dtype)


def half_cotangents(rest_vertices: object, faces: object) -> np.ndarray:
    """Half the cotangent of every corner of the rest mesh.

    Args:
        rest_vertices: Rest positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].

    Returns:
        float64 [F,3], without unit; column k belongs to corner k.

    Raises:
        ValueError: Wrong shape, an index out of range, a rest position that is not finite, or faces without area.
        TypeError: Wrong dtype.
    """
    vertices, faces = as_numpy("rest_vertices", rest_vertices, np.float64), as_numpy("faces", faces, np.int64)
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"faces hold indices {faces.min()} to {faces.max()}, there are {len(vertices)} vertices")
    if not np.isfinite(vertices).all():
        raise ValueError("rest_vertices must be finite; remove or repair vertices that are NaN or infinite")
    corner = vertices[faces]
    edge = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)  # edge[:, k] is opposite to corner k
    double_area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)
    flat = np.flatnonzero(double_area <= SMALLEST_AREA * (edge**2).sum(2).max(1, initial=0.0))
    if len(flat):
        raise ValueError(f"{len(flat)} of {len(faces)} rest faces have no area (first: face {flat[0]}); remove them")
    dots = -(np.roll(edge, -1, axis=1) * np.roll(edge, -2, axis=1)).sum(2)
    return dots / (2.0 * double_area[:, None])


def cotangent_laplacian(rest_vertices: Sized, faces: object) -> scipy.sparse.csr_matrix:
    """The positive semi-definite cotangent Laplacian with weights ½ (cot α + cot β).

    Args:
        rest_vertices: Rest positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].

    Returns:
        float64 CSR matrix [V,V], without unit, with sorted indices; rows of isolated vertices are empty.

    Raises:
        ValueError, TypeError: As in `half_cotangents`.
    """
    weights, faces = half_cotangents(rest_vertices, faces), as_numpy("faces", faces, np.int64)
    i, j, w = np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel(), weights.ravel()
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([j, i, i, j])
    count = len(rest_vertices)
    matrix = scipy.sparse.coo_matrix((np.concatenate([-w, -w, w, w]), (rows, columns)), shape=(count, count)).tocsr()
    matrix.sum_duplicates()
    return matrix


def components(vertex_count: int, faces: object) -> tuple[np.ndarray, np.ndarray, int]:
    """Connected components, ordered by their lowest vertex; an isolated vertex is a component of its own.

    Args:
        vertex_count: Number of vertices V.
        faces: Vertex indices, shape [F,3].

    Returns:
        Component of each vertex, int32 [V]; component of each face, int32 [F]; number of components.
    """
    faces = as_numpy("faces", faces, np.int64)
    rows, columns = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    graph = scipy.sparse.coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(vertex_count, vertex_count))
    count, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    rank = np.empty(count, np.int32)
    rank[np.argsort(first)] = np.arange(count, dtype=np.int32)
    vertex_component = rank[label] if vertex_count else np.zeros(0, np.int32)
    face_component = vertex_component[faces[:, 0]] if len(faces) else np.zeros(0, np.int32)
    return vertex_component.astype(np.int32), face_component.astype(np.int32), int(count)
