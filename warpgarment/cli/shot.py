"""One shot of `simulate`: its options, checked before anything is loaded, and what they name, loaded."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from warpgarment.errors import UsageError
from warpgarment.io.disk.outputs import check_space
from warpgarment.io.files import has_bones
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.wind import Wind
from warpgarment.progress import counted

from . import spoken
from .outdoors import check_read, materials_of, wind_of
from .outputs import Output
from .pieces import Piece, outputs_of, pieces_of

Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="GARMENT [GARMENT ...] BODY")]


@dataclass
class Shot:
    """Options of `simulate` that belong to one shot, and so to one line of a list of jobs."""

    files: tyro.conf.Positional[Files] = ()
    """First the rest mesh of each garment, innermost first, draped on the body's first frame (or see --fit-rest): .obj,
    .ply, .glb, .usd, .abc, .npz. Last the body's motion: .npz, .usd, .abc, .glb, .pc2 or .mdd with its .obj beside it,
    a folder of .obj; or the motion of a skeleton, .bvh or .npz of AMASS, which moves --body-shape."""
    out: Output | None = None
    """Where to write: .usd, .abc, .glb, .pc2, .mdd, .npz, or a folder of .obj (no suffix). Polygons, UVs, materials
    and groups of the garment's file stay; glTF has triangles only, and normals are left to whoever shows the result.
    Several garments go into one .usd or .abc, or each into its own file, with {name} for its name: out/{name}.pc2."""
    layers: bool = False
    """Keep garments from crossing each other and themselves. The exit status is 3 if the result is not free of
    crossings, or not all of it was looked at."""
    material: tuple[str, ...] = ()
    """Material of each garment, or one for all, for networks that read it: a preset (cotton, denim, jersey, rib, ponte,
    silk, leather), assignments in SI units (density=0.3,bend=1e-3), both (cotton,bend=0.01), none, or a .json file."""
    wind: tuple[float, float, float] | None = None
    """Velocity of the air along X, Y and Z [m/s], for networks that read it; Y is up."""
    wind_file: Path | None = None
    """Wind over time: a .npz with velocity [T,3] (or direction and speed) and maybe fps, or a .csv of x, y, z [m/s]."""
    wind_fps: float | None = None
    """Rows a second of the wind's file, where it does not say; by default those of the body."""
    unit: str | None = None
    """Length unit of the garment's file where it is not metres: m, dm, cm, mm or in."""
    body_unit: str | None = None
    """The same for the body's."""
    up: Literal["y", "z"] | None = None
    """Axis that points up in the garment's file; by default Y, or what the file says."""
    body_up: Literal["y", "z"] | None = None
    """The same for the body's; by default that of the garment's."""
    body_fps: float | None = None
    """Rate of the body's motion, where its file does not say (.pc2, folders of .obj) or says something else."""
    garment_mesh: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Name of the mesh where the garment's file holds several. Once for each garment; of a single file, several."""
    body_mesh: str | None = None
    """Name of the mesh where the body's file holds several."""
    body_shape: str | None = None
    """The body that a .bvh or AMASS motion moves: bundled (the default), anny, anny with values from 0 to 1
    (anny,height=0.7,weight=0.3), or an .npz of SMPL, SMPL-H or SMPL-X."""
    clean: bool = False
    """Join seams (open borders whose vertices are at the same place, within 5 % of the edge length), turn faces that
    disagree, drop broken ones. Written are all vertices of the file, in its order."""
    fit_rest: Path | None = None
    """The body (same vertices as BODY) as the garment was modelled on it: carries the garment to the first frame. Of a
    .bvh or AMASS motion, BODY itself included, this is its body at rest."""
    dress: bool = False
    """Put the garments on the body's first frame before, as `warpgarment dress` does: they may have been modelled on
    another body, in another pose, place or unit. Several come on over each other; give --layers too."""
    frames: int | None = None
    """Simulate only the first so many frames."""
    out_fps: float | Literal["body", "network"] = "body"
    """Frames per second of the result: a number, those of the body, so that the garment lies in the shot frame by
    frame, or those of the network (30), which are simulated in any case. It begins and ends with the body."""


class Checked(NamedTuple):
    """A shot of which everything that can be seen without loading its files has been.

    Attributes:
        shot: Its options.
        pieces: Its garments.
        outputs: Where each garment is written, by its name.
        materials: A material, or None, for each garment; empty if none is given.
        windy: Whether there is wind.
        pins: Pins of each garment, or None for those of its file; empty for those of the files of all.
    """

    shot: Shot
    pieces: list[Piece]
    outputs: dict[str, Path]
    materials: list[Material | None]
    windy: bool
    pins: Sequence[Any] = ()

    @property
    def garments(self) -> list[Path]:
        """Files of the garments."""
        return list(dict.fromkeys(piece.file for piece in self.pieces))

    def check_read(self, reads: Collection[str], weights: str) -> None:
        """Refuses materials and wind for a network that does not read them, see `outdoors.check_read`."""
        check_read(reads, weights, {"materials": bool(self.materials), "wind": self.windy})


def checked(
    shot: Shot, materials: Sequence[Any] | None = None, pins: Sequence[Any] = (), *, written: bool = True
) -> Checked:
    """Checks options as far as that is possible without loading files.

    Args:
        shot: The options.
        materials: Materials, as of `materials_of`, in place of those of the options.
        pins: As of `Checked`.
        written: Whether the result is written.

    Raises:
        UsageError, OutputError, FileExistsError, FileNotFoundError, MissingExtra: What cannot be, or be written.
    """
    if shot.out is None and written:
        raise UsageError("--out is missing: where to write the result.")
    pieces = pieces_of(shot.files[:-1], shot.garment_mesh)
    outputs = {} if shot.out is None else outputs_of(shot.out, pieces, (*shot.files, shot.fit_rest))
    if isinstance(shot.out_fps, float) and not 0 < shot.out_fps < math.inf:
        raise UsageError(f"--out-fps {shot.out_fps:g}: a positive number of frames a second, body or network.")
    if shot.dress and shot.fit_rest is not None:
        raise UsageError("--dress and --fit-rest: both put the garment on the body. Give one of them.")
    known = materials_of(shot.material if materials is None else materials, len(pieces))
    wind = wind_of(shot.wind, shot.wind_file, shot.wind_fps, 30.0)
    return Checked(shot, pieces, outputs, known, wind is not None, pins)


class Loaded(NamedTuple):
    """What a shot names.

    Attributes:
        checked: The shot.
        garments: Its garments, by their names.
        body: Its body.
        first: First positions of each garment; None: as they lie in their files.
        wind: The wind, or None.
    """

    checked: Checked
    garments: dict[str, Garment]
    body: BodyMotion
    first: list[Any] | None
    wind: Wind | None

    @property
    def rate(self) -> float | Literal["body"] | None:
        """Frames per second of the result, as `Simulator.rollout` takes them."""
        return None if self.checked.shot.out_fps == "network" else self.checked.shot.out_fps

    def frames(self, network: float) -> int:
        """Number of frames of the result; `network` is the network's rate."""
        fps = self.body.fps if self.rate == "body" else self.rate or network
        return self.body.clock.resampled(fps, self.checked.shot.frames)[0].frames

    def check_space(self, network: float) -> None:
        """Refuses an output for which the disk has no room; `network` is the network's rate.

        Raises:
            OutputError: There is too little.
            MeshError: The result would have too many frames.
        """
        assert self.checked.shot.out is not None
        count = sum(len(garment.vertices) for garment in self.garments.values())
        check_space(self.checked.shot.out, 12.0 * count * self.frames(network))


Load = Callable[..., Any]


def loaded(known: Checked, garment: Load = Garment.load, body: Load = BodyMotion.load, where: str = "") -> Loaded:
    """Loads what a shot names, and fits its garments if that is asked for.

    Args:
        known: The shot.
        garment: Function that loads a garment.
        body: Function that loads a body.
        where: What a warning is about, as of `spoken`.

    Raises:
        MeshError, FileNotFoundError: As of `Garment.load` and `BodyMotion.load`.
    """
    shot = known.shot
    with spoken(where, mesh="--garment-mesh", unit="--unit", up="--up", clean="--clean"):
        told: dict[str, Any] = {"unit": shot.unit, "up": shot.up, "clean": shot.clean}
        pins = known.pins or [None] * len(known.pieces)
        garments = {
            piece.name: garment(piece.file, mesh=piece.mesh, pins=tied, **told)
            for piece, tied in zip(known.pieces, pins, strict=True)
        }
    moving = _body(shot.files[-1], shot, body, where)
    wind = wind_of(shot.wind, shot.wind_file, shot.wind_fps, moving.fps)
    if shot.dress:
        garments, first = _dressed(garments, moving, where)
        return Loaded(known, garments, moving, first, wind)
    return Loaded(known, garments, moving, _fitted(list(garments.values()), shot, body, where), wind)


def _dressed(garments: dict[str, Garment], body: BodyMotion, where: str) -> tuple[dict[str, Garment], list[Any]]:
    """Garments on the first frame of a body, and their first positions; what was guessed is said."""
    from warpgarment.dressing.dress import dress

    worn = dress(list(garments.values()), body, progress=sys.stderr.isatty())
    with spoken(where, scale="--scale", unit="--unit", up="--up"):
        for name, one in zip(garments, worn, strict=True):
            for words in (*one.report.notes, *one.report.faults):
                warnings.warn(f"{name}: {words}", UserWarning, stacklevel=1)
        for words in (fault for pair in worn.report.pairs for fault in pair.faults):
            warnings.warn(words, UserWarning, stacklevel=1)
    return dict(zip(garments, worn.outfit, strict=True)), worn.vertices


def _fitted(garments: list[Garment], shot: Shot, body: Load, where: str) -> list[Any] | None:
    """First positions of garments that were modelled on another pose; None if that is not said."""
    if shot.fit_rest is None:
        return None
    from warpgarment.objects.fit import fit

    whole = _body(shot.files[-1], shot, body, where, collider=False)
    bones = has_bones(shot.fit_rest)
    given = {"shape": shot.body_shape} if bones else {"shape": None, "rest": False}
    rest = _body(shot.fit_rest, shot, body, where, collider=False, mesh=None, **{"rest": True, **given})
    rest_body, first_body = (rest.vertices[0], rest.faces), (whole.vertices[0], whole.faces)
    each = counted(garments, "fitting", unit="garment", total=len(garments))
    return [fit(garment, rest_body, first_body) for garment in each]


def _body(path: Path, shot: Shot, body: Load, where: str, **more: Any) -> BodyMotion:
    """A motion in the body's unit, axis and rate."""
    told = {"unit": shot.body_unit, "up": shot.body_up or shot.up, "fps": shot.body_fps, "mesh": shot.body_mesh}
    told["shape"] = shot.body_shape
    with spoken(where, mesh="--body-mesh", unit="--body-unit", up="--body-up", fps="--body-fps", shape="--body-shape"):
        found: BodyMotion = body(path, **told | more)
    return found


def whole_body(shot: Shot) -> BodyMotion:
    """The body with the parts that garments do not collide with, such as hands."""
    return _body(shot.files[-1], shot, BodyMotion.load, "", collider=False)
