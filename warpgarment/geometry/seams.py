"""Open borders at the same place: the two sides of the seams of a garment that comes as the panels of its pattern.

A vertex of an open border is joined with others that are as good as at its place,

    |p_i - p_j| <= SHARE * min(L, l_i, l_j),    L: mean edge length (edges of large faces count more, so that a button's
                                                do not set the scale),  l_i: of the border's edges at i

where their borders meet in at least two places. Vertices inside a surface never are: layers that merely touch stay two.
Nor is anything joined that would make a face collapse, double a face, or give an edge a third face.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .checks import directed_edges, repeated_vertices

SHARE = 0.05
"""Distance within which borders coincide, as a share of the length of edges."""
MOST, ANYWAY = 12, 4_000_000
"""Vertices near each vertex, on average, beyond which nothing is joined unless there are fewer in all. Where all
triangles are apart, 6 are at each place."""
FEW = 500
"""Vertices on borders up to which all pairs of them are looked at. A tree for more of them is SciPy's, which takes a
tenth of a second to load."""
PATIENCE = 5
"""Rounds in which single vertices are taken out of what is to be joined, before all at their place are."""

REMEDY = "Garment.load(path, clean=True) or garment.cleaned() joins them."


class Seams(NamedTuple):
    """Which vertices of open borders are at the same place."""

    group: np.ndarray
    """For each vertex the lowest one that it is to be joined with, int64 [V]; itself where there is none."""
    tolerance: float
    """Distance within which vertices were taken for one [m]; less where edges are shorter than most."""
    apart: int
    """Vertices that were left apart, since an edge would have had a third face, or a face would have collapsed."""
    between: int
    """Vertices that lie on an edge of another border and not at one of its ends, and so cannot be joined."""

    @property
    def sides(self) -> int:
        """Vertices that share their place with others."""
        return int(np.count_nonzero(np.bincount(self.group, minlength=len(self.group))[self.group] > 1))

    @property
    def places(self) -> int:
        """Vertices that are left of these once they are joined."""
        return int(np.count_nonzero(np.bincount(self.group, minlength=1) > 1))

    def unjoined(self) -> str:
        """Sentences on what cannot be joined; empty where there is nothing."""
        said = []
        if self.apart:
            said.append(
                f"{self.apart:,} more are at the place of others and left apart: a face would collapse or an edge "
                "have three."
            )
        if self.between:
            said.append(
                f"{self.between:,} vertices on open borders lie on edges of other borders, between their vertices: if "
                "these are seams, they stay open there. Give both sides the same vertices."
            )
        return " ".join(said)

    def found(self) -> str:
        """What was found, as the beginning of a sentence."""
        return (
            f"{self.sides:,} vertices on open borders lie at {self.places:,} places, within {1e3 * self.tolerance:.2g} "
            f"mm of each other ({100 * SHARE:g} % of the mean edge length, or of the edges there if these are shorter)"
        )


def coinciding_borders(vertices: np.ndarray, faces: np.ndarray) -> Seams:
    """Finds the vertices of open borders that are at the same place.

    Args:
        vertices: Positions [m], shape [V,3]; those that faces name are finite.
        faces: Vertex indices in range, shape [F,3].
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    faces = faces[~repeated_vertices(faces)]
    group, size = np.arange(len(vertices)), len(vertices)
    if len(faces) == 0:
        return Seams(group, 0.0, 0, 0)
    tolerance = SHARE * _edge_length(vertices, faces)
    keys, count = np.unique(_keys(directed_edges(faces), size), return_counts=True)
    border = np.stack(np.divmod(keys[count == 1], size), axis=1)
    on_border = np.unique(border)
    if len(on_border) == 0:
        return Seams(group, tolerance, 0, 0)
    pairs = _pairs_within(vertices[on_border], tolerance)
    if pairs is None:
        return Seams(group, tolerance, len(on_border), 0)
    found = on_border[pairs]
    label = _connected(size, _wanted(vertices, found, border, keys))
    wanted = np.bincount(label)[label] > 1
    label = _manifold(vertices, faces, label)
    lowest = np.unique(label, return_index=True)
    group = lowest[1][np.searchsorted(lowest[0], label)]
    joined = np.bincount(group, minlength=size)[group] > 1
    keys, first, count = np.unique(_keys(group[directed_edges(faces)], size), return_index=True, return_counts=True)
    open_still = group[directed_edges(faces)[first[count == 1]]]
    apart, between = wanted & ~joined, _between(vertices, open_still, tolerance)
    return Seams(group, tolerance, int(np.count_nonzero(apart)), int(np.count_nonzero(between & ~wanted)))


def _pairs_within(points: np.ndarray, distance: float) -> np.ndarray | None:
    """Pairs of points that are at most so far from each other, int64 [P,2]; None if too many are."""
    if len(points) <= FEW:
        near = np.linalg.norm(points[:, None] - points, axis=2) <= distance
        return np.argwhere(np.triu(near, 1))
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    if tree.count_neighbors(tree, distance) > max(MOST * len(points), ANYWAY):
        return None
    return np.asarray(tree.query_pairs(distance, output_type="ndarray").reshape(-1, 2), np.int64)


def _found_within(points: np.ndarray, centres: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Balls [E,3], [E] and points that are in them, two int64 [P]; None if there are too many in a ball on average."""
    if len(points) <= FEW:
        near = np.linalg.norm(points - centres[:, None], axis=2) <= reach[:, None]
        if near.sum(axis=1).mean() > 4 * MOST:
            return None
        ball, point = np.nonzero(near)
        return ball, point
    from scipy.spatial import cKDTree

    tree, some = cKDTree(points), slice(None, None, 1 + len(centres) // 1000)
    if tree.query_ball_point(centres[some], reach[some], return_length=True).mean() > 4 * MOST:
        return None
    found = tree.query_ball_point(centres, reach)
    ball = np.repeat(np.arange(len(centres)), [len(inside) for inside in found])
    return ball, np.concatenate([*found, []]).astype(np.int64)


def _keys(pairs: np.ndarray, count: int) -> np.ndarray:
    """A number for each pair of vertices [N,2], of which there are `count`, in either order."""
    return np.asarray(pairs.min(axis=1) * np.int64(count) + pairs.max(axis=1))


def _edge_length(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Mean edge length [m], each face counting by its area."""
    corners = vertices[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    length = np.linalg.norm(edges, axis=2).mean(axis=1)
    return float(np.average(length, weights=area) if area.sum() > 0 else length.mean())


def _wanted(vertices: np.ndarray, pairs: np.ndarray, border: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Pairs [P,2] that are near for the edges there, no two of one edge (by its key), of borders that meet twice."""
    length = np.linalg.norm(vertices[border[:, 0]] - vertices[border[:, 1]], axis=1)
    uses = np.maximum(np.bincount(border.reshape(-1), minlength=len(vertices)), 1)
    local = SHARE * np.bincount(border.reshape(-1), np.repeat(length, 2), len(vertices)) / uses
    gap = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    pairs = pairs[gap <= local[pairs].min(axis=1, initial=np.inf)]
    pairs = pairs[~np.isin(_keys(pairs, len(vertices)), edges)]
    loops = _keys(_connected(len(vertices), border)[pairs], len(vertices))
    inverse, times = np.unique(loops, return_inverse=True, return_counts=True)[1:]
    return np.asarray(pairs[times[inverse.reshape(-1)] > 1])


def _connected(count: int, pairs: np.ndarray) -> np.ndarray:
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _manifold(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Labels [V] of vertices to join, without those that would collapse or repeat a face or crowd an edge.

    Where more than two faces would meet at an edge, those of the largest pieces stay.
    """
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    piece = _connected(len(vertices), directed_edges(faces))[faces[:, 0]]
    order = np.argsort(-np.bincount(piece, area)[piece], kind="stable")  # faces, from the largest piece on
    concerned = (np.bincount(label)[label] > 1)[faces].any(axis=1)[order]
    label, faces = label.copy(), faces[order][concerned]
    following = int(label.max()) + 1
    for turn in itertools.count():
        joined = label[faces]
        bad = [
            faces[repeated_vertices(joined)],
            faces[_earlier(np.sort(joined, axis=1)) > 0],
            directed_edges(faces)[_earlier(np.sort(directed_edges(joined), axis=1)) > 1],
        ]
        split = np.unique(np.concatenate([b.reshape(-1) for b in bad]))
        uses = np.bincount(label)
        split = split[uses[label[split]] > 1]
        if len(split) == 0:
            break
        if turn >= PATIENCE:  # no longer one by one
            split = np.flatnonzero(np.isin(label, label[split]))
        label[split] = following + np.arange(len(split))
        following += len(split)
    return label


def _earlier(rows: np.ndarray) -> np.ndarray:
    """How many rows before each one are equal to it, [N]."""
    order = np.lexsort(rows.T)
    first = np.ones(len(rows), dtype=bool)
    first[1:] = (rows[order][1:] != rows[order][:-1]).any(axis=1)
    start = np.flatnonzero(first)
    result = np.empty(len(rows), dtype=np.int64)
    result[order] = np.arange(len(rows)) - start[np.cumsum(first) - 1] if len(rows) else 0
    return result


def _between(vertices: np.ndarray, border: np.ndarray, tolerance: float) -> np.ndarray:
    """Vertices of open edges [E,2] that lie on another of them, away from both its ends, bool [V]."""
    result = np.zeros(len(vertices), dtype=bool)
    on_border = np.unique(border)
    if len(on_border) == 0:
        return result
    start, along = vertices[border[:, 0]], vertices[border[:, 1]] - vertices[border[:, 0]]
    length = np.linalg.norm(along, axis=1)
    middle, reach = start + 0.5 * along, 0.5 * length + tolerance
    found = _found_within(vertices[on_border], middle, reach)
    if found is None:
        return result
    edge, vertex = found[0], on_border[found[1]]
    other = (vertex != border[edge, 0]) & (vertex != border[edge, 1])
    edge, vertex = edge[other], vertex[other]
    close = np.minimum(tolerance, SHARE * length[edge])
    away = vertices[vertex] - start[edge]
    share = np.einsum("ij,ij->i", away, along[edge]) / np.maximum(length[edge] ** 2, 1e-300)
    gap = np.linalg.norm(away - share[:, None] * along[edge], axis=1)
    inside = (share > SHARE) & (share < 1 - SHARE)
    result[vertex[(gap <= close) & inside]] = True
    return result
