"""The surface at a given distance from a body, from which garments are cut.

Moving the body's vertices along their normals folds the surface over where limbs meet. The level set of the signed
distance, `d(x) = ease(nearest body point)`, has no such folds: armpits and crotch are filled as in loose clothes.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.ndimage import gaussian_filter

from warpgarment.bodies.rest import RestBody
from warpgarment.geometry.cutting import averaging

SPACING = 0.015


@dataclass(frozen=True)
class Shell:
    """A surface around a body, and the body point below each of its vertices.

    Attributes:
        vertices: Positions [m], shape [V, 3].
        faces: Vertex indices, counter-clockwise seen from outside, shape [F, 3].
        skin: Nearest point of the body to each vertex [m], shape [V, 3].
        corners: Body vertices of the face that holds this point, shape [V, 3].
        weights: Barycentric coordinates of this point in the face, shape [V, 3].
    """

    vertices: np.ndarray
    faces: np.ndarray
    skin: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    def carried(self, values: np.ndarray) -> np.ndarray:
        """Values at body vertices, [U, ...], interpolated at :attr:`skin`, [V, ...]."""
        return np.einsum("vk,vk...->v...", self.weights, values[self.corners])


def shell(body: RestBody, ease: np.ndarray, wanted: np.ndarray) -> Shell:
    """The surface at distance `ease` from a body.

    Args:
        body: The body in its rest pose.
        ease: Distance of the surface at each body vertex [m], shape [U].
        wanted: Mask of the body vertices that the surface must surround, bool [U]; elsewhere it may be missing or open.
    """
    margin = ease.max() + 4 * SPACING
    low = body.vertices[wanted].min(0) - margin
    sizes = np.ceil((body.vertices[wanted].max(0) + margin - low) / SPACING).astype(int) + 1
    # x runs fastest, as marching_cubes expects
    z, y, x = np.meshgrid(*(low[k] + SPACING * np.arange(sizes[k]) for k in (2, 1, 0)), indexing="ij")
    grid = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    distance, *nearest = _nearest(body, grid)
    level = distance - np.einsum("vk,vk->v", nearest[2], ease[nearest[1]])
    level = gaussian_filter(level.reshape(sizes[::-1]), 0.8, mode="nearest").ravel()
    level[np.abs(level) < 1e-6] = 1e-6  # avoids faces without area
    vertices, faces, *_ = igl.marching_cubes(level, grid, *map(int, sizes), 0.0)
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    vertices = _smoothed(vertices, faces)
    return Shell(vertices, faces, *_nearest(body, vertices)[1:])


def _nearest(body: RestBody, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Signed distance [m], [N]; nearest body point [m], [N, 3]; vertices of its face, [N, 3]; its coordinates, [N, 3].

    The coordinates are barycentric in that face.
    """
    faces = body.faces.astype(np.int64)
    distance, face, closest, *_ = igl.signed_distance(
        points, body.vertices, faces, sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    )
    corners = faces[face]
    weights = igl.barycentric_coordinates(closest, *(body.vertices[corners[:, k]] for k in range(3)))
    return np.asarray(distance), np.asarray(closest), corners, np.asarray(weights).reshape(-1, 3)


def _smoothed(vertices: np.ndarray, faces: np.ndarray, rounds: int = 3) -> np.ndarray:
    """Taubin's smoothing (lambda 0.5, mu -0.53), which removes the steps of the grid without shrinking."""
    mean = averaging(faces, len(vertices))
    for _ in range(rounds):
        for step in (0.5, -0.53):
            vertices = vertices + step * (mean @ vertices - vertices)
    return vertices
