"""Where cloth is behind a body or an inner garment: as LayersNet was published, and by surfaces.

**Published**: a vertex collides if it is behind the plane of the nearest *vertex* of the other mesh, whose normal is
the mean of the normals of its faces, weighted by area. There is no limit of distance: a hem that hangs freely can lie
behind the plane of a knee, and the recording itself collides.

**By surfaces**: inside the body by the winding number of its surface (libigl), and beneath an inner garment, at most
`DEEPEST` from it, by the side of the nearest point of all its faces. There the normal is that of the face, of both
faces of an edge, or of all faces at a vertex weighted by angle (Baerentzen and Aanaes 2005). Beyond the border of a
garment there are no sides, so a vertex whose nearest point is on the border does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.spatial import cKDTree

DEEPEST = 0.03  # how far beneath an inner garment cloth counts [m]
EDGE = 1e-6  # barycentric coordinate below which a point is on an edge


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of vertices, not of unit length: the sum of their faces' normals weighted by area [m^2], [V,3]."""
    normal = face_normals(vertices, faces)
    total = np.zeros(np.shape(vertices))
    for k in range(3):
        np.add.at(total, faces[:, k], normal)
    return total


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of faces, twice as long as their area [m^2], [F,3]."""
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def behind_planes(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether points are behind the plane of the nearest vertex of a mesh, bool [P].

    Args:
        points: Points [m], shape [P,3].
        vertices: Vertices of the mesh [m], shape [V,3].
        faces: Vertex indices, counter-clockwise from outside, shape [F,3].
    """
    points, vertices = np.asarray(points, np.float64), np.asarray(vertices, np.float64)
    _, nearest = cKDTree(vertices).query(points)
    normal = vertex_normals(vertices, faces)[nearest]
    return np.einsum("ni,ni->n", normal, points - vertices[nearest]) < 0.0


def inside(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether points are inside a body whose faces look outwards, bool [P]; its openings count as closed."""
    body = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    return np.asarray(igl.fast_winding_number(*body, np.ascontiguousarray(points, np.float64))).reshape(-1) > 0.5


@dataclass(frozen=True)
class Surface:
    """A garment to which sides are asked; made by `of`.

    Attributes:
        faces: Vertex indices, int64 [F,3].
        across: Face across the edge opposite to each corner, int64 [F,3]; -1 on the border.
        border: Whether a vertex is on the border, bool [V].
    """

    faces: np.ndarray
    across: np.ndarray
    border: np.ndarray

    @classmethod
    def of(cls, faces: np.ndarray, count: int) -> Surface:
        """The surface of a garment of `count` vertices. An edge of three faces and more counts as border."""
        faces = np.asarray(faces, np.int64)
        edges = np.sort(faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)  # edge k is opposite to corner k
        order = np.lexsort(edges.T)
        runs = np.flatnonzero(np.r_[True, (np.diff(edges[order], axis=0) != 0).any(axis=1), True])
        across = np.full(len(edges), -1)
        for size_two in runs[:-1][np.diff(runs) == 2]:
            first, second = order[size_two], order[size_two + 1]
            across[first], across[second] = second // 3, first // 3
        border = np.zeros(count, bool)
        border[edges[across < 0]] = True
        return cls(faces, across.reshape(-1, 3), border)


def beneath(points: np.ndarray, vertices: np.ndarray, surface: Surface, deepest: float = DEEPEST) -> np.ndarray:
    """Whether points are on the inner side of a garment and near it, bool [P].

    Args:
        points: Points [m], shape [P,3].
        vertices: Vertices of the garment [m], shape [V,3].
        surface: The garment's surface.
        deepest: Largest distance from it [m].
    """
    points, vertices = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(vertices, np.float64)
    faces = surface.faces
    squared, face, nearest = igl.point_mesh_squared_distance(points, vertices, faces)
    face = np.asarray(face).reshape(-1)
    normals = face_normals(vertices, faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    share = barycentric(nearest, vertices[faces[face]])
    zero = share < EDGE
    normal = normals[face].copy()
    at_border = np.zeros(len(points), bool)
    at_vertices = angle_weighted(vertices, faces, normals)
    for k in range(3):
        edge = zero[:, k] & (zero.sum(axis=1) == 1)
        other = surface.across[face[edge], k]
        normal[edge] += np.where(other[:, None] >= 0, normals[other], 0.0)
        at_border[edge] = other < 0
        corner = zero[:, k - 1] & zero[:, k - 2]
        vertex = faces[face[corner], k]
        normal[corner] = at_vertices[vertex]
        at_border[corner] = surface.border[vertex]
    side = np.einsum("ni,ni->n", normal, points - nearest)
    return (side < 0.0) & ~at_border & (np.asarray(squared).reshape(-1) <= deepest**2)


def angle_weighted(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Sum of the unit normals of the faces at each vertex, weighted by their angle there [rad], [V,3]."""
    total = np.zeros(vertices.shape)
    for k in range(3):
        a, b, c = (vertices[faces[:, (k + j) % 3]] for j in range(3))
        one, other = b - a, c - a
        angle = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), np.einsum("ni,ni->n", one, other))
        np.add.at(total, faces[:, k], angle[:, None] * normals)
    return total


def barycentric(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of points [P,3] in the planes of triangles [P,3,3], shape [P,3]."""
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = np.cross(u, v)
    area = np.maximum(np.einsum("ni,ni->n", normal, normal), 1e-300)
    w = points - a
    second = np.einsum("ni,ni->n", np.cross(w, v), normal) / area
    third = np.einsum("ni,ni->n", np.cross(u, w), normal) / area
    return np.stack([1.0 - second - third, second, third], axis=1)
