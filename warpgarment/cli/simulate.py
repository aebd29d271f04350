"""`warpgarment simulate`: a garment file and a body motion in, the garment's motion out."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from warpgarment.errors import UsageError
from warpgarment.io.disk.outputs import check_space
from warpgarment.io.files import suffixes
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.clock import in_words
from warpgarment.objects.facts import Facts
from warpgarment.objects.garment import Garment
from warpgarment.view.facts import facts_table
from warpgarment.view.report import rollout_table

from . import spoken
from .outputs import Output, check_output


@dataclass
class Simulate:
    """Options of `simulate`."""

    garment: tyro.conf.Positional[Path]
    """Rest mesh of the garment, draped on the body's first frame (or see --fit-rest): .obj, .ply, .glb, .usd, .npz."""
    body: tyro.conf.Positional[Path]
    """Body motion: .npz, .usd, .glb, .pc2 with its .obj beside it, or a folder of .obj."""
    out: Output
    """Where to write: .usd, .glb, .pc2, .npz, or a folder of .obj (no suffix). Polygons, UVs, materials and groups of
    the garment's file stay; glTF has triangles only, and normals are left to whoever shows the result."""
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
    garment_mesh: str | None = None
    """Name of the mesh where the garment's file holds several."""
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


def run(options: Simulate) -> None:
    """Loads, says what the files hold, fits if asked, rolls out, writes, and says how it went."""
    check_output(options.out, suffixes("write_motion"), (options.garment, options.body, options.fit_rest))
    if isinstance(options.out_fps, float) and not 0 < options.out_fps < math.inf:
        raise UsageError(f"--out-fps {options.out_fps:g}: a positive number of frames a second, body or network.")
    from warpgarment.sim.simulator import Simulator

    with spoken(mesh="--garment-mesh", unit="--unit", up="--up", clean="--clean"):
        garment = Garment.load(
            options.garment, unit=options.unit, up=options.up, mesh=options.garment_mesh, clean=options.clean
        )
    body = _body(options.body, options)
    print(facts_table({"garment": Facts.of(garment), "body": Facts.of(body)}), end="\n\n", flush=True)
    simulator = Simulator.from_pretrained(options.weights, device=options.device)
    simulator.timings.synchronise = True
    first = None
    if options.fit_rest is not None:
        from warpgarment.objects.fit import fit

        whole = _body(options.body, options, collider=False)
        rest = _body(options.fit_rest, options, collider=False, mesh=None)
        first = fit(garment, (rest.vertices[0], rest.faces), (whole.vertices[0], whole.faces))
    rate = None if options.out_fps == "network" else options.out_fps
    known: dict[str, Any] = {"first_vertices": first, "frames": options.frames, "out_fps": rate}
    with spoken(fps="--body-fps or --out-fps"):
        fps = body.fps if rate == "body" else rate or simulator.network.config.fps
        frames = body.clock.resampled(fps, options.frames)[0].frames
        check_space(options.out, len(garment.vertices) * frames * 12)
        motion = simulator.rollout(garment, body, **known, progress=sys.stderr.isatty())
    with spoken(out="--out"):
        motion.save(options.out)
    name = garment.name or "garment"
    print(rollout_table({name: motion}, {name: simulator.timings}))
    print(f"\nwrote {options.out}: {in_words(motion.clock)}")


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
