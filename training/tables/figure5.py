"""Figure 5: the time of a frame by stage and number of faces."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment import demo
from warpgarment.kernels.replay.pieces import FIRST
from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator
from warpgarment.view import draw
from warpgarment.view.report import STAGES

from .meshing import remesh
from .pictures import axes_of, save
from .report import grid, publish

FRAMES = 30
WARM_UP = FIRST  # frames that are not timed: kernels are compiled, and recorded
NOTE = (
    "The bundled dress, remeshed, on the bundled walk, one garment at a time; mean over the half of the frames that "
    "are neither fast nor slow. Rest: all that is in no stage. Set-up (geodesics, matrices) is once per garment."
)


def make(config: Any) -> dict[str, Any]:
    """Times every number of faces and writes the figure."""
    path = checkpoint.find(config.network, device=config.device)
    simulator = Simulator(checkpoint.load(path), config.device)
    simulator.timings.synchronise = True
    frames = config.frames or FRAMES
    rows = [timed(simulator, faces, frames) for faces in config.tables.faces]
    stages = [s for s in (*STAGES, "rest") if any(row["ms"].get(s) for row in rows)]
    stages[-1:-1] = sorted({s for row in rows for s in row["ms"]} - {*stages, "rest"})
    result: dict[str, Any] = {"table": "figure5", "title": "Figure 5: time by stage", "protocol": NOTE}
    result |= {"network": path.name, "frames": frames, "rows": rows}
    lines = [[f"{r['faces']:,}", *(f"{r['ms'].get(s, 0.0):.1f}" for s in stages)] for r in rows]
    lines = [[*line, f"{row['frame_ms']:.1f}", f"{row['setup_s']:.2f}"] for line, row in zip(lines, rows, strict=True)]
    headings = ["faces", *(f"{s} [ms]" for s in stages), "frame [ms]", "set-up [s]"]
    publish(config, result, [NOTE, "", *grid(headings, lines)], lambda target: _draw(target, rows, stages))
    return result


def timed(simulator: Simulator, faces: int, frames: int) -> dict[str, Any]:
    """Milliseconds per stage and frame for the bundled dress, remeshed to about a number of faces."""
    bundle = demo.assets()
    item = bundle.garments["dress"]
    new = remesh(item.garment, faces)
    body = bundle.collider
    first = new.carried(item.first_vertices)
    began = time.perf_counter()
    state = simulator.start(new.garment, body.vertices[0], body.faces, first_vertices=first)
    setup = time.perf_counter() - began
    spent: list[dict[str, float]] = []
    for frame in range(1, min(frames + WARM_UP, body.frames - 1) + 1):
        simulator.timings.clear()
        began = time.perf_counter()
        state = simulator.step(state, body.vertices[frame])
        stages = dict(simulator.timings)
        whole = time.perf_counter() - began
        spent.append(stages | {"rest": whole - sum(stages.values()), "frame": whole})
    ordered = sorted(spent[WARM_UP:] or spent, key=lambda frame: frame["frame"])
    counted = ordered[len(ordered) // 4 : len(ordered) - len(ordered) // 4]
    mean = {stage: 1e3 * float(np.mean([frame.get(stage, 0.0) for frame in counted])) for stage in counted[0]}
    whole_ms = mean.pop("frame")
    return {"faces": len(new.garment.faces), "ms": mean, "frame_ms": whole_ms, "setup_s": setup}


def _draw(path: Path, rows: list[dict[str, Any]], stages: list[str]) -> None:
    """One bar of stages for each number of faces."""
    figure, (axis,) = axes_of(1, height=4.0, width=1.5 + 1.3 * len(rows) + 2.0)
    labels = [f"{row['faces']:,}" for row in rows]
    colors = (draw.SKIN, draw.TEAL, draw.CORAL, draw.OCHRE, draw.PLUM, draw.SLATE, "#444b55")
    below = np.zeros(len(rows))
    for k, stage in enumerate(stages):
        values = np.array([row["ms"].get(stage, 0.0) for row in rows])
        axis.bar(labels, values, 0.6, bottom=below, label=stage, color=colors[k % len(colors)])
        below += values
    axis.set(xlabel="faces", ylabel="time [ms a frame]")
    axis.grid(axis="y", alpha=0.3)
    handles, names = axis.get_legend_handles_labels()
    axis.legend(handles[::-1], names[::-1], frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    save(figure, path)
