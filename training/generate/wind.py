"""Gusty wind: the velocity of the air in each frame of a sequence, drawn once and then a pure function of time.

    wind = sampled_wind(np.random.default_rng(3))
    scene = ClothScene(cloths, body, faces, wind=wind.velocities(len(body), 30.0))

**From Blender's strengths to metres per second.** Blender's wind exerts a force on a face that does not depend on the
face's velocity: 0.02/30 of its own force units per square metre and unit of strength (measured on a free sheet in
Blender 4.5; equal at 1,000 and 2,000, at twice the mass and on a coarser mesh, within 3 %). With the units of
:mod:`training.materials` (one of its masses is a gram at life size) that is a pressure of S scale² 0.02/30 [Pa], and
:func:`speed_of_strength` gives the wind whose drag head-on, ½ ρ C_D v², equals it. D-LAYERS does not publish its
strengths. Strengths at which cloth moves well, 1,000 to 20,000 at life size, are 1.0 to 4.3 m/s; in a scene ten times
as large these numbers are 9.5 to 43 m/s, since the faces are a hundred times as large and the masses are not.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from warpgarment.kernels.wind import AIR_DENSITY, DRAG

BLENDER_PRESSURE = 0.02 / 30
"""Pressure of a unit of Blender's wind strength, head-on, in its force units per square metre."""

_HARMONICS = np.array([1.0, 1.618, 2.618])  # frequencies relative to the slowest gust; the sum is not periodic
_WEIGHTS = np.array([0.5, 0.3, 0.2])


@dataclass(frozen=True)
class Wind:
    """Air that moves the same everywhere, in a direction and at a speed that vary smoothly in time.

    Attributes:
        direction: Direction to which the wind blows, of any length except zero; Y is up.
        strength: Mean speed [m/s].
        gusts: Amplitude of the speed about its mean, as a share of the mean, 0 to 1.
        turn: Amplitude of the direction about Y [rad].
        period: Period of the slowest oscillation [s].
        phases: Phases of the three oscillations of the speed and the three of the direction [rad].
    """

    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    strength: float = 0.0
    gusts: float = 0.0
    turn: float = 0.0
    period: float = 3.0
    phases: tuple[float, ...] = (0.0,) * 6

    def __post_init__(self) -> None:
        length = math.hypot(*self.direction)
        if not (math.isfinite(length) and length > 0):
            raise ValueError(f"the wind's direction {self.direction} has no length")
        if self.strength < 0 or not 0 <= self.gusts <= 1 or self.period <= 0:
            raise ValueError(
                f"strength {self.strength} must not be negative, gusts {self.gusts} lie in 0..1, "
                f"period {self.period} be positive"
            )

    def velocities(self, frames: int, fps: float = 30.0) -> np.ndarray:
        """Velocity of the air in each frame [m/s], float32 [T, 3]."""
        time = np.arange(frames) / fps
        speed = self.strength * (1.0 + self.gusts * self._swing(time, self.phases[:3]))
        yaw = self.turn * self._swing(time, self.phases[3:])
        x, y, z = np.asarray(self.direction, np.float64) / math.hypot(*self.direction)
        turned = np.stack([x * np.cos(yaw) + z * np.sin(yaw), np.full(frames, y), z * np.cos(yaw) - x * np.sin(yaw)], 1)
        return (speed[:, None] * turned).astype(np.float32)

    def _swing(self, time: np.ndarray, phases: tuple[float, ...]) -> np.ndarray:
        """Sum of three sines at times [s], shape [T], between -1 and 1."""
        angle = 2.0 * np.pi / self.period * time[:, None] * _HARMONICS + np.asarray(phases)
        return np.sin(angle) @ _WEIGHTS

    def as_dict(self) -> dict[str, Any]:
        """The attributes as plain values, for a manifest."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


def sampled_wind(rng: np.random.Generator, *, strongest: float = 8.0, calm: float = 0.0) -> Wind:
    """A wind drawn at random, from any direction, at most 20° up or down.

    Args:
        rng: Random number generator.
        strongest: Largest mean speed [m/s]; gusts add up to half of it.
        calm: Share of draws (0 to 1) that are still air.
    """
    heading, slope = rng.uniform(0.0, 2.0 * np.pi), math.radians(rng.uniform(-20.0, 20.0))
    blowing = rng.random() >= calm
    return Wind(
        direction=(
            math.cos(slope) * math.sin(heading),
            math.sin(slope),
            math.cos(slope) * math.cos(heading),
        ),
        strength=float(rng.uniform(0.5, strongest)) * blowing,
        gusts=float(rng.uniform(0.1, 0.5)),
        turn=float(rng.uniform(0.0, 0.5)),
        period=float(rng.uniform(2.0, 5.0)),
        phases=tuple(float(p) for p in rng.uniform(0.0, 2.0 * np.pi, 6)),
    )


def speed_of_strength(strength: float, scale: float = 1.0) -> float:
    """Speed of the wind that exerts the pressure of Blender's wind on a plate head-on [m/s].

    Args:
        strength: Strength of Blender's wind.
        scale: Size of Blender's scene as a multiple of life size.
    """
    return math.sqrt(2.0 * BLENDER_PRESSURE * strength * scale**2 / (AIR_DENSITY * DRAG))


def strength_of_speed(speed: float, scale: float = 1.0) -> float:
    """Blender's strength for a speed of wind [m/s]; the inverse of `speed_of_strength`."""
    return 0.5 * AIR_DENSITY * DRAG * speed**2 / (BLENDER_PRESSURE * scale**2)
