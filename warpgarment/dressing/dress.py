"""Dresses a body in garments that were modelled on another one, in another pose, place or unit.

1. The openings of a garment say what it is (openings.py), the mesh of the body where its limbs are (limbs.py).
2. Unit, axis, turn and place (place.py).
3. Arms and legs of the body follow sleeves and trouser legs (bend.py), and the body is thinned (grow.py) until nothing
   of it crosses the garment. What it wears already is thinned with it (growing.py).
4. It grows again, goes back to its pose, and the garment with it, by physics (drape.py); then gravity settles it, with
   the garments beneath.
5. What came of it is measured (measure.py, layers.py).

Several garments come on one after the other, the innermost first.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch

from warpgarment.errors import DressingError, MeshError, UsageError
from warpgarment.geometry.checks import checked_faces, checked_positions
from warpgarment.geometry.orientation import turned_outward
from warpgarment.kernels.sdf import BodyMeshes
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.outfit import Outfit

from .layers import put_on
from .limbs import limbs_of
from .measure import pairs_of
from .pieces import Piece, check, prepared, report_of
from .report import DressReport, OutfitReport

STANDS = 0.4, 3.5
"""Heights [m] between which a body is one in metres."""


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


@dataclass(frozen=True, eq=False)
class DressedOutfit(Sequence[Dressed]):
    """Garments over each other on the first frame of a body; a sequence of `Dressed`, innermost first.

        worn = wg.dress([shirt, skirt], walk)
        shirt_motion, skirt_motion = simulator.rollout(worn.outfit, walk, first_vertices=worn.vertices)

    Attributes:
        pieces: The garments, innermost first.
        outfit: The garments at rest, as `Simulator.rollout` takes them.
        report: The report of each, and how pairs of them lie on each other.
    """

    pieces: tuple[Dressed, ...]
    outfit: Outfit
    report: OutfitReport

    @property
    def vertices(self) -> list[np.ndarray]:
        """Vertices of each garment on the first frame [m], float32 [V,3]."""
        return [one.vertices for one in self.pieces]

    def __len__(self) -> int:
        return len(self.pieces)

    @overload
    def __getitem__(self, index: int) -> Dressed: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Dressed, ...]: ...

    def __getitem__(self, index: Any) -> Any:
        return self.pieces[index]


@overload
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
) -> Dressed: ...


@overload
def dress(
    garment: Sequence[Garment],
    body: Any,
    *,
    unit: str | Sequence[str | None] | None = None,
    up: str | Sequence[str | None] | None = None,
    scale: float | str | Sequence[float | str | None] | None = None,
    turn: float | Sequence[float | None] | None = None,
    place: bool | Sequence[bool] = True,
    pins: str | Sequence[str | None] | None = None,
    material: Material | Sequence[Material | None] | None = None,
    progress: bool = False,
) -> DressedOutfit: ...


def dress(
    garment: Garment | Sequence[Garment],
    body: Any,
    *,
    unit: str | Sequence[str | None] | None = None,
    up: str | Sequence[str | None] | None = None,
    scale: float | str | Sequence[float | str | None] | None = None,
    turn: float | Sequence[float | None] | None = None,
    place: bool | Sequence[bool] = True,
    pins: str | Sequence[str | None] | None = None,
    material: Material | Sequence[Material | None] | None = None,
    progress: bool = False,
) -> Dressed | DressedOutfit:
    """Puts a garment, or several over each other, on the first frame of a body.

    Nothing is known but meshes. The openings of a garment (neck, cuffs, waist, hems) and the shape of the body
    tell its unit, axis, turn and place; a thinned body grows in the garment, and physics settles it. The report says
    everything that was guessed. Of several garments, each comes on over those before, and crosses none of them.

    Args:
        garment: The garment, in any unit, pose and place, as `Garment.load` read it; or several, innermost first, of
            which each option below is one for all, or a list with one for each.
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
        material: Cloth; None: that of the outfit, or jersey.
        progress: Whether a progress bar is shown.

    Raises:
        DressingError: It cannot be put on: no opening for a body, the wrong size, sleeves that do not lead where arms
            are, or it falls off. The message says what to do.
        MeshError: The body is no mesh, or not in metres.
        UsageError: As many options as garments were not given.
    """
    garments = [garment] if isinstance(garment, Garment) else list(garment)
    if not garments:
        raise UsageError("dress was given no garment.")
    if material is None and isinstance(garment, Outfit):
        material = garment.materials
    given = {"unit": unit, "up": up, "scale": scale, "turn": turn, "place": place, "pins": pins, "material": material}
    options = _each(given, len(garments))
    at, faces = _first_frame(body)
    limbs = limbs_of(at, faces)
    if not STANDS[0] <= limbs.height <= STANDS[1]:
        raise MeshError(
            f"the body is {limbs.height:.3g} m tall. Load it with unit= or up=, so that it stands in metres, Y up."
        )
    found: list[Piece] = []
    points: list[np.ndarray] = []
    for number, (one, more) in enumerate(zip(garments, options, strict=True)):
        began = time.perf_counter()
        with _named(one, number, len(garments)):
            piece = prepared(one, at, faces, limbs, **more)
            put = put_on(piece.ready, [f.ready for f in found], points, at, faces, limbs, progress)
        seconds = time.perf_counter() - began
        found.append(piece._replace(start=put.start, thin=put.thin, steps=put.steps, seconds=seconds))
        points = put.points
    meshes = BodyMeshes(*(torch.from_numpy(np.ascontiguousarray(a, t)) for a, t in ((at, "f4"), (faces, "i4"))))
    pieces = []
    for number, (piece, at_end) in enumerate(zip(found, points, strict=True)):
        report = report_of(piece, at_end, at, faces, meshes)
        with _named(piece.garment, number, len(garments)):
            check(at_end, piece.ready.cloth.faces, piece.ready.roles, limbs, report)
        vertices = piece.worn.simulated.restored(at_end.astype(np.float32))
        pieces.append(Dressed(piece.worn, vertices, report))
    if isinstance(garment, Garment):
        return pieces[0]
    names = [one.name or f"garment {number}" for number, one in enumerate(garments)]
    layers = [(name, p, one.ready.cloth.faces) for name, p, one in zip(names, points, found, strict=True)]
    materials = garment.materials if isinstance(garment, Outfit) else None
    outfit = Outfit([one.garment for one in pieces], materials)
    reports = OutfitReport(tuple(one.report for one in pieces), pairs_of(layers, meshes))
    return DressedOutfit(tuple(pieces), outfit, reports)


def _each(given: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """The options of each of `count` garments."""
    lists = {}
    for name, value in given.items():
        lists[name] = list(value) if isinstance(value, list | tuple) else [value] * count
        if len(lists[name]) != count:
            raise UsageError(f"{count} garments and {len(lists[name])} of {name}. Give one for each, or one for all.")
    return [{name: values[k] for name, values in lists.items()} for k in range(count)]


@contextmanager
def _named(garment: Garment, number: int, count: int) -> Iterator[None]:
    """Puts the name of one of several garments before errors about it."""
    try:
        yield
    except DressingError as error:
        if count == 1:
            raise
        raise DressingError(f"{garment.name or f'garment {number}'}: {error}") from None


def _first_frame(body: Any) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m], float64 [U,3], and faces of the first frame of a body."""
    if isinstance(body, BodyMotion):
        return body.vertices[0].astype(np.float64), body.faces
    if not (isinstance(body, tuple) and len(body) == 2):
        raise MeshError("body must be a BodyMotion or (vertices, faces).")
    vertices = checked_positions(body[0], name="body vertices")
    faces = checked_faces(body[1], len(vertices), name="body faces")
    return vertices.astype(np.float64), turned_outward(vertices, faces, "the body")
