"""What a page shows: results side by side, each a body and garments at the same moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from warpgarment.objects.body import BodyMotion
from warpgarment.objects.motion import GarmentMotion
from warpgarment.view import draw

GAP = 0.25  # metres between results side by side
BODY = "body"  # name under which the body is switched on and off


@dataclass
class Part:
    """One mesh in motion.

    Attributes:
        name: Its name, which no other part of its side has.
        frames: Positions [m], shape [T,V,3].
        faces: Vertex indices, shape [F,3].
        color: "#rrggbb".
        rest: Positions at rest [m], shape [V,3].
    """

    name: str
    frames: np.ndarray
    faces: np.ndarray
    color: str
    rest: np.ndarray


@dataclass
class Side:
    """One result.

    Attributes:
        name: What it is called: "first" or "second".
        garments: Its garments, innermost first.
        body: Its body, or None.
        x: How far it is moved to the right [m].
    """

    name: str
    garments: list[Part]
    body: Part | None
    x: float = field(default=0.0)

    @property
    def parts(self) -> list[Part]:
        """Body and garments."""
        return [*([self.body] if self.body is not None else []), *self.garments]


def side_of(
    name: str,
    garments: Sequence[GarmentMotion],
    body: BodyMotion | None,
    rest: Sequence[np.ndarray | None],
) -> Side:
    """A side of motions with the same frames.

    Args:
        name: What it is called.
        garments: The garments, innermost first.
        body: The body, or None.
        rest: Positions of each garment at rest [m], [V,3]; None: those of its first frame.
    """
    parts: list[Part] = []
    for motion, known, color in zip(garments, rest, _colors(len(garments)), strict=True):
        still = motion.vertices[0] if known is None else known
        parts.append(Part(_unused(motion.name or "garment", parts), motion.vertices, motion.faces, color, still))
    shown = None if body is None else Part(BODY, body.vertices, body.faces, draw.SKIN, body.vertices[0])
    return Side(name, parts, shown)


def _colors(count: int) -> list[str]:
    return [draw.PALETTE[k % len(draw.PALETTE)] for k in range(count)]


def _unused(name: str, parts: Sequence[Part]) -> str:
    """The name as one level of a scene's tree, with a number if it is taken."""
    plain, taken = name.replace("/", "_"), {BODY, *(part.name for part in parts)}
    return next(n for n in (plain, *(f"{plain}_{k}" for k in range(2, len(parts) + 4))) if n not in taken)


def place(sides: Sequence[Side]) -> None:
    """Puts sides beside each other along X, so far apart that they meet in no frame."""
    if len(sides) < 2:
        return
    low, high = (
        np.stack([getattr(np, f"nan{which}")(_along_x(side, which), axis=0) for side in sides])
        for which in ("min", "max")
    )
    apart = float(np.nanmax(high[0] - low[1], initial=0.0)) + GAP
    for k, side in enumerate(sides):
        side.x = (k - 0.5) * apart


def _along_x(side: Side, which: str) -> np.ndarray:
    """Lowest or highest x of each part in each frame, [parts,T]."""
    return np.stack([getattr(part.frames[:, :, 0], which)(axis=1) for part in side.parts])


def centres(side: Side) -> np.ndarray:
    """Where a side stands in each frame, on the ground, against its first frame [m], float32 [T,3]."""
    part = side.body if side.body is not None else side.garments[0]
    middle = part.frames.mean(axis=1)
    moved = np.nan_to_num(middle - middle[0])
    moved[:, 1] = 0.0
    return moved.astype(np.float32)
