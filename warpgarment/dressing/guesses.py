"""What the numbers of a garment mean: their unit, the axis that points up, and where the garment looks.

The unit is the one with which openings are as wide as the body is there: a neck, an arm, hips. Axes come from the
openings (openings.py): up from hem to neck, across from cuff to cuff. Of front and back, the one nearer to +Z is the
front, unless the neckline says otherwise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpgarment.io.data import UNITS

from .limbs import Limbs
from .openings import Roles

EASE = {"neck": 1.1, "cuff": 1.35, "hem": 1.1, "waist": 1.05, "top": 1.05, "leg": 1.3}
"""How much wider than the body openings usually are."""
LEAST, MOST = 0.7, 2.4
"""A garment is too small if even its widest opening is less than this share of the usual width, and too large if even
its tightest one is this many times as wide."""
RARE = {"dm": 0.5, "in": 0.5}
"""What units that are seldom used have to be better by, in powers of e."""
UPRIGHT = 35.0
"""Angle [degrees] between the direction of the openings and an axis below which the axis is meant."""
UPRIGHTS = {"y": np.eye(3), "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])}
"""Rotations that bring an axis to Y."""


class Told(NamedTuple):
    """What is known of a garment's numbers.

    Attributes:
        metres: Metres in one of them now (1: they are metres, or are said to be).
        metres_from: "given", "from the file" or "assumed".
        up: Axis of the file that points up; it has been turned to Y.
        up_from: Where that comes from.
    """

    metres: float = 1.0
    metres_from: str = "assumed"
    up: str = "y"
    up_from: str = "assumed"


def fits(ratios: list[float]) -> bool:
    """Whether widths of openings, over the usual ones, are those of a garment for the body; none are."""
    return not ratios or (max(ratios) >= LEAST and min(ratios) <= MOST)


def plain(name: str) -> str:
    """Name of an opening without its number."""
    return name.split()[0]


def unit_of(
    points: np.ndarray,
    roles: Roles,
    around: dict[str, float],
    told: Told,
    unit: str | None,
    notes: list[str],
) -> tuple[float, str, str, dict[str, float]]:
    """Factor from the numbers to metres, the unit's name, where it is from, and the widths of the openings."""
    sizes = {n: o.length / around[plain(n)] for n, o in roles.named.items() if plain(n) in around}
    if roles.kind == "jacket":  # its neck is a part of a long border
        sizes.pop("neck", None)
    if roles.bottom is not None and roles.kind == "tube":
        sizes.pop("hem", None)
    named = next((name for name, metres in UNITS.items() if np.isclose(metres, told.metres)), f"{told.metres:g} m")
    if unit is not None:
        factor = UNITS[unit] / told.metres
        return factor, unit, "given", {n: w * factor for n, w in sizes.items()}
    if not sizes or told.metres_from == "given":
        return 1.0, named, told.metres_from, sizes
    ratios = [w / EASE[plain(n)] for n, w in sizes.items()]
    if fits(ratios):
        return 1.0, named, told.metres_from, sizes
    usual = float(np.median(np.log(ratios)))
    best = min(UNITS, key=lambda name: abs(usual + np.log(UNITS[name] / told.metres)) + RARE.get(name, 0.0))
    factor = UNITS[best] / told.metres
    if factor == 1.0:
        return 1.0, named, told.metres_from, sizes
    size = np.ptp(points, axis=0).max()
    was = "the file says" if told.metres_from == "from the file" else "nothing says what the unit is; in"
    notes.append(
        f"{was} {named}, the garment would be {size:.3g} m in size: {best} is assumed ({size * factor:.3g} m). "
        f"If that is wrong, give unit."
    )
    return factor, best, "guessed", {n: w * factor for n, w in sizes.items()}


def upward(roles: Roles, told: Told, up: str | None, notes: list[str]) -> tuple[np.ndarray, str]:
    """Rotation that brings the garment's upward axis to Y, and where it is from."""
    if up is not None:
        return UPRIGHTS[up] @ UPRIGHTS[told.up].T, "given"
    direction = roles.up
    axis = int(np.abs(direction).argmax())
    angle = np.degrees(np.arccos(np.clip(abs(direction[axis]), -1.0, 1.0)))
    if axis == 1 and direction[1] > 0 and angle <= UPRIGHT:
        return np.eye(3), told.up_from
    if angle <= UPRIGHT:
        named = np.zeros(3)
        named[axis] = np.sign(direction[axis])
    else:
        named = direction / np.linalg.norm(direction)
    says = "" if told.up_from == "assumed" else f" ({told.up_from}, Y is)"
    name = axis_name(_to_up(named, roles)) or f"({', '.join(f'{c:.2f}' for c in named)})"
    notes.append(f"by its openings the garment's {name.upper()} points up{says}: it was turned upright.")
    if axis == 2 and direction[2] > 0 and angle <= UPRIGHT:
        return UPRIGHTS["z"], "guessed"
    return _to_up(named, roles), "guessed"


def _to_up(up: np.ndarray, roles: Roles) -> np.ndarray:
    """A rotation that brings a direction to Y, and across to X where it is known."""
    side = np.array([1.0, 0.0, 0.0]) if roles.across is None else roles.across
    side = side - (side @ up) * up
    if np.linalg.norm(side) < 1e-6:
        side = np.cross(up, [0.0, 0.0, 1.0])
    side = side / np.linalg.norm(side) * (np.sign(side[np.abs(side).argmax()]) or 1.0)
    return np.stack([side, up, np.cross(side, up)])


def axis_name(rotation: np.ndarray) -> str:
    """Name of the axis that a rotation brings to Y."""
    row = rotation[1]
    k = int(np.abs(row).argmax())
    return ("-" if row[k] < 0 else "") + "xyz"[k] if abs(row[k]) > 0.999 else ""


def turn_of(upright: np.ndarray, roles: Roles, across: np.ndarray | None, limbs: Limbs, notes: list[str]) -> float:
    """Turn about the vertical [degrees] with which the garment looks where the body looks."""
    body = np.degrees(np.arctan2(limbs.forward[0], limbs.forward[2]))
    if across is None:
        return float(body) if abs(body) > 8.0 else 0.0
    side = np.degrees(np.arctan2(-across[2], across[0]))  # turn of +X
    own = (side + 90.0) % 180.0 - 90.0  # where it looks, of the two the one nearer to +Z
    lower = _lower_side(upright, roles, own)
    if lower is not None and lower < 0:
        if abs(own) > 45.0:
            own += 180.0 if own < 0 else -180.0
            notes.append("the neckline is lower on one side, which was taken for the front.")
        else:
            notes.append("the neckline is lower at the back. If the garment is the wrong way round, give turn=180.")
    turn = (body - own + 180.0) % 360.0 - 180.0
    return 0.0 if abs(turn) < 8.0 else float(turn)


def _lower_side(upright: np.ndarray, roles: Roles, own: float) -> float | None:
    """1 if a neckline is lower at the side to which the garment looks, -1 if it is at the other, None where even."""
    if roles.kind not in ("shirt", "overall"):
        return None
    points = upright.T[roles.top.vertices]
    forward = np.array([np.sin(np.radians(own)), 0.0, np.cos(np.radians(own))])
    depth = (points - points.mean(0)) @ forward
    if np.ptp(depth) < 1e-9:
        return None
    slope = float(np.polyfit(depth, points[:, 1], 1)[0])
    return None if abs(slope) < 0.2 else -float(np.sign(slope))
