"""Limbs that follow a line meanwhile: the arms of a body lie in the sleeves of a garment of another pose.

The centre line of a limb (limbs.py) begins at its joint. Each of its pieces turns towards the piece of a path that is
as far from the joint, by any share of the angle between them; the body around it follows its nearest piece. At the
joint the turn begins gradually.
"""

from __future__ import annotations

import numpy as np

from .limbs import RINGS, Limb, Limbs
from .openings import Roles, line_from

BLEND = 0.04
"""Half the length over which a limb begins to turn, as a share of the height."""
TIP = 4
"""Pieces at the tip of a limb that turn as the one before."""


class Bend:
    """A limb and the path that it follows.

    Args:
        limb: The limb.
        path: Points [m] from its joint on, [K,3], K at least 2; beyond the last one it goes on straight.
        height: Height of the body [m].

    Attributes:
        angle: Largest turn of a piece [degrees].
    """

    def __init__(self, limb: Limb, path: np.ndarray, height: float) -> None:
        line = _smooth(limb.line[::-1])
        self._line, self._band = line, height / RINGS
        pieces = np.diff(line, axis=0)
        lengths = np.linalg.norm(pieces, axis=1)
        at = np.cumsum(lengths) - 0.5 * lengths
        turns = _turns(pieces / np.maximum(lengths, 1e-12)[:, None], _directions(path, at))
        if len(turns) > TIP:  # rings at the tip, or at the end of a body without hands, do not tell where it points
            turns[-TIP:] = turns[-TIP - 1]
        self._pieces, self._turns = pieces, turns
        self._reach, self._end = limb.reach, limb.end
        self._blend = BLEND * height / self._band
        self.angle = float(np.degrees(np.linalg.norm(turns, axis=1).max(initial=0.0)))

    def at(self, share: float, points: np.ndarray) -> np.ndarray:
        """Positions of the body [m], [U,3], in which the limb has turned by a share of its turns."""
        if share <= 0.0 or not len(self._pieces):
            return points
        count = len(self._pieces)
        weight = share * _ramp((np.arange(count) + 0.5) / self._blend)
        moved = _turned(self._pieces, weight[:, None] * self._turns)
        centres = np.concatenate([self._line[:1], self._line[0] + np.cumsum(moved, axis=0)])
        place = np.where(np.isfinite(self._reach), (self._end - self._reach) / self._band, -np.inf)
        mine = np.flatnonzero(place > -self._blend)
        along = np.clip(place[mine], 0.0, count)
        low = np.minimum(along.astype(int), count - 1)
        part = (along - low)[:, None]

        def between(values: np.ndarray) -> np.ndarray:
            return values[low] * (1 - part) + values[low + 1] * part

        corners = np.concatenate([self._turns[:1], 0.5 * (self._turns[1:] + self._turns[:-1]), self._turns[-1:]])
        turn = share * _ramp(place[mine] / self._blend)[:, None] * between(corners)
        result = points.copy()
        result[mine] = between(centres) + _turned(points[mine] - between(self._line), turn)
        return result


def bends_of(rest: np.ndarray, faces: np.ndarray, roles: Roles, limbs: Limbs, notes: list[str]) -> list[Bend]:
    """Limbs that have to lie in sleeves and legs of the garment, with the lines of these.

    Args:
        rest: Positions of the garment at its place [m], [V,3].
        faces: Vertex indices, [F,3].
        roles: What its openings are.
        limbs: The body's limbs.
        notes: To which it adds what is not found.
    """
    tall, found = limbs.height, []
    for name, openings, parts in (("arm", roles.arms, limbs.arms), ("leg", roles.legs, limbs.legs)):
        if openings and not parts:
            notes.append(f"the body's {name}s were not found: they stay in their pose while it grows.")
        for limb in parts if openings else ():
            near = min(openings, key=lambda one: float(np.linalg.norm(one.points(rest).mean(0) - limb.joint)))
            inwards = line_from(rest, faces, near._replace(centre=near.points(rest).mean(0)), 0.7 * tall, 1.5)
            way = inwards[0] - limb.joint
            length = float(np.linalg.norm(way))
            if length < 0.08 * tall:
                continue  # an armhole: any arm goes through it
            along = (inwards - limb.joint) @ way / length
            inwards = inwards[: int(np.argmax(along < 0.05 * tall)) if (along < 0.05 * tall).any() else None]
            path = np.concatenate([limb.joint[None], inwards[::-1]])
            found.append(Bend(limb, path, tall))
    return found


def _ramp(place: np.ndarray) -> np.ndarray:
    """0 below -1, 1 above 1, smooth between."""
    x = np.clip(0.5 * (place + 1.0), 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _smooth(line: np.ndarray) -> np.ndarray:
    """A line with its ends, each other point averaged with its neighbours."""
    smooth = line.copy()
    for _ in range(3):
        smooth[1:-1] = 0.25 * smooth[:-2] + 0.5 * smooth[1:-1] + 0.25 * smooth[2:]
    return smooth


def _directions(path: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Unit directions of a path at lengths from its start, [N,3]."""
    pieces = np.diff(path, axis=0)
    lengths = np.linalg.norm(pieces, axis=1)
    kept = lengths > 1e-9
    pieces, lengths = pieces[kept], lengths[kept]
    which = np.minimum(np.searchsorted(np.cumsum(lengths), at), len(lengths) - 1)
    return pieces[which] / lengths[which][:, None]


def _turns(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Turns from unit vectors to others: axis times angle, [N,3]."""
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis, axis=1), (a * b).sum(1)
    return axis / np.maximum(sine, 1e-12)[:, None] * np.arctan2(sine, cosine)[:, None]


def _turned(offset: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Vectors turned by axis times angle (Rodrigues' formula), [N,3]."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    axis = turn / np.maximum(angle, 1e-12)
    along = (offset * axis).sum(1, keepdims=True) * axis
    return offset * np.cos(angle) + np.cross(axis, offset) * np.sin(angle) + along * (1 - np.cos(angle))
