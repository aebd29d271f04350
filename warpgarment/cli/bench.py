"""`warpgarment bench`: how long a frame takes on this machine, by stage."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Any

from warpgarment import demo
from warpgarment.errors import UsageError
from warpgarment.view.report import STAGES, table


@dataclass
class Bench:
    """Options of `bench`."""

    batch: tuple[int, ...] = (1,)
    """How many dresses at once; several numbers make several columns, as in --batch 1 16 256."""
    frames: int = 30
    """Frames to time, after three that are not."""
    device: str | None = None
    """cpu or cuda:0; by default a GPU where there is one."""
    weights: str = "default"
    """Network: a name that ships with the package, or a checkpoint file or folder."""
    face_splits: int = 1
    """Show the network so many subsets of the faces, one at a time."""
    half: bool = False
    """Run the network in bfloat16."""


def run(options: Bench) -> None:
    """Times the bundled dress on the bundled body."""
    import torch

    from warpgarment.sim.simulator import Simulator

    if options.frames < 1 or min(options.batch, default=0) < 1:
        raise UsageError("--frames and --batch must be at least 1.")
    assets = demo.assets()
    dress = assets.garments["dress"]
    frames = min(3 + options.frames, assets.collider.frames)
    columns: list[dict[str, float]] = []
    for count in options.batch:
        simulator = Simulator.from_pretrained(options.weights, device=options.device, half=options.half)
        simulator.timings.synchronise = True
        first = [dress.first_vertices] * count
        arguments: dict[str, Any] = {"first_vertices": first, "face_splits": options.face_splits}
        garments = [dress.garment] * count
        simulator.rollout(garments, assets.collider, frames=3, **arguments)
        simulator.timings.clear()
        began = time.perf_counter()
        shown = sys.stderr.isatty()
        simulator.rollout(garments, assets.collider, frames=frames, progress=shown, **arguments)
        elapsed = time.perf_counter() - began
        columns.append({**simulator.timings, "all, with set-up": elapsed})
    scale = 1e3 / (frames - 1)
    stages = [s for s in STAGES if any(s in c for c in columns)]
    stages += [*sorted({s for c in columns for s in c} - {*stages, "all, with set-up"}), "all, with set-up"]
    rows: list[list[object]] = [[s, *(f"{scale * c.get(s, 0.0):.2f}" for c in columns)] for s in stages]
    together = zip(columns, options.batch, strict=True)
    rows.append(["all, per garment", *(f"{scale * c['all, with set-up'] / n:.2f}" for c, n in together)])
    where = torch.cuda.get_device_name(simulator.device) if simulator.device.type == "cuda" else "cpu"
    faces = len(dress.garment.faces)
    print(
        f"{where}, {torch.get_num_threads()} threads, torch {torch.__version__}, {faces:,} faces, {frames - 1} frames"
    )
    print(table(["ms a frame", *(f"batch {n}" for n in options.batch)], rows))
