"""Where a garment is deepest in a body, and whether the body leaves room for cloth there.

A body that goes through itself (an arm in the torso, a hand in a thigh) has places from which every short way out leads
into another part of it: winding numbers of 2 and more, or surfaces that lie inside. Parts that do not quite touch leave
less room than cloth keeps on both sides. At such places no cloth can be free, whatever a simulation does.

| symbol | code | what |
| --- | --- | --- |
| w(p) | `_winding` | winding number of the body's surface about a point: the number of parts that hold it |
| c, n | `closest`, `outward` | point of the surface that is nearest to a place, and the outward normal there |
"""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np

LIFT = 5e-4
"""How far from the surface it is asked whether another part is there [m]."""
NEAR = 0.1
"""How far from the place the body's own crossing is measured [m]."""


class DeepPlace(NamedTuple):
    """The deepest point of a garment in a body.

    Attributes:
        depth: Its distance from the surface [m]; 0 where nothing is inside.
        place: Where it is [m], [3].
        parts: Number of parts of the body that hold it.
        through: How far the body goes through itself within 10 cm of it [m]: the largest distance of a point of its
            surface that lies inside to one that does not.
        room: Room between the surface there and what is opposite [m]; infinite where nothing is.
    """

    depth: float
    place: np.ndarray
    parts: int
    through: float
    room: float

    def free(self, keep: float) -> bool:
        """Whether cloth can be free there that keeps `keep` from the body [m], with 1 mm to spare."""
        return self.parts < 2 and self.through < 1e-3 and self.room > 2 * keep + 1e-3


def deep_place(points: np.ndarray, faces: np.ndarray, body: np.ndarray, body_faces: np.ndarray) -> DeepPlace:
    """Finds the deepest of the vertices, middles of edges and of faces of a garment.

    Args:
        points: Positions of the garment [m], [V,3].
        faces: Vertex indices, [F,3].
        body: Positions of the body [m], [U,3].
        body_faces: Vertex indices, [G,3], counter-clockwise seen from outside.
    """
    corner = np.asarray(points, np.float64)[faces]
    middles = 0.5 * (corner + np.roll(corner, -1, axis=1))
    at = np.concatenate([np.asarray(points, np.float64), middles.reshape(-1, 3), corner.mean(axis=1)])
    surface, triangles = np.asarray(body, np.float64), np.asarray(body_faces, np.int64)
    squared, face, closest = igl.point_mesh_squared_distance(at, surface, triangles)
    inside = _winding(surface, triangles, at) > 0.5
    if not inside.any():
        return DeepPlace(0.0, at[0], 0, 0.0, np.inf)
    one = int(np.where(inside, squared, -1.0).argmax())
    place = at[one]
    parts = round(float(_winding(surface, triangles, place[None])[0]))
    normals = igl.per_face_normals(surface, triangles, np.zeros(3))
    outward = normals[face[one]]
    return DeepPlace(
        float(np.sqrt(squared[one])),
        place,
        parts,
        through_itself(surface, triangles, place),
        _room(surface, triangles, normals, closest[one], outward),
    )


def _winding(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.asarray(igl.fast_winding_number(vertices, faces, np.ascontiguousarray(points))).reshape(-1)


def through_itself(vertices: np.ndarray, faces: np.ndarray, place: np.ndarray | None = None) -> float:
    """How far a body goes through itself [m]: the largest distance of a point of its surface that lies in another part
    of it to one that does not; 0 where there is none.

    Args:
        vertices: Positions of the body [m], [U,3].
        faces: Vertex indices, [G,3], counter-clockwise seen from outside.
        place: A place [m], [3], of which only what is within 10 cm counts; None: all of it counts.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    near = np.ones(len(vertices), bool)
    if place is not None:
        near = np.linalg.norm(vertices - place, axis=1) < NEAR
    if not near.any():
        return 0.0
    normals = igl.per_vertex_normals(vertices, faces)
    held = _winding(vertices, faces, vertices + LIFT * normals) > 0.5
    free = faces[~held[faces].any(axis=1)]
    if not (held & near).any() or not len(free):
        return 0.0
    return float(np.sqrt(igl.point_mesh_squared_distance(vertices[held & near], vertices, free)[0]).max())


def _room(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, closest: np.ndarray, outward: np.ndarray
) -> float:
    """Room from a point of the surface along its normal to the next face that looks back at it [m]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    facing = normals @ outward
    first, second, away = b - a, c - a, closest - a
    across = np.cross(outward, second)
    size = (first * across).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = (away * across).sum(axis=1) / size
        other = np.cross(away, first)
        v = (other @ outward) / size
        t = (second * other).sum(axis=1) / size
        hit = (facing < 0.0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return float(t[hit].min(initial=np.inf))
