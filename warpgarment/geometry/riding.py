"""Small loose pieces of a garment, such as buttons and zips: which they are, and how the cloth below carries them.

A piece is small beside the largest piece of the garment, and close to the cloth. One that is compact stays rigid. A
long one, such as a zip, bends with the cloth: each of its vertices is carried alone. What is carried keeps its place
relative to the nearest point of the cloth, and turns with the faces around that:

    p(t) = q(t) + R(t) (p(0) - q(0)),    q = sum_k b_k x_k on the nearest face
    R(t) = the rotation that carries the faces near q from their shape at 0 to that at t best (Kabsch 1976)

A single small triangle would pass on every tremble; the faces around it do not.
"""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np
from scipy.sparse import csr_matrix

AREA = 0.02
"""Largest area of a piece that is carried, as a share of that of the largest piece."""
COMPACT = 0.06
"""Largest size (diagonal of the bounding box) of one that stays rigid, as a share of that of the largest piece."""
NEAR = 0.02
"""Farthest that a compact piece is from the cloth at its nearest vertex, and a long one at its farthest, likewise."""


class Loose(NamedTuple):
    """Which vertices ride on the cloth."""

    unit: np.ndarray
    """What moves each vertex: vertices of one rigid piece have the same number from 0 on, -1 is cloth, int64 [V]."""
    pieces: int
    """Number of pieces that ride."""
    far: int
    """Number of pieces as small that are too far from the cloth, and stay cloth."""


def loose_pieces(vertices: np.ndarray, faces: np.ndarray, held: np.ndarray | None = None) -> Loose:
    """Finds the pieces that ride on the cloth.

    Args:
        vertices: Positions at rest [m], shape [V,3], finite; one without a face is a piece.
        faces: Vertex indices, shape [F,3].
        held: Vertices whose pieces are to stay cloth, such as pins, shape [P].
    """
    from warpgarment.kernels.mesh.laplacian import components  # loads torch, which naming a garment need not

    of_vertex, of_face, count = components(len(vertices), faces)
    unit = np.full(len(vertices), -1)
    if count < 2 or len(faces) == 0:
        return Loose(unit, 0, 0)
    points = np.asarray(vertices, np.float64)
    corners = points[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    area = np.bincount(of_face, area, count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, of_vertex, points)
    np.maximum.at(high, of_vertex, points)
    size = np.linalg.norm(high - low, axis=1)
    largest = int(np.argmax(area))
    small = area <= AREA * area[largest]
    if held is not None:
        small[of_vertex[held]] = False
    if not small.any():
        return Loose(unit, 0, 0)

    mine = np.flatnonzero(small[of_vertex])
    cloth = np.ascontiguousarray(faces[~small[of_face]], np.int64)
    distance = np.sqrt(igl.point_mesh_squared_distance(points[mine], points, cloth)[0])
    nearest, farthest = np.full(count, np.inf), np.zeros(count)
    np.minimum.at(nearest, of_vertex[mine], distance)
    np.maximum.at(farthest, of_vertex[mine], distance)
    compact = size <= COMPACT * size[largest]
    rides = small & (np.where(compact, nearest, farthest) <= NEAR * size[largest])
    rigid, single = rides & compact, (rides & ~compact)[of_vertex]
    number = np.cumsum(rigid) - 1
    unit = np.where(rigid[of_vertex], number[of_vertex], -1)
    unit[single] = np.count_nonzero(rigid) + np.arange(np.count_nonzero(single))
    return Loose(unit, int(np.count_nonzero(rides)), int(np.count_nonzero(small & ~rides)))


class Carried:
    """Points that cloth carries.

    Args:
        points: At rest [m], shape [P,3].
        unit: Points of one number stay rigid, 0 to the largest, shape [P].
        cloth: Vertices of the cloth at rest [m], shape [V,3].
        faces: Of the cloth, shape [F,3].
    """

    def __init__(self, points: np.ndarray, unit: np.ndarray, cloth: np.ndarray, faces: np.ndarray) -> None:
        points, cloth = np.asarray(points, np.float64), np.asarray(cloth, np.float64)
        faces = np.ascontiguousarray(faces, np.int64)
        self._unit, count = unit, int(unit.max()) + 1
        total = np.stack([np.bincount(unit, points[:, k], count) for k in range(3)], 1)
        anchor = np.ascontiguousarray(total / np.bincount(unit, minlength=count)[:, None])
        _, face, foot = igl.point_mesh_squared_distance(anchor, cloth, faces)
        self._corners = faces[face]
        a, b, c = (np.ascontiguousarray(cloth[self._corners[:, k]]) for k in range(3))
        self._weights = igl.barycentric_coordinates(foot.reshape(-1, 3), a, b, c).reshape(-1, 3)
        self._around = _around(igl.point_mesh_squared_distance(points, cloth, faces)[1], unit, faces, len(cloth))
        self.bind(points, cloth)

    def bind(self, points: np.ndarray, cloth: np.ndarray) -> None:
        """Takes a frame as the one from which points [P,3] are carried by the cloth [V,3], both in metres."""
        self._cloth = np.asarray(cloth, np.float64)
        self._offset = np.asarray(points, np.float64) - self._foot(self._cloth)[self._unit]

    def at(self, cloth: np.ndarray) -> np.ndarray:
        """Where the points are when the cloth is there; [V,3] -> float64 [P,3] in metres, NaN if cloth is not finite.

        Args:
            cloth: Positions [m], shape [V,3].
        """
        cloth = np.asarray(cloth, np.float64)
        if not np.isfinite(cloth).all():
            return np.full((len(self._unit), 3), np.nan)
        turned = np.einsum("pij,pj->pi", self._rotations(cloth)[self._unit], self._offset)
        return np.asarray(self._foot(cloth)[self._unit] + turned)

    def _foot(self, cloth: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("uk,ukc->uc", self._weights, cloth[self._corners]))

    def _rotations(self, cloth: np.ndarray) -> np.ndarray:
        """How the cloth around each unit has turned since `bind`, [U,3,3]."""
        middle = self._cloth.mean(0), cloth.mean(0)
        before, after = self._cloth - middle[0], cloth - middle[1]
        products = (after[:, :, None] * before[:, None, :]).reshape(len(cloth), 9)
        centre = self._around @ after, self._around @ before
        covariance = (self._around @ products).reshape(-1, 3, 3) - centre[0][:, :, None] * centre[1][:, None, :]
        u, _, v = np.linalg.svd(covariance)
        u[..., 2] *= np.sign(np.linalg.det(u @ v))[..., None]
        return np.asarray(u @ v)


def _around(nearest: np.ndarray, unit: np.ndarray, faces: np.ndarray, count: int) -> csr_matrix:
    """Weights [U,V], rows summing to 1, of the vertices of the faces that touch those nearest to the unit's points."""
    units = int(unit.max()) + 1
    under = csr_matrix((np.ones(len(unit)), (unit, np.asarray(nearest).reshape(-1))), shape=(units, len(faces)))
    rows = np.repeat(np.arange(len(faces)), 3)
    corners = csr_matrix((np.ones(3 * len(faces)), (rows, faces.reshape(-1))), shape=(len(faces), count))
    around = under @ corners @ corners.T @ corners
    around.data[:] = 1.0
    weights = np.repeat(1.0 / np.diff(around.indptr), np.diff(around.indptr))
    return csr_matrix((weights, around.indices, around.indptr), shape=around.shape)
