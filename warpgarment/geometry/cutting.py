"""Surface operations for making garments: cutting along a field, boundary loops, clearance, remeshing."""

from __future__ import annotations

import heapq

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from warpgarment.errors import MissingExtra

from .sheet import EditableSheet

_TOLERANCE = 0.04  # largest relative error of the number of faces after remeshing


def cut_below_zero(vertices: np.ndarray, faces: np.ndarray, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keeps the part of a surface where a vertex field is positive; triangles on the zero line are split.

    Args:
        vertices: Positions [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        field: Signed value at each vertex, shape [V].

    Returns:
        Vertices [V', 3] and faces [F', 3] of the largest connected piece that remains.

    Raises:
        ValueError: The field is positive nowhere.
    """
    points, parts, inside = split_at_zero(vertices, faces, field)
    if not inside.any():
        raise ValueError(f"nothing is left of {len(faces):,} faces: the field is negative at every vertex")
    return largest_piece(points, parts[inside])


def split_at_zero(
    vertices: np.ndarray, faces: np.ndarray, field: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Splits triangles along the line where a vertex field, linear on each triangle, is zero.

    Args:
        vertices: Positions [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        field: Signed value at each vertex, shape [V].

    Returns:
        Vertices, the old ones first, [V', 3]; faces, [F', 3]; whether the field is positive on a face, bool [F'].
    """
    field = np.where(np.abs(field) < 1e-5, 1e-5, field)
    inside = field > 0
    count = inside[faces].sum(1)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    crossing = np.unique(edges[inside[edges[:, 0]] != inside[edges[:, 1]]], axis=0)
    a, b = crossing.T
    t = (field[a] / (field[a] - field[b]))[:, None]
    points = np.concatenate([vertices, vertices[a] * (1 - t) + vertices[b] * t])
    number = {(int(p), int(q)): len(vertices) + k for k, (p, q) in enumerate(crossing)}

    def middle(p: int, q: int) -> int:
        return number[(p, q) if p < q else (q, p)]

    whole = (count == 0) | (count == 3)
    parts, sides = [faces[whole]], [count[whole] == 3]
    for face in faces[~whole]:
        alone = int(inside[face].sum()) == 1  # one corner is inside, two are outside
        k = int(np.argmax(inside[face] == alone))
        i, j, l = (int(face[(k + n) % 3]) for n in range(3))
        p, q = middle(i, j), middle(i, l)
        parts.append(np.array([[i, p, q], [p, j, l], [p, l, q]]))
        sides.append(np.array([alone, not alone, not alone]))
    return points, np.concatenate(parts), np.concatenate(sides)


def without_specks(faces: np.ndarray, field: np.ndarray, least: int) -> np.ndarray:
    """The field, [V], with negative islands of fewer than `least` vertices made positive, which would become holes."""
    inside = field > 0
    edges = igl.edges(faces)
    edges = edges[~inside[edges].any(1)]
    graph = sp.coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(field),) * 2)
    _, island = connected_components(graph, directed=False)
    small = np.bincount(island)[island] < least
    return np.where(~inside & small, np.abs(field), field)


def largest_piece(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the connected piece with the most faces, without unused vertices."""
    _, piece = igl.facet_components(faces.astype(np.int64))
    return compacted(vertices, faces[piece == np.bincount(np.asarray(piece).ravel()).argmax()])


def compacted(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a mesh without the vertices that no face uses."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3)


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """The boundary loops of a manifold surface, as vertex indices in order, the longest loop first."""
    loops = igl.boundary_loop_all(faces.astype(np.int64))
    return sorted((np.asarray(loop, dtype=np.int64) for loop in loops), key=len, reverse=True)


def averaging(faces: np.ndarray, count: int) -> sp.csr_matrix:
    """Row-stochastic matrix [count, count] that replaces each vertex by the mean of its neighbours."""
    adjacency = igl.adjacency_matrix(faces.astype(np.int64)).astype(np.float64)
    adjacency.resize((count, count))
    return sp.diags_array(1.0 / np.maximum(np.asarray(adjacency.sum(1)).ravel(), 1)) @ adjacency


def smoothed_boundary(vertices: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """Averages boundary vertices along the boundary for a number of rounds, which removes the steps that a cut leaves.

    Args:
        vertices: Positions [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        rounds: Number of rounds.

    Returns:
        Positions [m], shape [V, 3].
    """
    points = vertices.copy()
    for loop in boundary_loops(faces):
        line = points[loop]
        for _ in range(rounds):
            line = 0.5 * line + 0.25 * (np.roll(line, 1, axis=0) + np.roll(line, -1, axis=0))
        points[loop] = line
    return points


def pushed_out(
    vertices: np.ndarray,
    faces: np.ndarray,
    body_vertices: np.ndarray,
    body_faces: np.ndarray,
    gap: float,
    rounds: int = 8,
) -> np.ndarray:
    """Moves vertices and centres of faces that are nearer to a body than a gap out to that distance.

    Without the centres, the body would show through large faces whose vertices are clear of it.

    Args:
        vertices: Positions [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        body_vertices: Positions of the body [m], shape [U, 3].
        body_faces: Vertex indices of the body, shape [G, 3].
        gap: Least distance from the body [m].
        rounds: Number of rounds; each moves all vertices and faces once.

    Returns:
        Positions [m], shape [V, 3].
    """
    points, sign = vertices.copy(), igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    for _ in range(rounds):
        before = points.copy()
        for corners in (faces, np.arange(len(points))[:, None]):  # vertices last, because they must keep the gap
            centres = points[corners].mean(1)
            distance, _, closest, *_ = igl.signed_distance(
                centres,
                body_vertices,
                body_faces.astype(np.int64),
                sign_type=sign,
            )
            outward = (centres - closest) * np.where(distance > 0, 1.0, -1.0)[:, None]
            outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-12
            move = outward * np.maximum(gap - distance, 0.0)[:, None]
            order = np.argsort(-distance, kind="stable")  # the nearest is written last and counts where faces disagree
            pushed = np.zeros_like(points)
            pushed[corners[order].ravel()] = np.repeat(move[order], corners.shape[1], axis=0)
            points += pushed
        if np.abs(points - before).max() < 1e-5:
            break
    return points


def remeshed(vertices: np.ndarray, faces: np.ndarray, target_faces: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Isotropic remeshing of an open sheet to about `target_faces`.

    `remesh_botsch` keeps boundary vertices where they are, so boundaries are given evenly spaced vertices first, and
    edges that stay too short are collapsed afterwards.

    Args:
        vertices: Positions of a manifold sheet [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        target_faces: Wanted number of faces; the result is within a few per cent of it, as long as the narrow parts of
            the sheet are wider than an edge.

    Returns:
        Vertices [m], [V', 3]; faces, [F', 3]; edge length of equilateral triangles of this number and total area [m].

    Raises:
        MissingExtra: gpytoolbox is not installed.
    """
    try:
        from gpytoolbox import remesh_botsch
    except ImportError as error:
        raise MissingExtra("physics", "Remeshing garments") from error
    area = 0.5 * np.asarray(igl.doublearea(vertices, faces.astype(np.int64))).sum()
    edge = float(np.sqrt(area * 4.0 / (np.sqrt(3.0) * target_faces)))
    aimed = edge
    best, least = (vertices, faces), np.inf
    for _ in range(4):
        points, triangles = evened_boundary(vertices.astype(float), faces, aimed)
        for rounds, shortest in ((12, 0.45), (4, 0.4)):
            points, triangles = remesh_botsch(points, triangles.astype(np.int32), i=rounds, h=aimed, project=True)
            points, triangles = without_short_edges(points, triangles, shortest * aimed)
        points, triangles = without_flat_ears(points, triangles)
        if abs(len(triangles) - target_faces) < least:
            best, least = (points, triangles), abs(len(triangles) - target_faces)
        ratio = len(triangles) / target_faces
        if abs(ratio - 1) < _TOLERANCE:
            break
        aimed *= np.sqrt(ratio)
    return *best, edge


def without_flat_ears(vertices: np.ndarray, faces: np.ndarray, limit: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    """Removes triangles without area at a straight border, two of whose edges are border edges.

    Args:
        vertices: Positions [m], shape [V, 3].
        faces: Vertex indices, shape [F, 3].
        limit: Area, as a share of the mean area, below which a triangle is removed.

    Returns:
        Vertices and faces of the sheet without these triangles and without the vertices that only they used. The shape
        of the sheet does not change.
    """
    while True:
        area = np.asarray(igl.doublearea(vertices, faces.astype(np.int64)))
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        _, edge_of, uses = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        borders = (uses[edge_of.ravel()] == 1).reshape(-1, 3).sum(axis=1)
        flat = (borders == 2) & (area < limit * area.mean())
        if not flat.any():
            return vertices, faces
        used, renumbered = np.unique(faces[~flat], return_inverse=True)
        vertices, faces = vertices[used], renumbered.reshape(-1, 3)


def without_short_edges(vertices: np.ndarray, faces: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Collapses edges shorter than `limit` [m], from the shortest on, if the surface stays a manifold.

    An edge becomes a vertex at its middle, except that a boundary vertex keeps its place when an inner vertex is joined
    to it. Edges across a strip, from boundary to boundary, are kept.
    """
    sheet = EditableSheet(vertices, faces)
    queue: list[tuple[float, int, int]] = []

    def look_at(around: set[int]) -> None:
        for a in around:
            for b in sheet.neighbours(a):
                if a < b and (length := sheet.length(a, b)) <= limit:
                    heapq.heappush(queue, (length, a, b))

    look_at(set(range(len(vertices))))
    while queue:
        length, a, b = heapq.heappop(queue)
        if b not in sheet.neighbours(a) or sheet.length(a, b) != length:
            continue  # the edge no longer exists
        border_a, border_b = sheet.on_boundary(a), sheet.on_boundary(b)
        if border_a and border_b and sheet.sharing(a, b) == 2:
            continue
        middle = 0.5 * (sheet.points[a] + sheet.points[b])
        place = middle if border_a == border_b else sheet.points[a if border_a else b].copy()
        if sheet.collapse(a, b):
            sheet.points[a] = place
            look_at(sheet.neighbours(a) | {a})
    return sheet.arrays()


def evened_boundary(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Spaces the vertices of boundary loops evenly, about `spacing` [m] apart, by inserting and collapsing vertices."""
    sheet = EditableSheet(vertices, faces)
    for loop in boundary_loops(faces):
        _even_loop(sheet, loop.tolist(), spacing)
    return sheet.arrays()


def _even_loop(sheet: EditableSheet, loop: list[int], spacing: float) -> None:
    line = sheet.points[[*loop, loop[0]]]
    reached = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = max(5, round(reached[-1] / spacing))
    wanted = reached[-1] * np.arange(count) / count
    ring, stays = [], []
    for k, vertex in enumerate(loop):
        begin, end = reached[k], reached[k + 1]
        near = 0.02 * reached[-1] / count
        ring.append(vertex)
        stays.append(bool((np.abs(wanted - begin) < near).any()))
        after = loop[(k + 1) % len(loop)]
        for at in wanted[(wanted > begin + near) & (wanted < end - near)]:
            vertex = sheet.split(vertex, after, line[k] + (line[k + 1] - line[k]) * (at - begin) / (end - begin))
            ring.append(vertex)
            stays.append(True)
    k = 0
    while k < len(ring):
        if not stays[k]:
            before, vertex, after = ring[k - 1], ring[k], ring[(k + 1) % len(ring)]
            nearest_first = sorted((before, after), key=lambda other: sheet.length(vertex, other))
            if any(sheet.collapse(other, vertex) for other in nearest_first):
                del ring[k], stays[k]
                continue
        k += 1
