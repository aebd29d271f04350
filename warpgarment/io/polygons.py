"""Polygons into triangles."""

from __future__ import annotations

import numpy as np

from warpgarment.errors import MeshError

LARGEST = 5_000  # corners of a polygon: cutting one into triangles takes time by the square of their number


def triangulate_counts(vertices: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Splits polygons into triangles over their own corners, keeping their orientation.

    Convex ones become fans from their first corner, concave quads fans from the corner that lies inside, others are cut
    by ear clipping in the plane of their Newell normal. Polygons with as many corners are looked at together.

    Args:
        vertices: Positions, shape [V,3].
        counts: Corners of each polygon, three or more, shape [P].
        indices: Vertices of the polygons' corners, end to end, shape [sum of counts].

    Returns:
        Faces, int64, shape [F,3], in the order of the polygons.

    Raises:
        MeshError: A polygon of more than `LARGEST` corners.
    """
    indices = np.asarray(indices, dtype=np.int64)
    counts = np.asarray(counts, dtype=np.int64)
    if (counts == 3).all():
        return indices.reshape(-1, 3)
    if counts.max() > LARGEST:
        raise MeshError(
            f"polygon {int(counts.argmax()):,} has {int(counts.max()):,} corners; {LARGEST:,} are the most that are "
            "cut into triangles. Triangulate it where it was made."
        )
    starts = np.cumsum(counts) - counts
    placed = np.cumsum(counts - 2) - (counts - 2)
    faces = np.empty((int((counts - 2).sum()), 3), dtype=np.int64)
    for n in np.unique(counts).tolist():
        rows = np.flatnonzero(counts == n)
        polygons = indices[starts[rows][:, None] + np.arange(n)]
        faces[placed[rows][:, None] + np.arange(n - 2)] = _alike(np.asarray(vertices, dtype=np.float64), polygons)
    return faces


def _alike(vertices: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """Triangles [P,n-2,3] of polygons [P,n]."""
    n = polygons.shape[1]
    if n == 3:
        return polygons[:, None]
    flat = _plane(vertices[polygons])
    turns = _turns(flat)
    if n == 4:  # one corner of a concave quad lies inside the triangle of the others: both triangles have it
        first = np.where((turns < 0).any(axis=1), turns.argmin(axis=1), 0)
        polygons = np.take_along_axis(polygons, (first[:, None] + np.arange(4)) % 4, axis=1)
    fans = np.stack([np.broadcast_to(polygons[:, :1], (len(polygons), n - 2)), polygons[:, 1:-1], polygons[:, 2:]], 2)
    if n > 4:
        for k in np.flatnonzero((turns < 0).any(axis=1)):
            fans[k] = polygons[k][_ears(flat[k])]
    return fans


def _ears(flat: np.ndarray) -> np.ndarray:
    """Triangles [n-2,3] of corners [n,2]. Each corner that is cut off changes its two neighbours alone."""
    rest = list(range(len(flat)))
    ears = [_is_ear(flat, rest, k) for k in range(len(rest))]
    faces = []
    while len(rest) > 3:
        # a polygon that crosses itself may have no ear, and no triangulation: any is as good
        k = ears.index(True) if True in ears else int(np.argmax(_turns(flat[rest])))
        faces.append((rest[k - 1], rest[k], rest[(k + 1) % len(rest)]))
        del rest[k], ears[k]
        for near in ((k - 1) % len(rest), k % len(rest)):
            ears[near] = _is_ear(flat, rest, near)
    return np.array([*faces, rest])


def _plane(corners: np.ndarray) -> np.ndarray:
    """Coordinates of polygons [P,n,3] in their mean planes, counter-clockwise, [P,n,2]."""
    centred = corners - corners.mean(axis=1, keepdims=True)
    normal = np.cross(centred, np.roll(centred, -1, axis=1)).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    axis = np.cross(np.eye(3)[np.argmin(np.abs(normal), axis=1)], normal)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
    return centred @ np.stack([axis, np.cross(normal, axis)], axis=2)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _turns(flat: np.ndarray) -> np.ndarray:
    return _cross(flat - np.roll(flat, 1, axis=-2), np.roll(flat, -1, axis=-2) - flat)


def _is_ear(flat: np.ndarray, rest: list[int], k: int) -> bool:
    before, after = (k - 1) % len(rest), (k + 1) % len(rest)
    a, b, c = flat[rest[before]], flat[rest[k]], flat[rest[after]]
    if _cross(b - a, c - b) <= 0:
        return False
    others = flat[[v for i, v in enumerate(rest) if i not in (before, k, after)]]
    inside = (_cross(b - a, others - a) >= 0) & (_cross(c - b, others - b) >= 0) & (_cross(a - c, others - c) >= 0)
    return not inside.any()
