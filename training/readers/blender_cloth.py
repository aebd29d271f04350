"""Blender's settings of a recorded cloth in SI units.

These are the equations of `teachers.blender.units`, solved for the SI quantities, with S units of length per metre, f
frames per second, and k the ratio of Blender's mass of a vertex to its mass in kg:

    springs    K = T f^2 / (k S e)                Young's modulus K (sum of L^2) / (3 A), Poisson's ratio 1/3
    bending    B = b h f^2 / (30 k)
    wind       w^2 = 2 (0.02 S f s) / (rho cd k)  the steady wind with the same pressure on cloth at rest

T, b and s are Blender's tension stiffness, bending stiffness and strength of wind; L are edge lengths and e is their
mean; h is the mean height of triangles and A the area. Motion and clock stay as recorded. A recording does not
determine k: an outfit twice as heavy and twice as stiff moves alike in air twice as dense. k is chosen so that an
outfit of D-LAYERS' middle mass weighs as much as an ordinary fabric; only the proportions are meaningful.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from warpgarment.kernels.wind import AIR_DENSITY, DRAG
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from .fields import LARGEST

MIDDLE_MASS = 0.5  # middle of D-LAYERS' range of Blender's mass of a vertex, 0.2 to 0.8


def mass_ratio(garments: Sequence[Garment]) -> float:
    """The ratio k of an outfit that has the middle mass at each vertex and the default density.

    Args:
        garments: Garments with rest meshes at life size [m].

    Returns:
        Blender's mass of a vertex over its mass in kg [1/kg].
    """
    vertices = sum(len(garment.vertices) for garment in garments)
    return MIDDLE_MASS * vertices / (Material().density * sum(map(_area, garments)))


def blender_material(
    cloth: Mapping[str, Any], garment: Garment, *, ratio: float, friction: float | None, scale: float, fps: float
) -> Material | None:
    """The cloth that moves at life size as a cloth with these settings of Blender moves at Blender's scale.

    Args:
        cloth: Settings by Blender's names: mass, tension_stiffness, bending_stiffness, self_friction.
        garment: Garment with its rest mesh at life size [m].
        ratio: Ratio k of the outfit [1/kg].
        friction: Blender's friction of the body; None takes the cloth's own.
        scale: Units of length per metre in the simulation.
        fps: Frames per second.

    Returns:
        The material in SI units; None if a setting is missing or does not describe a cloth.
    """
    numbers: list[Any] = [cloth.get(key) for key in ("mass", "tension_stiffness", "bending_stiffness", "self_friction")]
    if friction is not None:
        numbers[3] = friction
    if not all(isinstance(n, (int, float)) and 0 <= n <= LARGEST for n in numbers) or 0 in numbers[:2]:
        return None
    mass, tension, bending, friction = map(float, numbers)
    area, lengths = _area(garment), _edge_lengths(garment)
    edge = float(lengths.mean())
    spring = tension * fps**2 / (ratio * scale * edge)
    lame = spring * float((lengths**2).sum()) / (8.0 * area)  # both Lame parameters: 3/8 of Young's modulus
    height = 2.0 * area / len(garment.faces) / edge
    return Material(
        density=mass * len(garment.vertices) / (ratio * area),
        stretch=lame,
        shear=lame,
        bend=bending * height * fps**2 / (30.0 * ratio),
        friction=friction / 100.0,
    )


def wind_speed(strength: float, *, ratio: float, scale: float, fps: float) -> float:
    """The speed of the wind [m/s] with the same pressure on cloth at rest as Blender's wind.

    Args:
        strength: Strength of Blender's wind field.
        ratio: Ratio k of the outfit [1/kg].
        scale: Units of length per metre in the simulation.
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
