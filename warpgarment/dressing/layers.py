"""A garment over those that a body wears already: it comes on without crossing them, and then all settle together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from warpgarment.kernels.cloth.pairs import PARTNERS
from warpgarment.objects.clearance import clearance
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from .bend import Bend
from .beneath import Beneath
from .drape import MEETS, Drape, Layer
from .grow import Growing, cleared
from .limbs import Limbs
from .openings import Roles

SETTLE = 30
"""Steps under gravity."""
CROWDED = 4 * PARTNERS
"""Room for faces that can meet one face, where garments are folded around a thin body."""


class Ready(NamedTuple):
    """A garment that can be put on."""

    cloth: Garment
    """What is simulated of it, at its place, in metres."""
    roles: Roles
    """What its openings are."""
    bends: Sequence[Bend]
    """Limbs that have to follow its sleeves and legs."""
    material: Material

    @property
    def rest(self) -> np.ndarray:
        """Rest positions [m], float64 [V,3]."""
        return self.cloth.vertices.astype(np.float64)


class PutOn(NamedTuple):
    """What a body wears after a garment was put on."""

    points: list[np.ndarray]
    """Positions of each garment [m], float64 [V,3], innermost first."""
    start: np.ndarray
    """Positions with which the new one began [m], [V,3]."""
    thin: float
    """How far the body was thinned, as a share of the whole flow."""
    steps: int
    """Number of steps of the physics."""


def put_on(
    new: Ready,
    beneath: Sequence[Ready],
    points: Sequence[np.ndarray],
    at: np.ndarray,
    faces: np.ndarray,
    limbs: Limbs,
    progress: bool,
) -> PutOn:
    """Puts a garment on a body, over others.

    Args:
        new: The garment.
        beneath: Those that the body wears, innermost first.
        points: Their positions [m], each [V,3].
        at: Positions of the body [m], [U,3].
        faces: Vertex indices of the body, [G,3].
        limbs: Its limbs.
        progress: Whether there is a progress bar.

    Raises:
        DressingError: There is no way into the garment.
    """
    every = [*beneath, new]
    first = np.cumsum([0, *(len(one.cloth.vertices) for one in every)])
    triangles, edges = (
        np.concatenate([getattr(one.cloth, name) + at for one, at in zip(every, first[:-1], strict=True)])
        for name in ("faces", "edges")
    )
    worn = None
    if beneath:
        worn = Beneath(np.concatenate(points), triangles[: -len(new.cloth.faces)], at)
    growing = Growing(at, faces, limbs, new.bends, worn)
    start, level = growing.start(new.rest, new.cloth.faces)
    keep = _distances(every)

    def draped(at: np.ndarray, positions: Sequence[np.ndarray], held: bool) -> Drape:
        materials = [None if held and one is not new else one.material for one in every]
        rows = zip(every, positions, keep, materials, strict=True)
        layers = [Layer(one.rest, one.cloth.faces, p, far, material) for one, p, far, material in rows]
        return Drape(layers, at, faces, partners=CROWDED if beneath else PARTNERS)

    thinned = growing.worn(level)
    there = [] if thinned is None else np.split(thinned, first[1:-2])
    drape = draped(growing.thin[level], [*there, start], held=True)
    steps = growing.grown(drape, level, start, new.cloth.name, progress)
    if beneath:
        drape = draped(at, np.split(drape.points.numpy(), first[1:-1]), held=False)
    pins = np.concatenate([one.cloth.pins + at for one, at in zip(every, first[:-1], strict=True)])
    if len(pins):
        drape.hold(pins)
    for _ in range(SETTLE):
        drape.step(at)
    steps += SETTLE + cleared(drape, at, edges, triangles)
    now = np.split(drape.points.numpy(), first[1:-1])
    return PutOn(now, start, level / (len(growing.thin) - 1), steps)


def _distances(every: Sequence[Ready]) -> list[float]:
    """Distance that each garment keeps from the body [m]: its own, and no less than that of one beneath and a gap."""
    found: list[float] = []
    for one in every:
        own = 1.1 * clearance(one.cloth)
        found.append(max([own, *(far + MEETS for far in found[-1:])]))
    return found
