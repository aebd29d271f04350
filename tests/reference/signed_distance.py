"""Float64 twins of kernels/sdf/query.py, by libigl: exact distances by its AABB tree, exact winding numbers summed
over all faces."""

from __future__ import annotations

import igl
import numpy as np


def winding_number(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Exact generalised winding numbers, [N]."""
    return igl.winding_number(vertices.astype(np.float64), faces.astype(np.int64), points.astype(np.float64))


def unsigned_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distances to the surface [m], [N]."""
    squared = igl.point_mesh_squared_distance(
        points.astype(np.float64), vertices.astype(np.float64), faces.astype(np.int64)
    )[0]
    return np.sqrt(np.maximum(squared, 0.0))


def closest_point(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """[N, 3], nearest points of the surface."""
    return igl.point_mesh_squared_distance(
        points.astype(np.float64), vertices.astype(np.float64), faces.astype(np.int64)
    )[2]


def signed_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed distances [m], [N], negative where the winding number exceeds one half."""
    sign = np.where(winding_number(points, vertices, faces) > 0.5, -1.0, 1.0)
    return sign * unsigned_distance(points, vertices, faces)


def pseudonormal_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Distances [m], [N], with the sign by the normal of the closest feature, which is right if no surfaces overlap."""
    return igl.signed_distance(
        points.astype(np.float64),
        vertices.astype(np.float64),
        faces.astype(np.int64),
        igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )[0]


def barycentric(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates [N, 3] of points in the planes of triangles [N, 3, 3], by least squares."""
    points, corners = points.astype(np.float64), corners.astype(np.float64)
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    edges = np.stack([e1, e2], axis=2)
    uv = np.einsum("nij,nj->ni", np.linalg.pinv(edges), points - corners[:, 0])
    return np.concatenate([1.0 - uv.sum(axis=1, keepdims=True), uv], axis=1)
