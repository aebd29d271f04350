"""Makes an oriented 2-manifold out of a triangle soup, by merging and dropping."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from warpgarment.errors import MeshError

from .checks import directed_edges, duplicate_faces, no_area, repeated_vertices, to_numpy

MERGE = 1e-6  # vertices closer than this share of the bounding box are merged


def clean_mesh(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merges duplicate vertices, drops all that a rest mesh may not have, and makes the faces agree on an outside.

    Dropped are vertices that are not finite with their faces, faces with indices out of range, faces that use a vertex
    twice, have no area or repeat another face; where more than two faces share an edge, the largest two stay. Faces are
    flipped to agree with the majority, by area, of their component; where no agreement is possible (a Möbius strip) the
    faces on one side of the seam are dropped. Vertices without a face are dropped last.

    Args:
        vertices: Positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].

    Returns:
        Vertices [m], float32 [V',3]; faces, int32 [F',3]; new index of each old vertex, int64 [V], -1 if it was
        dropped.

    Raises:
        MeshError: Nothing is left, or the arrays have another shape.
    """
    vertices, faces = np.asarray(to_numpy(vertices), dtype=np.float32), to_numpy(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"Need vertices [V,3] and faces [F,3], got {list(vertices.shape)} and {list(faces.shape)}.")
    faces = faces.astype(np.int64)
    faces = faces[((faces >= 0) & (faces < len(vertices))).all(axis=1)]
    usable = np.isfinite(vertices).all(axis=1)
    faces = faces[usable[faces].all(axis=1)]
    merged = _merge(vertices, usable)
    faces = _no_flat_faces(vertices, merged[faces])
    faces = faces[_largest_two_per_edge(vertices, faces)]
    faces = _orient(vertices, faces)
    if len(faces) == 0:
        raise MeshError("Nothing is left after cleaning: no face has three different, finite vertices and an area.")
    used = np.unique(faces)
    position = np.full(len(vertices), -1)
    position[used] = np.arange(len(used))
    went = np.where(usable, position[merged], -1)
    return vertices[used], position[faces].astype(np.int32), went


def _merge(vertices: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """For each vertex, the lowest index at the same place, from a tree; a grid would miss pairs across its cells."""
    from scipy.spatial import cKDTree

    group = np.arange(len(vertices))
    points = vertices[usable].astype(np.float64)
    if len(points):
        size = np.linalg.norm(np.ptp(points, axis=0))
        pairs = cKDTree(points).query_pairs(MERGE * size, output_type="ndarray")
        if len(pairs):
            graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
            label = connected_components(graph, directed=False)[1]
            lowest = np.unique(label, return_index=True)[1]
            index = np.nonzero(usable)[0]
            group[index] = index[lowest[label]]
    return group


def _no_flat_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    faces = faces[~repeated_vertices(faces)]
    if len(faces):
        faces = faces[~no_area(vertices, faces)]
    return faces[~duplicate_faces(faces)] if len(faces) else faces


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


def _orient(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Flips faces so that neighbours agree; drops one face at each edge where that is impossible."""
    if len(faces) == 0:
        return faces
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
    faces = np.where(flip[:, None], faces[:, ::-1], faces)
    torn = (flip[a] ^ flip[b]) != disagree
    keep = np.ones(count, dtype=bool)
    keep[b[torn]] = False
    return faces[keep]
