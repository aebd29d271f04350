"""`warpgarment dress`: garments of another body, pose, place or unit onto the first frame of a body."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import tyro

from warpgarment.dressing.dress import Dressed, DressedOutfit, dress
from warpgarment.dressing.picture import draw_dressed
from warpgarment.errors import DressingError, MeshError, UsageError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.outputs import check_writable
from warpgarment.io.together import write_together
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from . import NOT_FREE, spoken
from .outputs import Output, check_output
from .pieces import Piece, outputs_of, pieces_of

Value = TypeVar("Value")
Each = Annotated[tuple[Value, ...], tyro.conf.UseAppendAction]
Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="GARMENT [GARMENT ...] BODY")]


@dataclass
class Dress:
    """Options of `dress`."""

    files: tyro.conf.Positional[Files]
    """First the garments as they were modelled, innermost first: .obj, .ply, .off, .stl, .glb, .npz or .usd. Last the
    body, of whose motion the first frame counts: .npz, .usd, .abc, .glb, .pc2 or .mdd with its .obj, a mesh."""
    out: Output
    """Where to write the garment as it lies on the first frame: .obj, .ply, .npz, .glb or .usd; .npz keeps its pins.
    Several garments go into one .usd or .abc, or each into its own file, with {name} for its name: worn/{name}.npz."""
    body: Path | None = None
    """The body, where all files are garments."""
    unit: Each[str] = ()
    """Length unit of the garment's file: m, dm, cm, mm or in; by default what the file says, or the one that fits. This
    and what follows, up to --material: once for all garments, or once for each."""
    up: Each[Literal["y", "z"]] = ()
    """Axis that points up in the garment's file; by default what the file says, or what its openings say."""
    garment_mesh: Each[str] = ()
    """Name of the mesh where the garment's file holds several. Once for each garment; of a single file, several."""
    scale: Each[str] = ()
    """Change of size beyond the unit: a number, or fit for the one with which the openings are as wide as usual."""
    turn: Each[float] = ()
    """Turn about the vertical in degrees; by default so that the garment looks where the body looks."""
    pins: Each[str] = ()
    """What is tied to the body: waist, none, the name of a group, material or object, or a material's colour as
    #rrggbb; by default the pins of an .npz, or what is named waistband, elastic, strap, belt or pin."""
    material: Each[str] = ("jersey",)
    """Cloth with which it is settled: cotton, denim, jersey, rib, ponte, silk or leather."""
    body_unit: str | None = None
    """Length unit of the body's file, where it is not metres."""
    body_up: Literal["y", "z"] | None = None
    """Axis that points up in the body's file; by default Y, or what the file says."""
    body_mesh: str | None = None
    """Name of the mesh where the body's file holds several."""
    body_shape: str | None = None
    """Body that a file of a skeleton's motion (.bvh, AMASS) moves, as `simulate --body-shape`."""
    keep_place: bool = False
    """Leave the garments where they are: they lie around the body already."""
    clean: bool = False
    """Join seams and repair the mesh, as `simulate --clean` does."""
    report: Path | None = None
    """Write the report to this .json file too."""
    picture: Path | None = None
    """Draw the dressed body to this .png file."""


NAMES = {"mesh": "--garment-mesh", "unit": "--unit", "up": "--up", "clean": "--clean", "scale": "--scale"}
"""Options for arguments of Python in messages about garments."""


def run(options: Dress) -> int:
    """Loads, dresses, writes, and says what was done.

    Returns:
        The exit status: 0, or `NOT_FREE` for garments that were written and do not lie well.
    """
    pieces, file, outputs = _checked(options)
    materials = [Material.preset(name) for name in options.material]
    with spoken(**NAMES):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*the garment would be .* m in size")  # the report says it
            garments = [Garment.load(piece.file, clean=options.clean, mesh=piece.mesh) for piece in pieces]
    with spoken(mesh="--body-mesh", unit="--body-unit", up="--body-up", fps="--body-fps", shape="--body-shape"):
        warnings.filterwarnings("ignore", message=".*the file has no rate")  # one frame has none
        told: dict[str, Any] = {"unit": options.body_unit, "up": options.body_up, "mesh": options.body_mesh}
        body = BodyMotion.load(file, **told, shape=options.body_shape)
    given: dict[str, Any] = {"place": not options.keep_place, "progress": sys.stderr.isatty()}
    for name in ("unit", "up", "turn", "pins"):
        given[name] = _each(name, getattr(options, name), len(pieces))
    given["scale"] = _each("scale", [_scale(text) for text in options.scale], len(pieces))
    given["material"] = _each("material", materials, len(pieces))
    worn = put_on(garments, [piece.file for piece in pieces], body, file, given)
    print(worn.report)
    _save(worn, dict(zip([piece.name for piece in pieces], worn, strict=True)), outputs)
    written = list(dict.fromkeys(outputs.values()))
    if options.report is not None:
        values = worn.report.values() if len(worn) > 1 else worn[0].report.values()
        with atomic_file(options.report) as temporary:
            temporary.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
        written.append(options.report)
    if options.picture is not None:
        draw_dressed(options.picture, worn, body)
        written.append(options.picture)
    print(f"\nwrote {', '.join(map(str, written))}")
    return NOT_FREE if worn.report.faults else 0


def put_on(
    garments: Sequence[Garment], files: Sequence[Path], body: BodyMotion, file: Path, given: dict[str, Any]
) -> DressedOutfit:
    """Dresses a body; errors name the files and the options of the command.

    Args:
        garments: The garments, innermost first.
        files: Their files.
        body: The body.
        file: Its file.
        given: Options of `dress`.
    """
    with spoken(**NAMES, turn="--turn", pins="--pins", place="--keep-place"):
        try:
            return dress(garments, body, **given)
        except DressingError as error:
            raise DressingError(f"{files[0]}: {error}" if len(files) == 1 else str(error)) from None
        except MeshError as error:
            raise MeshError(f"{file}: {error}".replace("unit=", "--body-unit").replace("up=", "--body-up")) from None


def _checked(options: Dress) -> tuple[list[Piece], Path, dict[str, Path]]:
    """The garments, the body's file, and where each garment is written; refuses before time is spent."""
    garments, body = (options.files, options.body) if options.body else (options.files[:-1], options.files[-1])
    pieces = pieces_of(garments, options.garment_mesh, verb="dress")
    inputs = (*garments, body)
    outputs = outputs_of(options.out, pieces, inputs, writer="write_mesh")
    for path, suffix in ((options.report, ".json"), (options.picture, ".png")):
        if path is None:
            continue
        if path.suffix.lower() != suffix:
            raise UsageError(f"{path.name!r} must end with {suffix}.")
        check_writable(path)
    if options.picture is not None:
        check_output(options.picture, (".png",))
    for file in inputs:
        if not file.exists():
            raise FileNotFoundError(f"No such file: {file}")
        for out in outputs.values():
            if out.exists() and out.samefile(file):
                raise UsageError(f"--out {out} is read. Choose another name.")
    return pieces, body, outputs


def _each(name: str, values: Sequence[Any], count: int) -> Any:
    """None, the one value for all garments, or a list with one for each."""
    if len(values) > 1 and len(values) != count:
        raise UsageError(f"{count} garments and {len(values)} of --{name}. Give one for each, or one for all.")
    return None if not values else values[0] if len(values) == 1 else list(values)


def _save(worn: DressedOutfit, pieces: dict[str, Dressed], outputs: dict[str, Path]) -> None:
    """Writes each garment to its file, or all of them to the one that all are for."""
    if len(pieces) == 1 or len(set(outputs.values())) > 1:
        for name, piece in pieces.items():
            piece.save(outputs[name])
        return
    meshes = [(name, piece.vertices[None], piece.garment.faces) for name, piece in pieces.items()]
    surfaces = [piece.garment.surface for piece in worn]
    write_together(next(iter(outputs.values())), meshes, 30.0, surfaces)


def _scale(text: str | None) -> float | str | None:
    if text is None or text == "fit":
        return text
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.01 <= value <= 100.0:
        raise UsageError(f"--scale {text}: a number between 0.01 and 100, or fit.")
    return value
