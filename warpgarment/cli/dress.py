"""`warpgarment dress`: a garment of another body, pose, place or unit onto the first frame of a body."""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from warpgarment.dressing.dress import dress
from warpgarment.dressing.picture import draw_dressed
from warpgarment.errors import DressingError, MeshError, UsageError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.outputs import check_writable
from warpgarment.io.files import suffixes
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from . import NOT_FREE, spoken
from .outputs import Output, check_output


@dataclass
class Dress:
    """Options of `dress`."""

    garment: tyro.conf.Positional[Path]
    """The garment as it was modelled: .obj, .ply, .off, .stl, .glb, .npz or .usd."""
    body: tyro.conf.Positional[Path]
    """The body, of whose motion the first frame counts: .npz, .usd, .abc, .glb, .pc2 or .mdd with its .obj, a mesh."""
    out: Output
    """Where to write the garment as it lies on the first frame: .obj, .ply, .npz, .glb or .usd; .npz keeps its pins."""
    unit: str | None = None
    """Length unit of the garment's file: m, dm, cm, mm or in; by default what the file says, or the one that fits."""
    up: Literal["y", "z"] | None = None
    """Axis that points up in the garment's file; by default what the file says, or what its openings say."""
    garment_mesh: str | None = None
    """Name of the mesh where the garment's file holds several."""
    body_unit: str | None = None
    """Length unit of the body's file, where it is not metres."""
    body_up: Literal["y", "z"] | None = None
    """Axis that points up in the body's file; by default Y, or what the file says."""
    body_mesh: str | None = None
    """Name of the mesh where the body's file holds several."""
    body_shape: str | None = None
    """Body that a file of a skeleton's motion (.bvh, AMASS) moves, as `simulate --body-shape`."""
    scale: str | None = None
    """Change of size beyond the unit: a number, or fit for the one with which the openings are as wide as usual."""
    turn: float | None = None
    """Turn about the vertical in degrees; by default so that the garment looks where the body looks."""
    keep_place: bool = False
    """Leave the garment where it is: it lies around the body already."""
    pins: str | None = None
    """What is tied to the body: waist, none, the name of a group, material or object, or a material's colour as
    #rrggbb; by default the pins of an .npz, or what is named waistband, elastic, strap, belt or pin."""
    clean: bool = False
    """Join seams and repair the mesh, as `simulate --clean` does."""
    material: str = "jersey"
    """Cloth with which it is settled: cotton, denim, jersey, rib, ponte, silk or leather."""
    report: Path | None = None
    """Write the report to this .json file too."""
    picture: Path | None = None
    """Draw the dressed body to this .png file."""


def run(options: Dress) -> int:
    """Loads, dresses, writes, and says what was done.

    Returns:
        The exit status: 0, or `NOT_FREE` for a garment that was written and does not lie well.
    """
    _check(options)
    material = Material.preset(options.material)
    names = {"mesh": "--garment-mesh", "unit": "--unit", "up": "--up", "clean": "--clean", "scale": "--scale"}
    with spoken(**names):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*the garment would be .* m in size")  # the report says it
            garment = Garment.load(options.garment, clean=options.clean, mesh=options.garment_mesh)
    with spoken(mesh="--body-mesh", unit="--body-unit", up="--body-up", fps="--body-fps", shape="--body-shape"):
        warnings.filterwarnings("ignore", message=".*the file has no rate")  # one frame has none
        told: dict[str, Any] = {"unit": options.body_unit, "up": options.body_up, "mesh": options.body_mesh}
        body = BodyMotion.load(options.body, **told, shape=options.body_shape)
    with spoken(**names, turn="--turn", pins="--pins", place="--keep-place"):
        try:
            dressed = dress(
                garment,
                body,
                unit=options.unit,
                up=options.up,
                scale=_scale(options.scale),
                turn=options.turn,
                place=not options.keep_place,
                pins=options.pins,
                material=material,
                progress=sys.stderr.isatty(),
            )
        except DressingError as error:
            raise DressingError(f"{options.garment}: {error}") from None
        except MeshError as error:
            raise MeshError(
                f"{options.body}: {error}".replace("unit=", "--body-unit").replace("up=", "--body-up")
            ) from None
    print(dressed.report)
    dressed.save(options.out)
    written = [options.out]
    if options.report is not None:
        with atomic_file(options.report) as temporary:
            temporary.write_text(json.dumps(dressed.report.values(), indent=1) + "\n", encoding="utf-8")
        written.append(options.report)
    if options.picture is not None:
        draw_dressed(options.picture, dressed, body)
        written.append(options.picture)
    print(f"\nwrote {', '.join(map(str, written))}")
    return NOT_FREE if dressed.report.faults else 0


def _check(options: Dress) -> None:
    """Refuses what cannot be written, before time is spent."""
    inputs = (options.garment, options.body)
    check_output(options.out, suffixes("write_mesh"), inputs)
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
        if options.out.exists() and options.out.samefile(file):
            raise UsageError(f"--out {options.out} is read. Choose another name.")


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
