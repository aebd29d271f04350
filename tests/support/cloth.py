"""Small scenes for the tests of teachers."""

from __future__ import annotations

import igl
import numpy as np

from support import meshes
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.training.teachers import Cloth, ClothScene
from warpgarment.training.teachers.checks import flat_sheet, hanging_sheet

BALL = meshes.icosphere(2, 0.15)


def on_ball(path: np.ndarray, *cloths: Cloth, **options) -> ClothScene:
    """Cloths, by default a sheet of 0.5 m, on a ball whose centre moves along a path [m], [T, 3]."""
    frames = (BALL.vertices[None] + np.asarray(path)[:, None]).astype(np.float32)
    options.setdefault("settle", 1)
    return ClothScene(cloths or (sheet(0.5, 0.17),), frames, BALL.faces, **options)


def sheet(size: float, height: float, cells: int = 10, **material: float) -> Cloth:
    """A square sheet facing up; size of its side and height in metres."""
    edge = size / cells
    return Cloth(flat_sheet(size, edge, height=height), edge, material=Material(**material))


def flag(frames: int = 6, wind=(0.0, 0.0, 0.0), **options) -> ClothScene:
    """A flag 0.3 m long in the plane z = 0, pinned along x = 0, without a body.

    `wind` [m/s] is one velocity for all frames, [3], or one per frame, [T, 3].
    """
    edge = 0.05
    hung = hanging_sheet(0.2, 0.3, edge)
    turned = np.stack([-hung.vertices[:, 1], hung.vertices[:, 0], hung.vertices[:, 2]], 1)
    garment = Garment(turned, hung.faces, pins=hung.pins, name="flag")
    options.setdefault("settle", 0)
    air = np.broadcast_to(np.asarray(wind, float), (frames, 3))
    return ClothScene((Cloth(garment, edge),), frames=frames, wind=air, **options)


def still(frames: int) -> np.ndarray:
    """A path that stays at the origin, [T, 3]."""
    return np.zeros((frames, 3))


def stretch(garment: Garment, vertices: np.ndarray) -> np.ndarray:
    """Relative change of the length of every edge, [..., E]."""
    ends, rest = vertices[..., garment.edges, :].astype(np.float64), garment.vertices[garment.edges].astype(np.float64)
    return np.linalg.norm(np.diff(ends, axis=-2), axis=-1)[..., 0] / np.linalg.norm(rest[:, 1] - rest[:, 0], axis=1) - 1


def outside(vertices: np.ndarray, body: np.ndarray) -> float:
    """The least signed distance to the ball [m]."""
    return igl.signed_distance(
        vertices.astype(float),
        body.astype(float),
        BALL.faces.astype(np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )[0].min()
