"""`warpgarment simulate`: garment files and a body motion in, the garments' motions out."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpgarment.errors import UsageError
from warpgarment.geometry.stride import Narrow, too_narrow
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.clearance import clearance
from warpgarment.objects.clock import in_words
from warpgarment.objects.facts import Facts
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.view.deep import depth_lines
from warpgarment.view.facts import facts_table
from warpgarment.view.report import certified, rollout_table

from . import NOT_FREE, spoken
from .pieces import save
from .shot import Shot, checked, loaded


@dataclass
class Simulate(Shot):
    """Options of `simulate`."""

    weights: str = "default"
    """Network: a name that ships with the package, or a checkpoint file or folder."""
    device: str | None = None
    """cpu or cuda:0; by default a GPU where there is one."""
    jobs: Path | None = None
    """A list of jobs in place of files and --out: a line of JSON for each, {"garment": "dress.obj", "body": "walk.npz",
    "out": "dress.usd"}, with the options above as further keys. They run in batches that fit in memory; those that are
    done already are left out. Options beside it are those of every job that says nothing else. See docs/jobs.md."""
    batch: int | None = None
    """Most garments that are simulated together, with --jobs; by default 8 on a CPU and 256 on a GPU, as far as they
    fit in memory."""
    results: Path | None = None
    """Where the outcome of each job is kept, with --jobs, from which a run goes on; by default beside the list, as
    jobs.results.jsonl."""
    ray: str | None = None
    """Spread the batches of --jobs over a Ray cluster: its address, or local for one on this machine (extra cluster).
    A batch takes a core, with --device cuda a GPU; all machines see the same files at the same paths."""
    again: bool = False
    """Run all jobs of the list, those that are done too."""
    browser: bool = False
    """Show the garments on a page that a web browser opens, instead of writing them: with sliders for the wind and
    menus for materials, which run the simulation again, for networks that read them (--weights layers)."""
    host: str = "127.0.0.1"
    """Address of the page; 0.0.0.0 lets everybody on the network look, and move the sliders."""
    port: int | None = None
    """Port of the page; by default 8080 or the next one that is free."""


def run(options: Simulate) -> int:
    """Loads, says what the files hold, fits if asked, rolls out, writes, and says how it went.

    Returns:
        The exit status: 0, or `NOT_FREE` for layers that cross somewhere, or were not looked at; or `JOBS_FAILED`.
    """
    if options.jobs is not None and options.browser:
        raise UsageError("--browser and --jobs: give one of them.")
    if options.jobs is not None:
        from .jobs.run import run_jobs

        return run_jobs(
            options,
            options.jobs,
            options.weights,
            options.device,
            options.batch,
            options.results,
            options.again,
            options.ray,
        )
    if options.batch is not None or options.results is not None or options.ray is not None or options.again:
        raise UsageError("--batch, --results, --ray and --again belong to a list of jobs: give it with --jobs.")
    if not options.files:
        raise UsageError("simulate was given no files. Name garments, innermost first, and then the body; or --jobs.")
    if options.browser:
        from .browser import rerun

        rerun(options)
        return 0
    known = checked(options)
    from warpgarment.sim.simulator import Simulator

    shot = loaded(known)
    garments, body = shot.garments, shot.body
    shown = {"garment" if len(garments) == 1 else name: Facts.of(garment) for name, garment in garments.items()}
    print(facts_table({**shown, "body": Facts.of(body)}), end="\n\n", flush=True)
    for name, narrow in _narrow(garments, shot.first, body).items():
        print(f"warpgarment: {name}: {narrow}", file=sys.stderr)
    simulator = Simulator.from_pretrained(options.weights, device=options.device)
    simulator.timings.synchronise = True
    known.check_read(simulator.network.reads, options.weights)
    given: dict[str, Any] = {"first_vertices": shot.first, "wind": shot.wind, "frames": options.frames}
    given |= {"out_fps": shot.rate, "layers": options.layers, "materials": known.materials or None}
    with spoken(fps="--body-fps or --out-fps"):
        shot.check_space(simulator.network.config.fps)
        found = simulator.rollout(list(garments.values()), body, **given, progress=sys.stderr.isatty())
    motions = dict(zip(garments, found, strict=True))
    with spoken(out="--out"):
        save(motions, known.outputs)
    status = _told(motions, dict(simulator.timings), known.outputs, options.layers)
    for name, motion in motions.items():
        for line in depth_lines(motion, body, clearance(garments[name])):
            print(f"{name}: {line}")
    return status


def _narrow(garments: dict[str, Garment], first: list[Any] | None, body: BodyMotion) -> dict[str, Narrow]:
    """Garments that are too narrow for the steps of a body, by name."""
    found = {}
    for k, (name, garment) in enumerate(garments.items()):
        start = garment.vertices if first is None else first[k]
        narrow = too_narrow(garment.vertices, start, garment.faces, body.vertices, body.faces)
        if narrow is not None:
            found[name] = narrow
    return found


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
