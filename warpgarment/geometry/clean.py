"""Makes an oriented 2-manifold out of a triangle soup, by merging and dropping."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from warpgarment.errors import MeshError

from .checks import directed_edges, duplicate_faces, no_area, repeated_vertices, to_numpy
from .seams import Seams, coinciding_borders


class Cleaned(NamedTuple):
    """A mesh that was cleaned, and where it came from."""

    vertices: np.ndarray
    """Positions [m], float32 [V',3]."""
    faces: np.ndarray
    """Vertex indices, int32 [F',3]."""
    went: np.ndarray
    """New index of each old vertex, int64 [V]; -1 if it was dropped."""
    corners: np.ndarray
    """The old vertices of each new face, int64 [F',3]."""
    rows: np.ndarray
    """Which of the old faces each new one was, int64 [F']."""
    turned: int
    """Faces that were turned round."""
    dropped: int
    """Faces that are gone."""
    seams: Seams
    """Vertices of open borders that were joined."""

    def message(self, what: str) -> str:
        """A sentence for a warning about `what`, on all that was changed; empty where nothing was."""
        did = []
        if self.seams.sides:
            did.append(f"{self.seams.found()} and are joined")
        if self.dropped:
            did.append(f"{self.dropped:,} of {len(self.faces) + self.dropped:,} faces are dropped")
        if self.turned:
            did.append(f"{self.turned:,} faces that disagreed with the others about the outside are turned round")
        said = [f"{what}: {'; '.join(did)}."] if did else []
        return " ".join([*said, self.seams.unjoined()]).strip()


def clean_mesh(vertices: np.ndarray, faces: np.ndarray) -> Cleaned:
    """Joins open borders, drops all that a rest mesh may not have, and makes the faces agree on an outside.

    Joined are vertices of open borders that are at the same place, see `seams`; vertices inside a surface stay as they
    are. Dropped are vertices that are not finite with their faces, faces with indices out of range, faces that use a
    vertex twice, have no area, or repeat another face or exactly its place, as do those of a mesh with two sides; where
    more than two faces share an edge, the largest two stay. Faces are flipped to agree with the majority, by area, of
    their component; where no agreement is possible (a Möbius strip) the faces on one side of the seam are dropped.
    Vertices without a face are dropped last.

    Args:
        vertices: Positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].

    Raises:
        MeshError: Nothing is left, or the arrays have another shape.
    """
    vertices, faces = np.asarray(to_numpy(vertices), dtype=np.float32), to_numpy(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"Need vertices [V,3] and faces [F,3], got {list(vertices.shape)} and {list(faces.shape)}.")
    given, count = faces.astype(np.int64), len(faces)
    rows = np.flatnonzero(((given >= 0) & (given < len(vertices))).all(axis=1))
    usable = np.isfinite(vertices).all(axis=1)
    rows = rows[usable[given[rows]].all(axis=1)]
    rows = rows[_with_area(vertices, _exact(vertices)[given[rows]])]
    seams = coinciding_borders(vertices, given[rows])
    merged = seams.group
    rows = rows[_with_area(vertices, merged[given[rows]])]
    rows = rows[_largest_two_per_edge(vertices, merged[given[rows]])]
    flip, keep = _orient(vertices, merged[given[rows]])
    corners, rows = np.where(flip[:, None], given[rows][:, ::-1], given[rows])[keep], rows[keep]
    if len(corners) == 0:
        raise MeshError("Nothing is left after cleaning: no face has three different, finite vertices and an area.")
    used = np.unique(merged[corners])
    position = np.full(len(vertices), -1)
    position[used] = np.arange(len(used))
    went = np.where(usable, position[merged], -1)
    return Cleaned(
        vertices[used],
        went[corners].astype(np.int32),
        went,
        corners,
        rows,
        int(np.count_nonzero(flip[keep])),
        count - len(corners),
        seams,
    )


def _exact(vertices: np.ndarray) -> np.ndarray:
    """For each vertex the first at exactly the same place, [V]."""
    first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)[1:]
    return np.asarray(first[inverse.reshape(-1)])


def _with_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask of faces that have an area and repeat no other that has one."""
    keep = ~repeated_vertices(faces)
    if keep.any():
        keep[keep] = ~no_area(vertices, faces[keep])
    if keep.any():
        keep[keep] = ~duplicate_faces(faces[keep])
    return np.asarray(keep)


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices.astype(np.float64)[faces]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def _edge_of(faces: np.ndarray) -> np.ndarray:
    """Undirected edge of each directed one, shape [F,3]."""
    return np.unique(np.sort(directed_edges(faces), axis=1), axis=0, return_inverse=True)[1].reshape(-1, 3)


def _largest_two_per_edge(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask of faces to keep: from the largest on, a face stays if each of its edges still has fewer than two faces."""
    keep = np.ones(len(faces), dtype=bool)
    if len(faces) == 0:
        return keep
    edge_of = _edge_of(faces)
    crowded = np.bincount(edge_of.reshape(-1)) > 2
    rivals = np.nonzero(crowded[edge_of].any(axis=1))[0]
    taken = np.zeros(len(crowded), dtype=np.int64)
    for face in rivals[np.argsort(-_areas(vertices, faces[rivals]), kind="stable")]:
        edges = edge_of[face][crowded[edge_of[face]]]
        keep[face] = (taken[edges] < 2).all()
        taken[edges] += keep[face]
    return keep


def _orient(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which faces to flip so that neighbours agree, and which to keep: one is dropped where that is impossible."""
    if len(faces) == 0:
        return np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
    directed, edge_of = directed_edges(faces), _edge_of(faces).reshape(-1)
    order = np.argsort(edge_of, kind="stable")
    same = edge_of[order[1:]] == edge_of[order[:-1]]
    a, b = order[:-1][same], order[1:][same]
    disagree = directed[a, 0] == directed[b, 0]
    a, b = a // 3, b // 3
    count, weight = len(faces), disagree + 1  # 1: the two faces agree, 2: one of them must flip
    graph = coo_matrix((weight, (a, b)), shape=(count, count)).tocsr()
    graph.data = np.minimum(graph.data, 2)
    graph = graph.maximum(graph.T)
    component = connected_components(graph, directed=False)[1]
    flip = np.zeros(count, dtype=bool)
    for root in np.unique(component, return_index=True)[1]:
        nodes, parent = breadth_first_order(graph, root, directed=False)
        for node in nodes[1:]:
            flip[node] = flip[parent[node]] ^ (graph[node, parent[node]] == 2)
    area = _areas(vertices, faces)
    flipped = np.bincount(component, weights=area * flip) > 0.5 * np.bincount(component, weights=area)
    flip ^= flipped[component]
    torn = (flip[a] ^ flip[b]) != disagree
    keep = np.ones(count, dtype=bool)
    keep[b[torn]] = False
    return flip, keep
