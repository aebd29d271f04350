"""Long rollouts, 1,000 frames by default, which show whether garments drift, grow or sink into the body."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warpgarment import demo
from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.data.splits import evenly
from warpgarment.training.rollouts import predict
from warpgarment.training.train.training_set import folders_of
from warpgarment.view import draw
from warpgarment.view.markdown import escape

from .long_rollout import STILL, Limits, extended, figures, judged, settled, vertex_areas, walk
from .options import DataLacks, OptionMissing
from .pictures import axes_of, save
from .protocol import STARTS, Known
from .report import grid, publish

SEQUENCES = 3  # number of sequences of a data set, unless max_sequences is given
HEADINGS = {  # limit -> heading, unit factor, format
    "mean_m": ("mean off [cm]", 100.0, "{:.1f}"),
    "energy_growth": ("energy growth", 1.0, "{:.2f}"),
    "stretch": ("longest edge", 1.0, "{:+.0%}"),
    "penetration_m": ("deepest [mm]", 1000.0, "{:.1f}"),
    "inside": ("inside", 1.0, "{:.2%}"),
}
NOTE = (
    "Walk: the bundled garments on the bundled body, from one frame. Sequences: the body's motion played forth and "
    "back with continuous speed. Mean off: the largest distance of the garment's mean from the recorded one "
    "whenever the motion passes a recorded frame forward; on the walk, from where it settled relative to the body "
    "beneath it (average of the first third, without the first two seconds). Mean from the body: from where it would "
    "be, had it been rigid with the body beneath it, or with what its pins are tied to, from the start. Energy growth: "
    "kinetic energy relative to the body's, both in the frame that travels with the body, last third of the frames "
    "over the first."
)


def make(config: Any) -> dict[str, Any]:
    """Rolls out, measures, judges and writes the table.

    Raises:
        OptionMissing: There is neither a garment for a walk nor data.
        DataLacks: No sequence of the data set can be rolled out.
    """
    options = config.tables
    if config.data is None and not options.garments:
        raise OptionMissing("long needs --data FOLDER or --garments dress tshirt")
    unknown = sorted(set(options.garments) - set(demo.GARMENTS))
    if unknown or options.long_frames < 3:
        what = f"no bundled garments {', '.join(unknown)}; there are {', '.join(demo.GARMENTS)}"
        raise OptionMissing(what if unknown else f"--long-frames must be at least 3, got {options.long_frames}")
    path = checkpoint.find(config.network, device=config.device)
    simulator = Simulator(checkpoint.load(path), config.device)
    rows = [walked(simulator, name, options.long_frames) for name in tqdm(options.garments, desc="walk")]
    skipped: dict[str, str] = {}
    if config.data is not None:
        folders = folders_of(Path(config.data), config.split, skipped)
        measured = []
        for folder in tqdm(evenly(folders, config.max_sequences or SEQUENCES), desc="sequences"):
            try:
                sequence = Sequence.load(folder)
                measured += [forth_and_back(simulator, sequence, start, options.long_frames) for start in STARTS]
            except (ValueError, OSError, KeyError, IndexError) as error:
                skipped[folder.name] = f"{type(error).__name__}: {error}"
        if not measured:
            reasons = "; ".join(f"{n}: {r}" for n, r in skipped.items()) or "none found"
            raise DataLacks(f"{config.data}: no {config.split} sequence can be rolled out ({reasons})")
        rows += measured
    result: dict[str, Any] = {"table": "long", "title": f"Rollouts of {options.long_frames:,} frames", "protocol": NOTE}
    result |= {"network": path.name, "limits": vars(Limits()), "rows": rows, "skipped": skipped}
    headings = ["", "start", *(heading for heading, _, _ in HEADINGS.values()), "mean from the body [cm]", "verdict"]
    limits = [form.format(scale * getattr(Limits(), key)) for key, (_, scale, form) in HEADINGS.items()]
    lines = [["limit", "", *limits, "", ""], *(_cells(row) for row in rows)]
    publish(config, result, [NOTE, "", *grid(headings, lines)], lambda target: _draw(target, rows))
    return result


def walked(simulator: Simulator, name: str, frames: int) -> dict[str, Any]:
    """The row of a bundled garment on a procedural walk, from a cold start."""
    garment = demo.assets().garments[name].garment
    body, place = walk(frames + 1)
    first = (garment.vertices @ place[:, :3].T + place[:, 3]).astype(np.float32)
    vertices = predict(simulator, Known(garment, first[None]), 0, frames, cold=True, body=body)
    curves = figures(garment, vertices, first, body, 1)
    return _row(f"walk, {name}", "cold", curves)


def forth_and_back(simulator: Simulator, sequence: Sequence, start: str, frames: int) -> dict[str, Any]:
    """The row of a recorded sequence whose motion is played forth and back."""
    newest = simulator.network.config.history - 1 if start == "warm" else 0
    known = np.array(sequence.vertices[: newest + 1], np.float32)  # the only recorded frames that the rollout reads
    recorded = sequence.body()
    if len(known) <= newest or not np.isfinite(known).all():
        raise ValueError(f"{len(known)} recorded frames, or they are not finite; a {start} start needs {newest + 1}")
    body, times, forward = extended(recorded, newest + 1 + frames)
    vertices = predict(simulator, Known(sequence.garment, known), newest, frames, cold=start == "cold", body=body)
    mean = np.full((len(times), 3), np.nan)
    shown = forward & (times < len(sequence.vertices))
    share = vertex_areas(sequence.garment)
    mean[shown] = np.einsum("v,tvc->tc", share, np.asarray(sequence.vertices)[times[shown].astype(int)])
    curves = figures(sequence.garment, vertices, known[-1], body, newest + 1, mean[newest + 1 :])
    return _row(sequence.name, start, curves)


def _row(name: str, start: str, curves: dict[str, np.ndarray]) -> dict[str, Any]:
    verdict = judged(curves)
    finite = int(np.isfinite(curves["energy"]).sum())
    return {
        "row": name,
        "start": start,
        "finite_frames": finite,
        "verdict": verdict,
        "good": all(v["kept"] for v in verdict.values()),
        "largest_mean_to_anchor_m": float(np.max(curves["mean_to_anchor_m"])),
        "curves": {key: [round(float(v), 6) for v in values] for key, values in curves.items()},
    }


def _cells(row: dict[str, Any]) -> list[str]:
    values = [form.format(scale * row["verdict"][key]["value"]) for key, (_, scale, form) in HEADINGS.items()]
    broken = [HEADINGS[key][0].split(" [")[0] for key, v in row["verdict"].items() if not v["kept"]]
    verdict = "good" if row["good"] else "not kept: " + ", ".join(broken)
    return [escape(row["row"]), row["start"], *values, f"{100 * row['largest_mean_to_anchor_m']:.1f}", verdict]


def _draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """Every figure over time with its limit, one line per rollout."""
    panels = (
        ("mean_drift_m", "mean, drift on the body [cm]", 100.0, "mean_m"),
        ("mean_to_recording_m", "mean from the recording [cm]", 100.0, "mean_m"),
        ("energy", "energy relative to the body's", 1.0, None),
        ("stretch", "longest edge, stretch [%]", 100.0, "stretch"),
        ("penetration_m", "deepest vertex [mm]", 1000.0, "penetration_m"),
        ("inside", "vertices inside [%]", 100.0, "inside"),
    )
    figure, axes = axes_of(2, rows=3, height=2.6, width=5.6)
    palette = (draw.CORAL, draw.TEAL, draw.OCHRE, draw.PLUM, draw.SLATE)
    names = list(dict.fromkeys(row["row"] for row in rows))
    for axis, (key, text, scale, limit) in zip(axes, panels, strict=True):
        top = 0.0  # top of the energy's axis: a garment that settles on a body at rest would flatten all later values
        for row in rows:
            values = np.array(row["curves"][key], np.float64)
            if key == "energy":  # mean over a second, so that the line is legible
                values, below = (_running(np.array(row["curves"][k])) for k in ("energy", "body_energy"))
                values = (values + STILL) / (below + STILL)
                top = max(top, 1.2 * np.nanmax(values[settled(len(values))], initial=0.0))
            color = palette[names.index(row["row"]) % len(palette)]
            line = "-" if row["start"] == "warm" else "--"
            frames, dots = np.arange(1, len(values) + 1), "." if key == "mean_to_recording_m" else ""
            label = f"{row['row']}, {row['start']}"
            axis.plot(frames, scale * values, line, marker=dots, ms=2, color=color, lw=1, label=label)
        if limit is not None:
            axis.axhline(scale * getattr(Limits(), limit), color="#2f3640", lw=0.8, ls=":")
        axis.set(ylabel=text, ylim=(0, top or None), xlim=(0, len(rows[0]["curves"][key])))
        axis.grid(alpha=0.3)
    for axis in axes[-2:]:
        axis.set_xlabel("predicted frame")
    axes[0].legend(frameon=False, fontsize=7)
    save(figure, path)


def _running(values: np.ndarray, width: int = 30) -> np.ndarray:
    width = min(width, len(values))
    return np.convolve(values, np.full(width, 1.0 / width), mode="same")
