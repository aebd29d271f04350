"""Geodesic distances of large garments, pooled: between a few thousand centres, and from every face to those near it.

The kernel exp(-(D/r)^p) of the manifold heads is smooth but wide: truncated at 1e-3 it still keeps a third to a half of
all pairs of a garment. So it is interpolated instead, on both sides,

    exp(-(D/r)^p)  ~  P exp(-(D_c/r)^p) P^T        D_c [C,C] distances between centres, P [F,C] with NEAR entries a row

1. Centres are chosen one after another, each the face furthest from all before it.
2. Distances are computed from each centre to the faces near it, and chained over centres with Dijkstra's algorithm, as
   in `geodesics.py` over faces.
3. A row of P is the moving least squares fit of a quadratic in the face's tangent plane, taken at its centroid
   (Levin 1998): exact for quadratics, and its entries sum to one.

Memory and time grow with the number of faces. With 4,096 centres on a dress of 7,000 faces, the weights differ from the
dense result, in rows' L1 norm over 64 rows, by 1.7e-3 on average and 1.6e-2 at worst for p = 2, r = 0.15 m, and by 2e-4
and 8e-4 for p = 20, r = 1 m. (The dense result itself differs by 1.2e-3 and 1.6e-3 from that of exact geodesics for
p = 2, on a T-shirt of 1,354 faces.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from warpgarment.kernels.mesh.shortest_paths import Paths

from .geodesics import checked_mesh, searches

CENTRES = 4096  # largest number of centres; D_c takes 64 MiB
NEAR = 12  # number of centres from which a face is interpolated
NEAR_REACH, CHAIN_REACH = 3.0, 6.0  # largest distance of these, and of links between centres, in fill distances
LARGEST_ROW = 6.0  # sum of absolute entries of a row of P, beyond which it is replaced by a plain mean
VERSION = 3  # raise it whenever the result changes: it is part of the name under which results are kept


class PooledGeodesics(NamedTuple):
    """Result of `pooled_geodesics`; it does not depend on the radius and power of the weights."""

    distances: np.ndarray  # float32 [C,C], distances between centres [m]; inf between components
    nearest: np.ndarray  # int32 [F,NEAR], centres near each face; 0 where the weight is 0
    weight: np.ndarray  # float32 [F,NEAR], weights of these centres; rows sum to one

    @property
    def faces(self) -> int:
        """Number of faces F."""
        return len(self.nearest)


def pooled_geodesics(rest_vertices: Any, faces: Any, centres: int = CENTRES) -> PooledGeodesics:
    """Distances between centres, and the interpolation from them to all faces.

    Args:
        rest_vertices: Positions [m], shape [V,3]; NumPy or torch.
        faces: Vertex indices of an oriented manifold mesh, shape [F,3].
        centres: Number of centres; a mesh with fewer faces gets one centre per face.

    Raises:
        MeshError: As in `face_geodesics`, except for the limit on the number of faces.
    """
    vertices, faces = checked_mesh(rest_vertices, faces)
    corners = vertices.astype(np.float64)[faces]
    chosen, fill = _furthest_points(corners.mean(axis=1), faces, min(centres, len(faces)))
    number = np.full(len(faces), -1)
    number[chosen] = np.arange(len(chosen))
    links, near = [], []
    for block, inside, part in searches(vertices, faces, chosen, CHAIN_REACH * fill):
        is_centre = np.nonzero(number[inside] >= 0)[0]
        row, column = np.nonzero(np.isfinite(part[:, is_centre]))
        links.append((number[block[row]], number[inside[is_centre[column]]], part[row, is_centre[column]]))
        row, column = np.nonzero(part <= NEAR_REACH * fill)
        near.append((inside[column].astype(np.int32), number[block[row]].astype(np.int32), part[row, column]))
    source, target, length = (np.concatenate(parts) for parts in zip(*links, strict=True))
    graph = csr_matrix((length.astype(np.float64), (source, target)), shape=(len(chosen),) * 2)
    distances = Paths(graph, np.arange(len(chosen))).distances(np.arange(len(chosen)))
    np.minimum(distances, distances.T, out=distances)
    index, length = _nearest(len(faces), *(np.concatenate(parts) for parts in zip(*near, strict=True)))
    return PooledGeodesics(distances, index, _interpolation(corners, chosen, index, length))


def _furthest_points(centroids: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, float]:
    """Faces far from each other, ascending, and the distance [m] within which every face has one of them.

    Distances are those of walks from face to face over edges. They are too long, but sufficient to spread the chosen
    faces, and every connected piece gets at least one.
    """
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    key = edges[:, 0] * (edges.max() + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = np.nonzero(key[order][1:] == key[order][:-1])[0]
    a, b = order[same] // 3, order[same + 1] // 3
    step = np.linalg.norm(centroids[a] - centroids[b], axis=1)
    dual = csr_matrix((np.r_[step, step], (np.r_[a, b], np.r_[b, a])), shape=(len(faces),) * 2)
    away = dijkstra(dual, indices=0)
    chosen = [0]
    while len(chosen) < count or np.isinf(away).any():
        furthest = int(away.argmax())
        away = np.minimum(away, dijkstra(dual, indices=furthest, limit=away[furthest]))
        away[furthest] = 0.0
        chosen.append(furthest)
    return np.sort(chosen), max(float(away.max()), float(step.max(initial=1e-6)))


def _nearest(count: int, face: np.ndarray, centre: np.ndarray, length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The NEAR nearest centres of each face and their distances, shape [F,NEAR]; inf where there are fewer."""
    order = np.lexsort((centre, length, face))
    face, centre, length = face[order], centre[order], length[order]
    place = np.arange(len(face)) - np.searchsorted(face, face)
    keep = place < NEAR
    index, distance = np.zeros((count, NEAR), np.int32), np.full((count, NEAR), np.inf, np.float32)
    index[face[keep], place[keep]], distance[face[keep], place[keep]] = centre[keep], length[keep]
    return index, distance


def _interpolation(corners: np.ndarray, chosen: np.ndarray, index: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Rows of P, float32 [F,NEAR], without unit."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    e1 = e1 / np.linalg.norm(e1, axis=1, keepdims=True)
    e2 = e2 - (e1 * e2).sum(axis=1, keepdims=True) * e1
    e2 /= np.linalg.norm(e2, axis=1, keepdims=True)
    centroids, result = corners.mean(axis=1), np.empty(index.shape, np.float32)
    for start in range(0, len(index), 20_000):
        part = slice(start, start + 20_000)
        real = np.isfinite(length[part])
        d = np.where(real, length[part], 0.0).astype(np.float64)
        size = 1.05 * d.max(axis=1, keepdims=True) + 1e-12
        offset = centroids[chosen[index[part]]] - centroids[part, None]
        x, y = (np.einsum("fmc,fc->fm", offset, axis[part]) / size for axis in (e1, e2))
        basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=2)
        share = d / size
        weight = np.where(real, (1 - share) ** 4 * (4 * share + 1), 0.0)  # Wendland's C2 function
        moments = np.einsum("fm,fmi,fmj->fij", weight, basis, basis)
        moments += 1e-6 * np.eye(6) * np.trace(moments, axis1=1, axis2=2)[:, None, None]
        unit = np.zeros((len(d), 6, 1))
        unit[:, 0] = 1.0
        row = weight * np.einsum("fmi,fi->fm", basis, np.linalg.solve(moments, unit)[..., 0])
        total = row.sum(axis=1, keepdims=True)
        bad = (np.abs(row).sum(axis=1, keepdims=True) > LARGEST_ROW * total) | (total < 0.5)
        row = np.where(bad, weight, row)
        result[part] = row / row.sum(axis=1, keepdims=True)
    return result
