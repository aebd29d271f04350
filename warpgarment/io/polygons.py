"""Polygons into triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def triangulate(vertices: np.ndarray, polygons: Sequence[Sequence[int]]) -> np.ndarray:
    """Splits polygons into triangles over their own corners, keeping their orientation.

    Convex ones become fans from their first corner, others are cut by ear clipping in the plane of their Newell normal.

    Args:
        vertices: Positions, shape [V,3].
        polygons: Vertex indices of each polygon, three or more.

    Returns:
        Faces, int64, shape [F,3], in the order of the polygons.
    """
    faces: list[tuple[int, int, int]] = []
    for polygon in polygons:
        if len(polygon) == 3:
            faces.append((polygon[0], polygon[1], polygon[2]))
        else:
            faces.extend(_one(np.asarray(vertices, dtype=np.float64)[list(polygon)], list(polygon)))
    return np.asarray(faces, dtype=np.int64).reshape(-1, 3)


def triangulate_counts(vertices: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """`triangulate` for polygons that lie end to end in one array, `counts` corners each."""
    if (counts == 3).all():
        return indices.reshape(-1, 3).astype(np.int64)
    indices = indices.astype(np.int64)
    return triangulate(vertices, [p.tolist() for p in np.split(indices, np.cumsum(counts)[:-1])])


def _one(corners: np.ndarray, polygon: list[int]) -> list[tuple[int, int, int]]:
    flat = _plane(corners)
    turn = _turns(flat)
    rest = list(range(len(polygon)))
    faces = []
    if (turn >= 0).all():
        return [(polygon[0], polygon[k], polygon[k + 1]) for k in rest[1:-1]]
    while len(rest) > 3:
        ear = next((k for k in range(len(rest)) if _is_ear(flat, rest, k)), None)
        if ear is None:  # a polygon that crosses itself has no triangulation; any is as good
            ear = int(np.argmax(_turns(flat[rest])))
        faces.append((polygon[rest[ear - 1]], polygon[rest[ear]], polygon[rest[(ear + 1) % len(rest)]]))
        del rest[ear]
    a, b, c = rest
    return [*faces, (polygon[a], polygon[b], polygon[c])]


def _plane(corners: np.ndarray) -> np.ndarray:
    """Coordinates in the polygon's mean plane, counter-clockwise."""
    centred = corners - corners.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    normal /= max(np.linalg.norm(normal), 1e-300)
    axis = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    axis /= max(np.linalg.norm(axis), 1e-300)
    return centred @ np.stack([axis, np.cross(normal, axis)], axis=1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _turns(flat: np.ndarray) -> np.ndarray:
    return _cross(flat - np.roll(flat, 1, axis=0), np.roll(flat, -1, axis=0) - flat)


def _is_ear(flat: np.ndarray, rest: list[int], k: int) -> bool:
    a, b, c = flat[rest[k - 1]], flat[rest[k]], flat[rest[(k + 1) % len(rest)]]
    if _cross(b - a, c - b) <= 0:
        return False
    corner = {k % len(rest), (k - 1) % len(rest), (k + 1) % len(rest)}
    others = flat[[v for i, v in enumerate(rest) if i not in corner]]
    inside = (_cross(b - a, others - a) >= 0) & (_cross(c - b, others - b) >= 0) & (_cross(a - c, others - c) >= 0)
    return not inside.any()
