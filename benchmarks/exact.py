"""Slow and exact results in float64, with which fast ones are compared."""

from __future__ import annotations

import numpy as np


def signed_distance(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed distances [m] to a mesh, every point against every face; negative where the winding number exceeds 1/2.

    The distance to a triangle is the least of those to its sides, or that to its plane where the point is above it.
    The winding number is the sum of the triangles' solid angles (Van Oosterom and Strackee 1983) over 4 pi.

    Args:
        points: Points [m], shape [N,3].
        vertices: Vertices of the mesh [m], shape [U,3].
        faces: Vertex indices, shape [G,3].
    """
    corners = np.asarray(vertices, np.float64)[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    inward = np.cross(normal[:, None], sides)
    squared = np.maximum((sides**2).sum(axis=2), 1e-300)
    result = np.empty(len(points))
    for number, point in enumerate(np.asarray(points, np.float64)):
        away = point - corners
        along = np.clip((away * sides).sum(axis=2) / squared, 0.0, 1.0)
        to_sides = np.linalg.norm(away - along[..., None] * sides, axis=2).min()
        above = ((inward * away).sum(axis=2) >= 0.0).all(axis=1)
        to_planes = np.abs((away[:, 0] * normal).sum(axis=1))[above].min(initial=np.inf)
        result[number] = min(to_sides, to_planes) * (-1.0 if _winding_number(-away) > 0.5 else 1.0)
    return result


def _winding_number(corners: np.ndarray) -> float:
    """Winding number of triangles [G,3,3] around the origin."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    p, q, r = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=1)
    rest = p * q * r + (a * b).sum(axis=1) * r + (b * c).sum(axis=1) * p + (c * a).sum(axis=1) * q
    return float(2.0 * np.arctan2(volume, rest).sum() / (4.0 * np.pi))


def geodesics(vertices: np.ndarray, faces: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Exact distances [m] over a mesh from the centroids of some faces to all, shape [S,F]; needs `pygeodesic`.

    Each face is split in three at its centroid, which changes no distance, since the parts lie in its plane.
    """
    from pygeodesic.geodesic import PyGeodesicAlgorithmExact

    vertices, count = np.asarray(vertices, np.float64), len(faces)
    middle = len(vertices) + np.arange(count)
    points = np.concatenate([vertices, vertices[faces].mean(axis=1)])
    split = np.concatenate([np.stack([faces[:, k], faces[:, (k + 1) % 3], middle], axis=1) for k in range(3)])
    solver = PyGeodesicAlgorithmExact(points, split.astype(np.int32))
    return np.stack([solver.geodesicDistances(middle[s : s + 1], middle)[0] for s in sources])
