"""Dresses a body in a garment that was modelled on another one, in another pose, place or unit.

1. The openings of the garment say what it is (openings.py), the mesh of the body where its limbs are (limbs.py).
2. Unit, axis, turn and place (place.py).
3. Arms and legs of the body follow sleeves and trouser legs (bend.py), and the body is thinned (grow.py) until nothing
   of it crosses the garment.
4. It grows again, goes back to its pose, and the garment with it, by physics (drape.py); then gravity settles it.
5. What came of it is measured (measure.py).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import DressingError, MeshError
from warpgarment.geometry.checks import checked_faces, checked_positions
from warpgarment.geometry.orientation import turned_outward
from warpgarment.geometry.seams import coinciding_borders
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.clearance import clearance
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from .bend import Bend
from .drape import Drape
from .grow import thin_bodies
from .limbs import Limbs, limbs_of
from .measure import crossing_pairs, depth_of, own_crossings, stretch_of, unworn
from .openings import Roles, line_from, roles_of
from .pins import find_pins
from .place import Placement, Told, placed
from .report import DressReport

STANDS = 0.4, 3.5
"""Heights [m] between which a body is one in metres."""
A_STEP = 0.006
"""Most that the body moves near the garment in a step [m]."""
SETTLE = 30
"""Steps under gravity."""
TORN = 0.4
"""99th percentile of the stretch beyond which a garment is too small."""
STUCK = 0.02
"""Depth in the body [m] beyond which a garment is not on it."""


@dataclass(frozen=True)
class Dressed:
    """A garment on the first frame of a body.

    Attributes:
        garment: The garment at rest in metres, Y up, turned to the body, with its pins.
        vertices: Its vertices on the body's first frame [m], float32 [V,3]: `first_vertices` of a rollout.
        report: What was done, and how well it lies.
    """

    garment: Garment
    vertices: np.ndarray
    report: DressReport

    def save(self, path: str | Path) -> None:
        """Writes the garment as it lies on the first frame, as `Garment.save` does."""
        from warpgarment.io.data import MeshData
        from warpgarment.io.files import write_mesh

        garment = self.garment
        write_mesh(Path(path), MeshData(self.vertices, garment.faces, garment.pins, garment.name, garment.surface))


def dress(
    garment: Garment,
    body: Any,
    *,
    unit: str | None = None,
    up: str | None = None,
    scale: float | str | None = None,
    turn: float | None = None,
    place: bool = True,
    pins: str | None = None,
    material: Material | None = None,
    progress: bool = False,
) -> Dressed:
    """Puts a garment on the first frame of a body.

    Nothing is known but two meshes. The openings of the garment (neck, cuffs, waist, hems) and the shape of the body
    tell its unit, axis, turn and place; a thinned body grows in the garment, and physics settles it. The report says
    everything that was guessed.

    Args:
        garment: The garment, in any unit, pose and place, as `Garment.load` read it.
        body: A BodyMotion, of which the first frame counts, or `(vertices [U,3], faces [G,3])` in metres, Y up: a body
            that stands, with its head up.
        unit: Unit of the garment's numbers ("m", "dm", "cm", "mm", "in"); None: what its file says, or what fits.
        up: Axis of the garment's numbers that points up, "y" or "z"; None: what its file says, or its openings.
        scale: Change of size beyond the unit: a number, or "fit" for one with which its openings are as wide as usual.
            None: it keeps its size.
        turn: Turn about the vertical [degrees]; None: so that it looks where the body looks.
        place: Whether it is moved and turned to the body; False leaves it where it is.
        pins: "none", "waist", the name of a group, material or object, or "#rrggbb"; None: those that it has, or those
            whose names say so (waistband, elastic, strap, belt, pin).
        material: Cloth; None: jersey.
        progress: Whether a progress bar is shown.

    Raises:
        DressingError: It cannot be put on: no opening for a body, the wrong size, sleeves that do not lead where arms
            are, or it falls off. The message says what to do.
        MeshError: The body is no mesh, or not in metres.
    """
    began = time.perf_counter()
    at, faces = _first_frame(body)
    limbs = limbs_of(at, faces)
    if not STANDS[0] <= limbs.height <= STANDS[1]:
        raise MeshError(
            f"the body is {limbs.height:.3g} m tall. Load it with unit= or up=, so that it stands in metres, Y up."
        )
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
    where = placed(rest, roles, at, faces, limbs, told, unit=unit, up=up, scale=scale, turn=turn, move=place)
    notes = list(where.notes)
    held, pins_from = find_pins(garment, roles, pins)
    worn = garment.transformed(where.scale * where.rotation, where.shift, pins=held)
    if not len(held) and roles.kind in ("trousers", "tube"):
        notes.append('nothing holds its waist but friction: give pins="waist" if it has a waistband.')
    cloth = worn.simulated.garment
    rest = cloth.vertices.astype(np.float64)
    bends = _bends(rest, cloth.faces, roles, limbs, notes)
    growing = _Growing(at, faces, limbs, bends)
    start, level = _start(rest, cloth.faces, growing, limbs)
    drape = Drape(
        rest, cloth.faces, start, growing.thin[level], faces, 1.1 * clearance(cloth), material or Material.jersey()
    )
    steps = _grown(drape, growing, level, cloth, progress)
    if len(cloth.pins):
        drape.hold(cloth.pins)
    for _ in range(SETTLE):
        drape.step(at)
    steps += SETTLE + _cleared(drape, at, cloth)
    points = drape.points.numpy()
    stretch = stretch_of(points, rest, cloth.edges)
    vertices = worn.simulated.restored(points.astype(np.float32))
    report = DressReport(
        garment=garment.name,
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
        moved=_moved(cloth, where, start - rest, garment),
        limbs=max([bend.angle for bend in bends], default=0.0),
        thin=level / (len(growing.thin) - 1),
        stretch=tuple(float(share) for share in (*np.percentile(stretch, [1, 50, 99]), stretch.max())),  # type: ignore[arg-type]
        deepest=float(depth_of(drape.points, cloth.edges, cloth.faces, drape.body).garments[0]),
        body_crossings=crossing_pairs(points, cloth.faces, at, faces),
        crossings=own_crossings(points, cloth.faces),
        crossings_before=own_crossings(rest, cloth.faces),
        pins=len(held),
        pins_from=pins_from,
        notes=tuple(notes),
        steps=steps,
        seconds=time.perf_counter() - began,
    )
    _check(points, cloth.faces, roles, limbs, report)
    return Dressed(worn, vertices, report)


def _first_frame(body: Any) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m], float64 [U,3], and faces of the first frame of a body."""
    if isinstance(body, BodyMotion):
        return body.vertices[0].astype(np.float64), body.faces
    if not (isinstance(body, tuple) and len(body) == 2):
        raise MeshError("body must be a BodyMotion or (vertices, faces).")
    vertices = checked_positions(body[0], name="body vertices")
    faces = checked_faces(body[1], len(vertices), name="body faces")
    return vertices.astype(np.float64), turned_outward(vertices, faces, "the body")


def _bends(rest: np.ndarray, faces: np.ndarray, roles: Roles, limbs: Limbs, notes: list[str]) -> list[Bend]:
    """Limbs that have to lie in sleeves and legs of the garment, with the lines of these."""
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


class _Growing:
    """The body in the garment's pose, from thin to itself, and its way to its own pose."""

    def __init__(self, at: np.ndarray, faces: np.ndarray, limbs: Limbs, bends: list[Bend]) -> None:
        self.own, self.faces, self._bends, self._tall = at, faces, bends, limbs.height
        self.thin = thin_bodies(self.posed(1.0), faces, limbs.height)

    def posed(self, share: float) -> np.ndarray:
        points = self.own
        for bend in self._bends:
            points = bend.at(share, points)
        return points

    def back(self, near: np.ndarray) -> list[np.ndarray]:
        """Bodies on the way from the garment's pose to its own, the last one its own.

        Args:
            near: Vertices that are near the garment, bool [U].
        """
        if not self._bends or not near.any():
            return []
        way = np.linalg.norm(self.posed(1.0) - self.own, axis=1)[near].max()
        count = int(np.ceil(1.6 * way / A_STEP))  # a turn is longer than the way, and begins slowly
        return [self.posed(1.0 - k / count) for k in range(1, count + 1)]


def _start(rest: np.ndarray, faces: np.ndarray, growing: _Growing, limbs: Limbs) -> tuple[np.ndarray, int]:
    """Positions of the garment at the start [m], and the number of the thin body that it is clear of.

    Raises:
        DressingError: There is none, even if the garment is moved a little.
    """

    def crossing(points: np.ndarray, level: int) -> int:
        return crossing_pairs(points, faces, growing.thin[level], growing.faces)

    last = len(growing.thin) - 1
    step = 0.012 * limbs.height
    moves = [np.zeros(3)] + [
        step * far * np.array(way, float)
        for far in (1.0, 2.0, 3.0)
        for way in ((0, 1, 0), (0, 0, 1), (0, 0, -1), (0, -1, 0), (0, 1, 1), (0, 1, -1), (0, -1, 1), (0, -1, -1))
    ]
    best, least = moves[0], None
    for move in moves:
        count = crossing(rest + move, last)
        if least is None or count < least:
            best, least = move, count
        if count == 0:
            break
    if least:
        raise DressingError(
            f"a body as thin as a line still crosses the garment, at {least:,} pairs of faces: its sleeves or legs do "
            "not lead where the limbs are, or it is closed inside. Look at it beside the body; give turn=, unit= or "
            "up=, or put it around the body and give place=False."
        )
    points, level = rest + best, last
    while level > 0 and crossing(points, level - 1) == 0:
        level -= 1
    return points, min(level + 2, last) if level else 0


def _grown(drape: Drape, growing: _Growing, level: int, cloth: Garment, progress: bool) -> int:
    """Grows the body in the garment and brings it to its pose; returns the number of steps."""
    from tqdm import tqdm

    bodies = [growing.thin[k] for k in range(level - 1, -1, -1)]
    low, high = drape.points.numpy().min(0) - 0.05, drape.points.numpy().max(0) + 0.05
    near = ((growing.posed(1.0) > low) & (growing.posed(1.0) < high)).all(1)
    bodies += growing.back(near)
    for body in tqdm(bodies, desc="growing", disable=not progress, leave=False):
        drape.step(body, gravity=0.1)
    return len(bodies)


def _cleared(drape: Drape, at: np.ndarray, cloth: Garment) -> int:
    """Keeps more distance where the body comes through edges and faces; returns the number of steps."""
    for done in range(6):
        depth = depth_of(drape.points, cloth.edges, cloth.faces, drape.body)
        if float(depth.garments[0]) <= 0.0:
            return 3 * done
        drape.keep += 1.5 * depth.missing
        for _ in range(3):
            drape.step(at)
    return 18


def _moved(cloth: Garment, where: Placement, shifted: np.ndarray, garment: Garment) -> tuple[float, float, float]:
    before = where.scale * garment.simulated.garment.vertices.astype(np.float64) @ where.rotation.T
    way = cloth.vertices.mean(0) - before.mean(0) + shifted.mean(0)
    return (float(way[0]), float(way[1]), float(way[2]))


def _check(points: np.ndarray, faces: np.ndarray, roles: Roles, limbs: Limbs, report: DressReport) -> None:
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
