"""What Blender's settings of a recorded cloth come to in SI units.

The equations of `teachers.blender_units`, solved for the other side, with S units of length to the metre, f frames a
second, and k the ratio of Blender's mass of a vertex to its mass in kg:

    springs    K = T f^2 / (k S e)                Young's modulus K (sum of L^2) / (3 A), Poisson's ratio 1/3
    bending    B = b h f^2 / (30 k)
    wind       w^2 = 2 (0.02 S f s) / (rho cd k)  the steady wind that presses as hard on cloth at rest

(T, b, s Blender's tension and bending stiffness and strength of wind; L edge lengths, e their mean, h the mean height
of triangles, A the area.) Motion and clock stay as recorded. What a recording cannot tell is k: an outfit twice as
heavy, twice as stiff, in air twice as dense moves alike. It is chosen so that an outfit of D-LAYERS' middle mass weighs
what an ordinary fabric does; only proportions are meant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from warpgarment.kernels.wind import AIR_DENSITY, DRAG
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

MIDDLE_MASS = 0.5  # of D-LAYERS' 0.2 to 0.8, Blender's mass of a vertex


def mass_ratio(garments: Sequence[Garment]) -> float:
    """k for an outfit: the middle mass for each vertex and the default density for all of the cloth.

    Args:
        garments: Rest meshes at life size [m].
    """
    vertices = sum(len(garment.vertices) for garment in garments)
    return MIDDLE_MASS * vertices / (Material().density * sum(map(_area, garments)))


def blender_material(
    cloth: Mapping[str, Any], garment: Garment, *, ratio: float, friction: float | None, scale: float, fps: float
) -> Material | None:
    """The cloth that moves at life size as one with these settings of Blender does at its scale.

    Args:
        cloth: Settings by Blender's names: mass, tension_stiffness, bending_stiffness, self_friction.
        garment: Rest mesh at life size [m].
        ratio: k, of the outfit.
        friction: Blender's friction of the body; None: the cloth's own.
        scale: Units of length to the metre in the simulation.
        fps: Frames per second.

    Returns:
        None where a setting is missing or makes no cloth.
    """
    numbers: list[Any] = [cloth.get(key) for key in ("mass", "tension_stiffness", "bending_stiffness", "self_friction")]
    if friction is not None:
        numbers[3] = friction
    if not all(isinstance(n, (int, float)) and np.isfinite(n) and n >= 0 for n in numbers) or 0 in numbers[:2]:
        return None
    mass, tension, bending, friction = map(float, numbers)
    area, lengths = _area(garment), _edge_lengths(garment)
    edge = float(lengths.mean())
    spring = tension * fps**2 / (ratio * scale * edge)
    lame = spring * float((lengths**2).sum()) / (8.0 * area)  # both of them: 3/8 of Young's modulus
    height = 2.0 * area / len(garment.faces) / edge
    return Material(
        density=mass * len(garment.vertices) / (ratio * area),
        stretch=lame,
        shear=lame,
        bend=bending * height * fps**2 / (30.0 * ratio),
        friction=friction / 100.0,
    )


def wind_speed(strength: float, *, ratio: float, scale: float, fps: float) -> float:
    """The wind [m/s] that presses on cloth at rest as Blender's wind of a strength does.

    Args:
        strength: Of Blender's field.
        ratio: k, of the outfit.
        scale: Units of length to the metre in the simulation.
        fps: Frames per second.
    """
    return float(np.sqrt(2.0 * 0.02 * scale * fps * max(strength, 0.0) / (AIR_DENSITY * DRAG * ratio)))


def _area(garment: Garment) -> float:
    corners = garment.vertices.astype(np.float64)[garment.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * float(np.linalg.norm(cross, axis=1).sum())


def _edge_lengths(garment: Garment) -> np.ndarray:
    ends = garment.vertices.astype(np.float64)[garment.edges]
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
