"""Where a garment belongs on a body: unit, upward axis and turn (guesses.py), and its place.

The top of a neck goes to the base of the body's neck, a waist to the height at which the body is as wide; sideways, the
middle of the garment goes to the middle of the trunk, height by height.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpgarment.errors import DressingError

from .guesses import EASE, UPRIGHTS, Told, axis_name, fits, plain, turn_of, unit_of, upward
from .limbs import Limbs, girths, trunk, trunk_ends
from .openings import Roles


class Placement(NamedTuple):
    """A similarity from the numbers of a garment to metres on a body.

    Attributes:
        scale: Metres in a unit of the garment's numbers.
        rotation: [3,3].
        shift: [m], [3]; the place of a point p is scale * rotation @ p + shift.
        unit: Name of the unit that was found, or of the one that was given.
        unit_from: "given", "from the file", "assumed" or "guessed".
        up: Axis of the garment's numbers that points up: "x", "-z", or "" for none of them.
        up_from: As `unit_from`.
        resized: Change of size beyond the unit.
        turn: Turn about the vertical [degrees].
        widths: Width of each opening over that of the body there.
        notes: What was guessed, in sentences.
    """

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    unit: str
    unit_from: str
    up: str
    up_from: str
    resized: float
    turn: float
    widths: dict[str, float]
    notes: tuple[str, ...]

    def at(self, points: np.ndarray) -> np.ndarray:
        """Places of points [m], float64 [...,3]."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.shift


def placed(
    points: np.ndarray,
    roles: Roles,
    body: np.ndarray,
    body_faces: np.ndarray,
    limbs: Limbs,
    told: Told,
    *,
    unit: str | None = None,
    up: str | None = None,
    scale: float | str | None = None,
    turn: float | None = None,
    move: bool = True,
) -> Placement:
    """Finds the place of a garment on a body.

    Args:
        points: Positions of the garment, [V,3].
        roles: What its openings are.
        body: Positions of the body [m], [U,3].
        body_faces: Vertex indices of the body, [G,3].
        limbs: Its limbs.
        told: What is known of the garment's numbers.
        unit: Unit of the numbers, which is then not guessed.
        up: Axis of the numbers that points up, "y" or "z", which is then not guessed.
        scale: Change of size beyond the unit: a number, "fit" for the one with which openings are as wide as usual, or
            None for 1.
        turn: Turn about the vertical [degrees]; None: so that it looks where the body looks.
        move: Whether the garment is moved and turned; its unit and axis are found in any case.

    Raises:
        DressingError: It is too small or too large for the body in every unit.
    """
    notes: list[str] = []
    wide = trunk(body, body_faces, limbs)
    around = girths(body, body_faces, limbs, wide[1])
    metres, unit_name, unit_from, widths = unit_of(points, roles, around, told, unit, notes)
    ratios = [w / EASE[plain(name)] for name, w in widths.items()]
    usual = float(np.exp(np.median(np.log(ratios)))) if ratios else 1.0
    resized = 1.0 / usual if scale == "fit" else 1.0 if scale is None else float(scale)
    if not fits([ratio * resized for ratio in ratios]):
        told_widths = ", ".join(f"{name} {w * resized:.2f}" for name, w in widths.items())
        raise DressingError(
            f"the garment is too {'small' if usual * resized < 1 else 'large'} for this body: the lengths of its "
            f"openings over the girth of the body there are {told_widths}. Give the right unit, or scale="
            f'{1.0 / usual:.3g} (scale="fit"), to change its size.'
        )
    axis, axis_from = upward(roles, told, up, notes)
    rotation = axis
    across = None if roles.across is None else rotation @ roles.across
    angle = turn
    if not move:
        angle = 0.0
    elif angle is None:
        angle = turn_of(rotation @ (points * metres).T, roles, across, limbs, notes)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    rotation = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ rotation
    size = metres * resized
    there = size * points @ rotation.T
    shift = _shift(there, roles, body, limbs, wide) if move else np.zeros(3)
    widths = {name: w * resized for name, w in widths.items()}
    return Placement(
        size,
        rotation,
        shift,
        unit_name,
        unit_from,
        axis_name(axis @ UPRIGHTS[told.up]),
        axis_from,
        resized,
        angle,
        widths,
        tuple(notes),
    )


def _shift(
    there: np.ndarray, roles: Roles, body: np.ndarray, limbs: Limbs, wide: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Where to move a garment of the right size that is upright [m], [3]."""
    top = roles.top.points(there)
    if roles.kind in ("trousers", "tube"):
        rise = _waist_height(roles, there, *wide) - top[:, 1].mean()
        if roles.kind == "trousers":
            rise = min(rise, _crotch_rise(roles, there, body, limbs))
    else:
        high = np.sort(top[:, 1])[-max(len(top) * 3 // 10, 1) :].mean()
        rise = limbs.head.joint[1] + 0.004 * limbs.height - high
    moved = there + [0.0, rise, 0.0]
    return np.array([0.0, rise, 0.0]) + _sideways(moved, roles, body, limbs)


def _waist_height(roles: Roles, there: np.ndarray, heights: np.ndarray, around: np.ndarray) -> float:
    """Height at which the body is as wide as the waist [m]: from the narrowest place downwards, or that place."""
    length = float(
        np.linalg.norm(np.diff(roles.top.points(there), axis=0, append=roles.top.points(there)[:1]), axis=1).sum()
    )
    narrow = len(around) // 6 + int(around[len(around) // 6 : -len(around) // 4 or None].argmin())
    wider = np.flatnonzero(around[:narrow] * 1.01 >= length)
    if len(wider):
        return float(heights[wider[-1]])
    hips = int(around[:narrow].argmax()) if narrow else 0
    return float(heights[narrow] if length <= around[narrow] else 0.5 * (heights[narrow] + heights[hips]))


def _crotch_rise(roles: Roles, there: np.ndarray, body: np.ndarray, limbs: Limbs) -> float:
    """How far trousers may be lifted until their crotch is at that of the body [m]."""
    if not limbs.legs or roles.across is None:
        return np.inf
    sides = np.stack([there[o.vertices].mean(0) for o in roles.legs])
    across = sides[0] - sides[1]
    width = float(np.linalg.norm(across))
    aside = np.abs((there - sides.mean(0)) @ across) / max(width**2, 1e-12)
    fork = there[aside < 0.06]
    if not len(fork):
        return np.inf
    low = body[:, 1].min()
    between = np.abs((body - np.mean([leg.joint for leg in limbs.legs], axis=0)) @ limbs.left) < 0.012 * limbs.height
    mine = body[between & (body[:, 1] > low + 0.35 * limbs.height)]
    return float(mine[:, 1].min() - 0.005 * limbs.height - fork[:, 1].min()) if len(mine) else np.inf


def _sideways(there: np.ndarray, roles: Roles, body: np.ndarray, limbs: Limbs) -> np.ndarray:
    """Move along X and Z that brings the middle of the garment to that of the trunk, [3]."""
    low, high = trunk_ends(body, limbs)
    bottom = there[:, 1].min() if roles.bottom is None else roles.bottom.points(there)[:, 1].mean()
    top = min(high, roles.top.points(there)[:, 1].mean())
    low = max(low, min(bottom, top - 0.05 * limbs.height))
    trunk_of_body = np.ones(len(body), bool)
    for arm in limbs.arms:
        trunk_of_body &= ~(arm.reach < arm.end)
    if roles.arms:  # no further aside than halfway to the cuffs: no sleeves
        middle = 0.5 * sum(there[o.vertices].mean(0) for o in roles.arms)
        reach = 0.5 * np.linalg.norm(there[roles.arms[0].vertices].mean(0) - middle)
        mine = np.abs((there - middle) @ limbs.left) < max(reach, 0.1 * limbs.height)
    else:
        mine = np.ones(len(there), bool)
    moves = []
    for y in np.linspace(low, top, 9):
        near = 0.02 * limbs.height
        a = there[mine & (np.abs(there[:, 1] - y) < near)]
        b = body[trunk_of_body & (np.abs(body[:, 1] - y) < near)]
        if len(a) > 3 and len(b) > 3:
            moves.append(0.5 * (b.max(0) + b.min(0)) - 0.5 * (a.max(0) + a.min(0)))
    if not moves:
        centre = roles.top.points(there).mean(0)
        moves = [limbs.head.joint - centre]
    x, _, z = np.median(moves, axis=0)
    return np.array([x, 0.0, z])
