"""Open borders at the same place: the two sides of the seams of a garment that comes as the panels of its pattern.

A vertex of an open border is joined with others that are as good as at its place,

    |p_i - p_j| <= SHARE * min(L, l_i, l_j),    L: mean edge length (edges of large faces count more, so that a button's
                                                do not set the scale),  l_i: of the border's edges at i

where their borders meet in at least two places. Vertices inside a surface never are: layers that merely touch stay two.
Nor is anything joined that would make a face collapse, double a face, or give an edge a third face.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from .checks import directed_edges, duplicate_faces, repeated_vertices

SHARE = 0.05
"""Distance within which borders coincide, as a share of the length of edges."""

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
    group = np.arange(len(vertices))
    if len(faces) == 0:
        return Seams(group, 0.0, 0, 0)
    tolerance = SHARE * _edge_length(vertices, faces)
    edges, count = np.unique(np.sort(directed_edges(faces), axis=1), axis=0, return_counts=True)
    border = edges[count == 1]
    pairs = _pairs(vertices, border, edges, tolerance)
    label = _connected(len(vertices), pairs)
    wanted = np.bincount(label)[label] > 1
    label = _manifold(vertices, faces, label)
    lowest = np.unique(label, return_index=True)
    group = lowest[1][np.searchsorted(lowest[0], label)]
    joined = np.bincount(group, minlength=len(group))[group] > 1
    apart, between = wanted & ~joined, _between(vertices, border, label, tolerance)
    return Seams(group, tolerance, int(np.count_nonzero(apart)), int(np.count_nonzero(between & ~wanted)))


def _between(vertices: np.ndarray, border: np.ndarray, label: np.ndarray, tolerance: float) -> np.ndarray:
    """Border vertices that lie on a border edge away from both its ends, bool [V]."""
    result = np.zeros(len(vertices), dtype=bool)
    if len(border) == 0:
        return result
    on_border = np.unique(border)
    start, along = vertices[border[:, 0]], vertices[border[:, 1]] - vertices[border[:, 0]]
    length = np.linalg.norm(along, axis=1)
    near = cKDTree(vertices[on_border]).query_ball_point(start + 0.5 * along, 0.5 * length + tolerance)
    edge = np.repeat(np.arange(len(border)), [len(found) for found in near])
    vertex = on_border[np.concatenate([*near, []]).astype(np.int64)]
    other = (label[vertex] != label[border[edge, 0]]) & (label[vertex] != label[border[edge, 1]])
    edge, vertex = edge[other], vertex[other]
    close = np.minimum(tolerance, SHARE * length[edge])
    away = vertices[vertex] - start[edge]
    share = np.einsum("ij,ij->i", away, along[edge]) / np.maximum(length[edge] ** 2, 1e-300)
    gap = np.linalg.norm(away - share[:, None] * along[edge], axis=1)
    inside = (share > SHARE) & (share < 1 - SHARE)
    result[vertex[(gap <= close) & inside]] = True
    return result


def _edge_length(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Mean edge length [m], each face counting by its area."""
    corners = vertices[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    length = np.linalg.norm(edges, axis=2).mean(axis=1)
    return float(np.average(length, weights=area) if area.sum() > 0 else length.mean())


def _pairs(vertices: np.ndarray, border: np.ndarray, edges: np.ndarray, tolerance: float) -> np.ndarray:
    """Border vertices within the tolerance of each other [P,2], no two of one edge, of borders that meet twice."""
    on_border = np.unique(border)
    if len(on_border) == 0:
        return np.zeros((0, 2), np.int64)
    found = cKDTree(vertices[on_border]).query_pairs(tolerance, output_type="ndarray")
    pairs = np.sort(on_border[found.reshape(-1, 2)], axis=1)
    length = np.linalg.norm(vertices[border[:, 0]] - vertices[border[:, 1]], axis=1)
    uses = np.maximum(np.bincount(border.reshape(-1), minlength=len(vertices)), 1)
    local = SHARE * np.bincount(border.reshape(-1), np.repeat(length, 2), len(vertices)) / uses
    gap = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
    pairs = pairs[gap <= local[pairs].min(axis=1, initial=np.inf)]
    count = np.int64(len(vertices))
    pairs = pairs[~np.isin(pairs[:, 0] * count + pairs[:, 1], edges[:, 0] * count + edges[:, 1])]
    loops = np.sort(_connected(len(vertices), border)[pairs], axis=1)
    times = np.unique(loops, axis=0, return_inverse=True, return_counts=True)[1:]
    return np.asarray(pairs[times[1][times[0].reshape(-1)] > 1])


def _connected(count: int, pairs: np.ndarray) -> np.ndarray:
    graph = coo_matrix((np.ones(len(pairs), np.int8), pairs.T), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _manifold(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Labels [V] of vertices to join, without those that would collapse or repeat a face or crowd an edge.

    Where more than two faces would meet at an edge, those of the largest pieces stay.
    """
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    piece = _connected(len(vertices), directed_edges(faces))[faces[:, 0]]
    order = np.argsort(-np.bincount(piece, area)[piece], kind="stable")  # faces, from the largest piece on
    label, faces = label.copy(), faces[order]
    following = int(label.max()) + 1
    while True:
        joined = label[faces]
        bad = [faces[repeated_vertices(joined)], faces[duplicate_faces(joined)], _third(faces, joined)]
        split = np.unique(np.concatenate([b.reshape(-1) for b in bad]))
        split = split[np.bincount(label)[label[split]] > 1]
        if len(split) == 0:
            return label
        label[split] = following + np.arange(len(split))
        following += len(split)


def _third(faces: np.ndarray, joined: np.ndarray) -> np.ndarray:
    """Vertices of the edges that would be the third or a later one between the same two places, [N,2]."""
    directed, places = directed_edges(faces), np.sort(directed_edges(joined), axis=1)
    inverse, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)[1:]
    inverse = inverse.reshape(-1)
    order = np.argsort(inverse, kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - (np.cumsum(count) - count)[inverse[order]]
    return directed[rank > 1]
