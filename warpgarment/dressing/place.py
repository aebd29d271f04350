"""Where a garment belongs on a body: its unit, its upward axis, its turn and its place, from openings and sizes.

The unit is the one with which openings are as wide as the body is there: a neck, an arm, hips. Axes come from the
openings (openings.py). The top of a neck goes to the base of the body's neck, a waist to the height at which the body
is as wide; sideways, the middle of the garment goes to the middle of the trunk, height by height.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpgarment.errors import DressingError
from warpgarment.io.data import UNITS

from .limbs import Limbs, edges_of, girth
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


def girths(vertices: np.ndarray, faces: np.ndarray, limbs: Limbs, around: np.ndarray) -> dict[str, float]:
    """Length of a tape around the body where each opening may lie [m]; `around` as of `trunk`."""
    tall, up, edges = limbs.height, np.array([0.0, 1.0, 0.0]), edges_of(faces)
    found = {}
    neck = limbs.head.line[max(len(limbs.head.line) - 3, 0)]
    found["neck"] = girth(vertices, edges, neck, up, 0.1 * tall)
    for name, pair in (("cuff", limbs.arms), ("leg", limbs.legs)):
        if pair:
            at = [limb.line[int(0.6 * (len(limb.line) - 1))] for limb in pair]
            ways = [limb.line[-1] - limb.line[int(0.3 * (len(limb.line) - 1))] for limb in pair]
            each = [girth(vertices, edges, p, w, 0.07 * tall) for p, w in zip(at, ways, strict=True)]
            found[name] = float(np.mean(each))
    if len(around):
        found["waist"] = found["top"] = float(around[len(around) // 6 : -len(around) // 4 or None].min())
        found["hem"] = float(around[: max(len(around) // 2, 1)].max())
    return {name: size for name, size in found.items() if size > 0}


def trunk(vertices: np.ndarray, faces: np.ndarray, limbs: Limbs) -> tuple[np.ndarray, np.ndarray]:
    """Heights from the crotch to the armpits [m] and the girth of the trunk at each [m], [N] and [N]."""
    kept = np.ones(len(vertices), bool)
    for arm in limbs.arms:
        kept &= ~(arm.reach < arm.end)
    mine = edges_of(faces[kept[faces].all(1)])
    low, high = _trunk_ends(vertices, limbs)
    heights = np.linspace(low, high, 33)
    middle = vertices[kept].mean(0)
    up = np.array([0.0, 1.0, 0.0])
    around = [girth(vertices, mine, np.array([middle[0], y, middle[2]]), up, 0.17 * limbs.height) for y in heights]
    return heights, np.array(around)


def _trunk_ends(vertices: np.ndarray, limbs: Limbs) -> tuple[float, float]:
    low = vertices[:, 1].min()
    crotch = np.mean([leg.joint[1] for leg in limbs.legs]) if limbs.legs else low + 0.48 * limbs.height
    armpit = np.mean([arm.joint[1] for arm in limbs.arms]) - 0.05 * limbs.height if limbs.arms else None
    return float(crotch), float(low + 0.72 * limbs.height if armpit is None else armpit)


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
    metres, unit_name, unit_from, widths = _unit(points, roles, around, told, unit, notes)
    ratios = [w / EASE[_plain(name)] for name, w in widths.items()]
    usual = float(np.exp(np.median(np.log(ratios)))) if ratios else 1.0
    resized = 1.0 / usual if scale == "fit" else 1.0 if scale is None else float(scale)
    if not _fits([ratio * resized for ratio in ratios]):
        told_widths = ", ".join(f"{name} {w * resized:.2f}" for name, w in widths.items())
        raise DressingError(
            f"the garment is too {'small' if usual * resized < 1 else 'large'} for this body: the lengths of its "
            f"openings over the girth of the body there are {told_widths}. Give the right unit, or scale="
            f'{1.0 / usual:.3g} (scale="fit"), to change its size.'
        )
    axis, axis_from = _upward(roles, told, up, notes)
    rotation = axis
    across = None if roles.across is None else rotation @ roles.across
    angle = turn
    if not move:
        angle = 0.0
    elif angle is None:
        angle = _turn(rotation @ (points * metres).T, roles, across, limbs, notes)
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
        _axis_name(axis @ UPRIGHTS[told.up]),
        axis_from,
        resized,
        angle,
        widths,
        tuple(notes),
    )


def _fits(ratios: list[float]) -> bool:
    return not ratios or (max(ratios) >= LEAST and min(ratios) <= MOST)


def _plain(name: str) -> str:
    return name.split()[0]


def _unit(
    points: np.ndarray,
    roles: Roles,
    around: dict[str, float],
    told: Told,
    unit: str | None,
    notes: list[str],
) -> tuple[float, str, str, dict[str, float]]:
    """Factor from the numbers to metres, the unit's name, where it is from, and the widths of the openings."""
    sizes = {n: o.length / around[_plain(n)] for n, o in roles.named.items() if _plain(n) in around}
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
    ratios = [w / EASE[_plain(n)] for n, w in sizes.items()]
    if _fits(ratios):
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


def _upward(roles: Roles, told: Told, up: str | None, notes: list[str]) -> tuple[np.ndarray, str]:
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
    name = _axis_name(_to_up(named, roles)) or f"({', '.join(f'{c:.2f}' for c in named)})"
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


def _axis_name(rotation: np.ndarray) -> str:
    """Name of the axis that a rotation brings to Y."""
    row = rotation[1]
    k = int(np.abs(row).argmax())
    return ("-" if row[k] < 0 else "") + "xyz"[k] if abs(row[k]) > 0.999 else ""


def _turn(upright: np.ndarray, roles: Roles, across: np.ndarray | None, limbs: Limbs, notes: list[str]) -> float:
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
    low, high = _trunk_ends(body, limbs)
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
