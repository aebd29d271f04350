"""One garment that is put on: made ready before, reported and checked after."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch

from warpgarment.errors import DressingError
from warpgarment.geometry.seams import coinciding_borders
from warpgarment.kernels.sdf import BodyMeshes
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from .bend import bends_of
from .guesses import Told
from .layers import Ready
from .limbs import Limbs
from .measure import crossing_pairs, depth_of, own_crossings, stretch_of, unworn
from .openings import Roles, roles_of
from .pins import find_pins
from .place import Placement, placed
from .report import DressReport

TORN = 0.4
"""99th percentile of the stretch beyond which a garment is too small."""
STUCK = 0.02
"""Depth in the body [m] beyond which a garment is not on it."""


class Piece(NamedTuple):
    """One garment, what was found of it, and what was done with it.

    Attributes:
        garment: As it was given.
        worn: In metres at its place, with its pins.
        ready: What is simulated of it.
        where: Its place.
        pins: Number of its pins.
        pins_from: Where they are from.
        notes: What was guessed, in sentences.
        start: Positions with which it began [m], [V,3].
        thin: How far the body was thinned.
        steps: Number of steps of the physics.
        seconds: How long it took [s].
    """

    garment: Garment
    worn: Garment
    ready: Ready
    where: Placement
    pins: int
    pins_from: str
    notes: list[str]
    start: np.ndarray | None = None
    thin: float = 0.0
    steps: int = 0
    seconds: float = 0.0


def prepared(garment: Garment, at: np.ndarray, body_faces: np.ndarray, limbs: Limbs, **options: Any) -> Piece:
    """A garment in metres at its place, with its pins, and what was found of it.

    Args:
        garment: The garment, in any unit, pose and place.
        at: Positions of the body [m], [U,3].
        body_faces: Vertex indices of the body, [G,3].
        limbs: Its limbs.
        options: unit, up, scale, turn, place, pins and material, as of `dress`.

    Raises:
        DressingError: It is not sewn, has no openings for a body, or the wrong size.
    """
    cloth = garment.simulated.garment
    source = garment.source
    told = Told() if source is None else Told(source.metres, source.metres_from, source.up, source.up_from)
    seams = coinciding_borders(cloth.vertices, cloth.faces).sides
    if seams:
        raise DressingError(
            f"the garment is not sewn: {seams:,} vertices of open borders lie where others do. Load it with clean=True."
        )
    roles = roles_of(cloth.vertices, cloth.faces)
    rest = cloth.vertices.astype(np.float64)
    placing = {name: options[name] for name in ("unit", "up", "scale", "turn")}
    where = placed(rest, roles, at, body_faces, limbs, told, **placing, move=options["place"])
    notes = list(where.notes)
    held, pins_from = find_pins(garment, roles, options["pins"])
    worn = garment.transformed(where.scale * where.rotation, where.shift, pins=held)
    if not len(held) and roles.kind in ("trousers", "tube"):
        notes.append('nothing holds its waist but friction: give pins="waist" if it has a waistband.')
    cloth = worn.simulated.garment
    bends = bends_of(cloth.vertices.astype(np.float64), cloth.faces, roles, limbs, notes)
    ready = Ready(cloth, roles, bends, options["material"] or Material.jersey())
    return Piece(garment, worn, ready, where, len(held), pins_from, notes)


def report_of(
    found: Piece, points: np.ndarray, at: np.ndarray, body_faces: np.ndarray, meshes: BodyMeshes
) -> DressReport:
    """What was done with a garment, and how it lies at `points` [m], [V,3]."""
    cloth, where, roles, rest = found.ready.cloth, found.where, found.ready.roles, found.ready.rest
    stretch = stretch_of(points, rest, cloth.edges)
    assert found.start is not None
    return DressReport(
        garment=found.garment.name,
        kind=roles.kind,
        openings={name: one.length * where.scale for name, one in roles.named.items()},
        widths=where.widths,
        unit=where.unit,
        unit_from=where.unit_from,
        up=where.up,
        up_from=where.up_from,
        scale=where.scale,
        resized=where.resized,
        turned=where.turn,
        moved=_moved(cloth, where, found.start - rest, found.garment),
        limbs=max([bend.angle for bend in found.ready.bends], default=0.0),
        thin=found.thin,
        stretch=tuple(float(share) for share in (*np.percentile(stretch, [1, 50, 99]), stretch.max())),  # type: ignore[arg-type]
        deepest=float(depth_of(torch.from_numpy(points), cloth.edges, cloth.faces, meshes).garments[0]),
        body_crossings=crossing_pairs(points, cloth.faces, at, body_faces),
        crossings=own_crossings(points, cloth.faces),
        crossings_before=own_crossings(rest, cloth.faces),
        pins=found.pins,
        pins_from=found.pins_from,
        notes=tuple(found.notes),
        steps=found.steps,
        seconds=found.seconds,
    )


def _moved(cloth: Garment, where: Placement, shifted: np.ndarray, garment: Garment) -> tuple[float, float, float]:
    before = where.scale * garment.simulated.garment.vertices.astype(np.float64) @ where.rotation.T
    way = cloth.vertices.mean(0) - before.mean(0) + shifted.mean(0)
    return (float(way[0]), float(way[1]), float(way[2]))


def check(points: np.ndarray, faces: np.ndarray, roles: Roles, limbs: Limbs, report: DressReport) -> None:
    """Refuses a garment that is not on the body.

    Raises:
        DressingError: It fell off, was torn, or is in the body.
    """
    if not np.isfinite(points).all():
        raise DressingError(
            "the physics did not stay finite. The mesh has faces much smaller than others; load it with clean=True."
        )
    missed = unworn(points, faces, roles, limbs)
    if missed:
        raise DressingError(
            f"the body does not go through the {' and the '.join(missed)} of the garment after all: it fell off, or "
            f'was never on. If it is too wide, give scale="fit" or pins; otherwise turn=, unit= or up=.'
        )
    if report.stretch[2] > TORN:
        raise DressingError(
            f"a hundredth of the garment's edges is stretched by {100 * report.stretch[2]:.0f} % or more: it is too "
            f'small. Give scale=, such as {1.0 + 0.7 * report.stretch[2]:.2f}, or scale="fit".'
        )
    if report.deepest > STUCK:
        raise DressingError(
            f"the garment is {1e3 * report.deepest:.0f} mm deep in the body: it is too small, or was modelled on a "
            'body of another shape. Give scale=, or scale="fit".'
        )
