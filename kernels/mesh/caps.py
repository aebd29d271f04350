"""Caps: fans of triangles that close the holes of a body, on the host.

A boundary is a set of directed edges that the faces use once more one way than the other. It falls into loops, and a
fan over each, from its lowest vertex, uses them the other way round. It loads neither Warp nor torch: a body is turned
outwards, and a data set checked, without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph


class Caps(NamedTuple):
    """Triangles that close the holes of a body, or of a packed batch of bodies."""

    triangles: np.ndarray
    """Vertex indices of the caps, packed ones for a batch, loop by loop, int32 [K, 3]; the first corner is the fan's
    centre."""
    loops: np.ndarray
    """Index at which the caps of each loop begin, and K, int32 [L + 1]."""
    bodies: np.ndarray
    """Index at which the loops of each body begin, and L, int32 [B + 1]."""


def caps_of(faces: np.ndarray, vertex_count: int) -> Caps:
    """Fans that close a body; a closed body gets none.

    Args:
        faces: Vertex indices, integers [G, 3], in any orientation; any number of faces may share an edge.
        vertex_count: Number of vertices U.
    """
    faces = faces.astype(np.int64)
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    keys, edge = np.unique(low * vertex_count + high, return_inverse=True)
    net = np.bincount(edge, np.where(start < end, 1, -1), len(keys)).astype(np.int64)  # low to high less high to low
    net[keys // vertex_count == keys % vertex_count] = 0
    keys, net = np.repeat(keys, np.abs(net)), np.repeat(np.sign(net), np.abs(net))
    low, high = keys // vertex_count, keys % vertex_count
    start, end = np.where(net > 0, low, high), np.where(net > 0, high, low)
    graph = scipy.sparse.coo_matrix((np.ones(len(keys)), (start, end)), (vertex_count, vertex_count))
    _, loop_of_vertex = scipy.sparse.csgraph.connected_components(graph, directed=False)
    loop_of_edge = loop_of_vertex[start]
    centre = np.full(vertex_count, vertex_count)
    np.minimum.at(centre, loop_of_edge, start)
    triangles = np.stack([centre[loop_of_edge], end, start], axis=1)  # the edge in the opposite direction
    triangles = triangles[(triangles[:, 0] != triangles[:, 1]) & (triangles[:, 0] != triangles[:, 2])]
    triangles = triangles[np.argsort(triangles[:, 0], kind="stable")]
    first = np.unique(triangles[:, 0], return_index=True)[1]
    loops = np.append(first, len(triangles))
    bodies = np.array([0, len(first)], np.int32)
    return Caps(triangles.astype(np.int32).reshape(-1, 3), loops.astype(np.int32), bodies)


def joined(caps: Sequence[Caps], vertex_starts: Sequence[int]) -> Caps:
    """The caps of a packed batch.

    Args:
        caps: Those of each of its B bodies, alone.
        vertex_starts: Index at which the vertices of each body begin, [B] or more.
    """
    ends = np.append(0, np.cumsum([len(each.triangles) for each in caps])).astype(np.int32)
    loops = [each.loops[:-1] + end for each, end in zip(caps, ends, strict=False)]
    triangles = [each.triangles + np.int32(start) for each, start in zip(caps, vertex_starts, strict=False)]
    bodies = np.append(0, np.cumsum([len(each) for each in loops])).astype(np.int32)
    return Caps(np.concatenate(triangles), np.append(np.concatenate(loops), ends[-1:]), bodies)
