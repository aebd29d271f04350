"""Pairs of triangles that cross, in float64 and without the kernels of cloth contact, which they judge.

Two triangles cross if an edge of one goes through the other: its ends lie on different sides of the plane, and the
line passes the three edges on the same side. With the volumes of tetrahedra, for an edge p q and a triangle a b c,

    [a b c p] [a b c q] < 0    and    [p q a b], [p q b c], [p q c a] of one sign or zero

Triangles in one plane are not found, and those with a common vertex not asked.
"""

from __future__ import annotations

import numpy as np

PAIRS = 1 << 22  # looked at together


def crossing_pairs(vertices: np.ndarray, faces: np.ndarray, same: np.ndarray | None = None) -> np.ndarray:
    """The pairs of faces that cross.

    Args:
        vertices: Positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
        same: Number of each vertex by which it is compared with others, shape [V]: those of one number are the same
            vertex, as on both sides of a joined seam. None: all are different.

    Returns:
        Faces of each pair, int64 [P,2], the smaller one first.
    """
    points, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    pairs = near_pairs(points, faces)
    number = faces if same is None else np.asarray(same)[faces]
    a, b = number[pairs[:, 0]], number[pairs[:, 1]]
    pairs = pairs[~(a[:, :, None] == b[:, None, :]).any(axis=(1, 2))]
    corners = points[faces]
    p, q = corners[pairs[:, 0]], corners[pairs[:, 1]]
    kept = _both_sides(p, q) & _both_sides(q, p)
    pairs, p, q = pairs[kept], p[kept], q[kept]
    crossing = np.zeros(len(pairs), bool)
    for k in range(3):
        crossing |= goes_through(p[:, k], p[:, k - 1], q) | goes_through(q[:, k], q[:, k - 1], p)
    return pairs[crossing]


def goes_through(start: np.ndarray, end: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Whether edges go through triangles.

    Args:
        start, end: Ends of the edges [m], shape [P,3].
        triangle: Corners of the triangles [m], shape [P,3,3].
    """
    a, b, c = (triangle[:, k] - start for k in range(3))
    way = end - start
    normal = np.cross(b - a, c - a)
    sides = -_dot(normal, a) * _dot(normal, way - a)
    around = np.stack([_dot(way, np.cross(a, b)), _dot(way, np.cross(b, c)), _dot(way, np.cross(c, a))])
    return (sides < 0) & ((around >= 0).all(axis=0) | (around <= 0).all(axis=0))


def near_pairs(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Pairs of faces with overlapping boxes, int64 [P,2], the smaller one first."""
    corners = points[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    axes = np.argsort(-np.ptp(points, axis=0), kind="stable")  # most pairs are apart along the longest axis
    order = np.argsort(low[:, axes[0]], kind="stable")
    low, high = low[order][:, axes], high[order][:, axes]
    last = np.searchsorted(low[:, 0], high[:, 0], side="right")
    count = last - np.arange(len(faces)) - 1
    found, begin = [np.zeros((0, 2), np.int64)], 0
    while begin < len(faces):
        end = max(begin + 1, int(np.searchsorted(np.cumsum(count[begin:]), PAIRS)) + begin)
        here = count[begin:end]
        i = np.repeat(np.arange(begin, end), here)
        j = i + 1 + np.arange(len(i)) - np.repeat(np.cumsum(here) - here, here)
        for axis in (1, 2):
            meet = (low[i, axis] <= high[j, axis]) & (low[j, axis] <= high[i, axis])
            i, j = i[meet], j[meet]
        found.append(np.sort(np.stack([order[i], order[j]], axis=1), axis=1))
        begin = end
    return np.concatenate(found)


def _both_sides(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Whether the plane of each triangle p has corners of triangle q on both sides."""
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    side = np.einsum("ni,nki->nk", normal, q - p[:, :1])
    return (side.min(axis=1) <= 0) & (side.max(axis=1) >= 0)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", a, b)
