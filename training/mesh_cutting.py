"""Surface operations that garments are made with: cutting on a field, boundary loops, offsetting, remeshing."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp

from warpgarment.errors import MissingExtra


def cut_below_zero(vertices: np.ndarray, faces: np.ndarray, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keeps the part of a surface where a vertex field is positive; triangles on the zero line are split.

    Args:
        vertices: Shape [V, 3].
        faces: Shape [F, 3].
        field: Signed value per vertex, shape [V].

    Returns:
        Vertices and faces of the largest connected piece that remains.
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

    kept = [faces[count == 3]]
    for face in faces[count == 1]:
        k = int(np.argmax(inside[face]))
        i, j, l = (int(face[(k + n) % 3]) for n in range(3))
        kept.append(np.array([[i, middle(i, j), middle(i, l)]]))
    for face in faces[count == 2]:
        k = int(np.argmin(inside[face]))
        i, j, l = (int(face[(k + n) % 3]) for n in range(3))
        kept.append(np.array([[middle(i, j), j, l], [middle(i, j), l, middle(i, l)]]))
    return largest_piece(points, np.concatenate(kept))


def largest_piece(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The connected piece with the most faces, unused vertices dropped."""
    _, piece = igl.facet_components(faces.astype(np.int64))
    return compacted(vertices, faces[piece == np.bincount(np.asarray(piece).ravel()).argmax()])


def compacted(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Drops vertices that no face uses."""
    used, inverse = np.unique(faces, return_inverse=True)
    return vertices[used], inverse.reshape(-1, 3)


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """The boundary loops of a manifold surface, longest first."""
    loops = igl.boundary_loop_all(faces.astype(np.int64))
    return sorted((np.asarray(loop, dtype=np.int64) for loop in loops), key=len, reverse=True)


def averaging(faces: np.ndarray, count: int) -> sp.csr_matrix:
    """Row-stochastic matrix [count, count] that replaces each vertex by the mean of its neighbours."""
    adjacency = igl.adjacency_matrix(faces.astype(np.int64)).astype(np.float64)
    adjacency.resize((count, count))
    return sp.diags_array(1.0 / np.maximum(np.asarray(adjacency.sum(1)).ravel(), 1)) @ adjacency


def pushed_out(vertices, faces, body_vertices, body_faces, gap: float, rounds: int, smoothing: int) -> np.ndarray:
    """Alternates smoothing of the interior with moving vertices closer than `gap` [m] out to that distance."""
    points = vertices.copy()
    mean = averaging(faces, len(points))
    interior = np.ones(len(points), bool)
    for loop in boundary_loops(faces):
        interior[loop] = False
    for _ in range(rounds):
        for _ in range(smoothing):
            points[interior] = 0.5 * points[interior] + 0.5 * (mean @ points)[interior]
        distance, _, closest, *_ = igl.signed_distance(
            points, body_vertices, body_faces.astype(np.int64), sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        )
        outward = (points - closest) * np.where(distance > 0, 1.0, -1.0)[:, None]
        outward /= np.linalg.norm(outward, axis=1, keepdims=True) + 1e-12
        near = distance < gap
        points[near] = closest[near] + outward[near] * gap
    return points


def remeshed(vertices: np.ndarray, faces: np.ndarray, target_faces: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Isotropic remeshing to about `target_faces`; returns vertices, faces and the edge length aimed at [m]."""
    try:
        from gpytoolbox import remesh_botsch
    except ImportError as error:
        raise MissingExtra("physics", "Remeshing garments") from error
    area = 0.5 * np.asarray(igl.doublearea(vertices, faces.astype(np.int64))).sum()
    edge = float(np.sqrt(area * 4.0 / (np.sqrt(3.0) * target_faces)))
    points, triangles = remesh_botsch(vertices.astype(float), faces.astype(np.int32), i=12, h=edge, project=True)
    points, triangles = without_short_edges(points, triangles, 0.45 * edge)
    points, triangles = remesh_botsch(points, triangles.astype(np.int32), i=4, h=edge, project=True)
    points, triangles = without_short_edges(points, triangles, 0.4 * edge)
    return points, triangles, edge


def without_short_edges(vertices: np.ndarray, faces: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Collapses edges shorter than `limit` [m] where the surface stays a manifold; boundary vertices stay put."""
    vertices, faces = vertices.copy(), faces.astype(np.int64).copy()
    while True:
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, sharing = np.unique(edges, axis=0, return_counts=True)
        on_boundary = np.zeros(len(vertices), bool)
        on_boundary[edges[sharing == 1]] = True
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        for k in np.argsort(length):
            if length[k] > limit:
                return compacted(vertices, faces)
            a, b = edges[k]
            around_a = set(faces[(faces == a).any(1)].ravel().tolist()) - {a, b}
            around_b = set(faces[(faces == b).any(1)].ravel().tolist()) - {a, b}
            if len(around_a & around_b) != sharing[k] or (on_boundary[a] and on_boundary[b] and sharing[k] == 2):
                continue
            if on_boundary[b] and not on_boundary[a]:
                vertices[a] = vertices[b]
            elif on_boundary[a] == on_boundary[b]:
                vertices[a] = 0.5 * (vertices[a] + vertices[b])
            faces[faces == b] = a
            distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
            faces = faces[distinct]
            break
        else:
            return compacted(vertices, faces)
