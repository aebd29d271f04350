"""`warpgarment simulate`: garment files and a body motion in, the garments' motions out."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from warpgarment.errors import UsageError
from warpgarment.io.disk.outputs import check_space
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.clock import in_words
from warpgarment.objects.facts import Facts
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.view.facts import facts_table
from warpgarment.view.report import certified, rollout_table

from . import NOT_FREE, spoken
from .outdoors import check_read, materials_of, wind_of
from .outputs import Output
from .pieces import outputs_of, pieces_of, save

Files = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="GARMENT [GARMENT ...] BODY")]


@dataclass
class Simulate:
    """Options of `simulate`."""

    files: tyro.conf.Positional[Files]
    """First the rest mesh of each garment, innermost first, draped on the body's first frame (or see --fit-rest): .obj,
    .ply, .glb, .usd, .npz. Last the body's motion: .npz, .usd, .glb, .pc2 with its .obj beside it, a folder of .obj."""
    out: Output
    """Where to write: .usd, .glb, .pc2, .npz, or a folder of .obj (no suffix). Polygons, UVs, materials and groups of
    the garment's file stay; glTF has triangles only, and normals are left to whoever shows the result. Several garments
    go into one .usd, or each into its own file, with {name} for its name: out/{name}.pc2."""
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
    weights: str = "default"
    """Network: a name that ships with the package, or a checkpoint file or folder."""
    device: str | None = None
    """cpu or cuda:0; by default a GPU where there is one."""
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
    clean: bool = False
    """Join seams (open borders whose vertices are at the same place, within 5 % of the edge length), turn faces that
    disagree, drop broken ones. Written are all vertices of the file, in its order."""
    fit_rest: Path | None = None
    """The body (same vertices as BODY) as the garment was modelled on it: carries the garment to the first frame."""
    frames: int | None = None
    """Simulate only the first so many frames."""
    out_fps: float | Literal["body", "network"] = "body"
    """Frames per second of the result: a number, those of the body, so that the garment lies in the shot frame by
    frame, or those of the network (30), which are simulated in any case. It begins and ends with the body."""


def run(options: Simulate) -> int:
    """Loads, says what the files hold, fits if asked, rolls out, writes, and says how it went.

    Returns:
        The exit status: 0, or `NOT_FREE` for layers that cross somewhere, or were not looked at.
    """
    pieces = pieces_of(options.files[:-1], options.garment_mesh)
    outputs = outputs_of(options.out, pieces, (*options.files, options.fit_rest))
    if isinstance(options.out_fps, float) and not 0 < options.out_fps < math.inf:
        raise UsageError(f"--out-fps {options.out_fps:g}: a positive number of frames a second, body or network.")
    materials = materials_of(options.material, len(pieces))
    wind_of(options.wind, options.wind_file, options.wind_fps, 30.0)  # refused before anything is loaded
    from warpgarment.sim.simulator import Simulator

    with spoken(mesh="--garment-mesh", unit="--unit", up="--up", clean="--clean"):
        told: dict[str, Any] = {"unit": options.unit, "up": options.up, "clean": options.clean}
        garments = {piece.name: Garment.load(piece.file, mesh=piece.mesh, **told) for piece in pieces}
    body = _body(options.files[-1], options)
    shown = {"garment" if len(garments) == 1 else name: Facts.of(garment) for name, garment in garments.items()}
    print(facts_table({**shown, "body": Facts.of(body)}), end="\n\n", flush=True)
    simulator = Simulator.from_pretrained(options.weights, device=options.device)
    simulator.timings.synchronise = True
    wind = wind_of(options.wind, options.wind_file, options.wind_fps, body.fps)
    given = {"materials": bool(materials), "wind": wind is not None}
    check_read(simulator.network.reads, options.weights, given)
    rate = None if options.out_fps == "network" else options.out_fps
    known: dict[str, Any] = {"first_vertices": _fitted(list(garments.values()), options), "wind": wind}
    known |= {"frames": options.frames, "out_fps": rate, "layers": options.layers, "materials": materials or None}
    with spoken(fps="--body-fps or --out-fps"):
        fps = body.fps if rate == "body" else rate or simulator.network.config.fps
        frames = body.clock.resampled(fps, options.frames)[0].frames
        check_space(options.out, sum(len(garment.vertices) for garment in garments.values()) * frames * 12)
        found = simulator.rollout(list(garments.values()), body, **known, progress=sys.stderr.isatty())
    motions = dict(zip(garments, found, strict=True))
    with spoken(out="--out"):
        save(motions, outputs)
    return _told(motions, dict(simulator.timings), outputs, options.layers)


def _told(motions: dict[str, GarmentMotion], timings: dict[str, float], outputs: dict[str, Path], layers: bool) -> int:
    """Says how it went; returns the exit status."""
    if len(motions) == 1:
        (motion,) = motions.values()
        name = motion.name or "garment"
        print(rollout_table({name: motion}, {name: timings}))
    else:
        print(rollout_table(motions, {"all": timings}))
    if len(motions) > 1 and not layers:
        print("without --layers, garments do not see each other")
    faults = {name: certified(motion) for name, motion in motions.items()} if layers else {}
    for name, fault in faults.items():
        print(f"{name}: {fault or 'free of crossings in every frame'}")
    for path in dict.fromkeys(outputs.values()):
        written = next(motions[name] for name in motions if outputs[name] == path)
        print(f"\nwrote {path}: {in_words(written.clock)}")
    return NOT_FREE if any(faults.values()) else 0


def _fitted(garments: list[Garment], options: Simulate) -> list[Any] | None:
    """First positions of garments that were modelled on another pose; None if that is not said."""
    if options.fit_rest is None:
        return None
    from warpgarment.objects.fit import fit

    whole = _body(options.files[-1], options, collider=False)
    rest = _body(options.fit_rest, options, collider=False, mesh=None)
    rest_body, first_body = (rest.vertices[0], rest.faces), (whole.vertices[0], whole.faces)
    return [fit(garment, rest_body, first_body) for garment in garments]


def _body(path: Path, options: Simulate, **more: Any) -> BodyMotion:
    """A motion in the body's unit, axis and rate."""
    told = {
        "unit": options.body_unit,
        "up": options.body_up or options.up,
        "fps": options.body_fps,
        "mesh": options.body_mesh,
    }
    with spoken(mesh="--body-mesh", unit="--body-unit", up="--body-up", fps="--body-fps"):
        return BodyMotion.load(path, **told | more)
