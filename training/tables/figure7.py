"""Figure 7: one garment at several resolutions on one body motion, and the distances between the resulting surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warpgarment.nn import checkpoint
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.motion import GarmentMotion
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.data.splits import evenly
from warpgarment.training.rollouts import predict
from warpgarment.training.train.training_set import folders_of
from warpgarment.view import draw

from .meshing import remesh, surface_distance
from .options import DataLacks, OptionMissing
from .pictures import axes_of, results_file, save
from .protocol import STARTS, Known
from .report import grid, publish

NOTE = (
    "Each garment is remeshed at rest and carried to the recorded frames that a rollout starts from; after these, each "
    "resolution runs on its own. Distances between surfaces are symmetric means over frames; at the start they are "
    "what remeshing alone changes. The garment as recorded is the reference."
)


@dataclass
class Surface:
    """A rolled-out surface: `vertices` of predicted frames [m], [T,V,3], `faces`, [F,3], and `start`, the newest known
    frame [m], [V,3]."""

    vertices: np.ndarray
    faces: np.ndarray
    start: np.ndarray


def make(config: Any) -> dict[str, Any]:
    """Rolls every resolution out, compares the results and writes the figure.

    Raises:
        OptionMissing, DataLacks: There are no data, or no sequence whose garment can be remeshed.
    """
    if config.data is None:
        raise OptionMissing("figure7 needs --data FOLDER")
    path = checkpoint.find(config.network, device=config.device)
    simulator = Simulator(checkpoint.load(path), config.device)
    rows: list[dict[str, Any]] = []
    skipped: dict[str, str] = {}
    folders = evenly(folders_of(Path(config.data), config.split, skipped), config.max_sequences)
    drawn = results_file(config, "figure7_rollouts.png")
    for folder in tqdm(folders, desc="figure 7", unit="sequence"):
        try:
            sequence = Sequence.load(folder)
            body = sequence.body()
            by_start = {start: resolutions(simulator, sequence, body, config, start) for start in STARTS}
        except (ValueError, OSError, KeyError, IndexError) as error:
            skipped[folder.name] = f"{type(error).__name__}: {error}"
            continue
        if config.picture and not rows:
            _draw_surfaces(drawn, sequence, body, by_start["warm"], simulator.network.config.history)
        for start, surfaces in by_start.items():
            newest = simulator.network.config.history - 1 if start == "warm" else 0
            rows += compared(sequence, start, newest, surfaces)
    if not rows:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(skipped.items())[:3])
        raise DataLacks(
            f"{config.data}: no {config.split} sequence with a garment that can be remeshed ({reasons or 'none'}). "
            "`warpgarment generate --out DIR` makes a set with some"
        )
    summary = summarised(rows)
    result: dict[str, Any] = {"table": "figure7", "title": "Figure 7: one garment at several resolutions"}
    result |= {"protocol": NOTE, "network": path.name, "rows": summary, "sequences": rows, "skipped": skipped}
    headings = ["resolution", "start", "faces", "from the reference [mm]", "at the start [mm]"]
    headings += ["from the recording [mm]", "failed"]
    lines = [
        [row["row"], row["start"], f"{row['faces']:.0f}", *(f"{1e3 * row[key]:.1f}" for key in _DISTANCES)]
        + [f"{row['failed']} of {row['sequences']}"]
        for row in summary
    ]
    body_text = [NOTE, "", *grid(headings, lines)]
    if config.picture:
        body_text += ["", f"![The first sequence, warm start]({drawn.name})"]
    publish(config, result, body_text, lambda target: _draw_curves(target, rows))
    return result


def resolutions(
    simulator: Simulator, sequence: Sequence, body: BodyMotion, config: Any, start: str
) -> dict[str, Surface]:
    """Rollouts of a sequence's garment as recorded and at other resolutions.

    Returns:
        Surfaces by the names "recorded mesh" and "N faces".

    Raises:
        NotRemeshable: The garment cannot be remeshed.
        ValueError: The recording is shorter than the history, or not finite.
    """
    newest = simulator.network.config.history - 1 if start == "warm" else 0
    steps = min(min(len(sequence.vertices), body.frames) - 1 - newest, config.frames or 2**31)
    known = np.array(sequence.vertices[: newest + 1], np.float32)  # the only recorded frames that a rollout reads
    if steps < 1 or not np.isfinite(known).all():
        raise ValueError(f"{len(sequence.vertices)} frames, too few, or the first are not finite")
    starts = {"recorded mesh": Known(sequence.garment, known)}
    for faces in config.tables.faces:
        new = remesh(sequence.garment, faces)
        starts[f"{faces:,} faces"] = Known(new.garment, new.carried(known))
    return {
        name: Surface(
            predict(simulator, one, newest, steps, cold=start == "cold", body=body), one.garment.faces, one.vertices[-1]
        )
        for name, one in starts.items()
    }


def compared(sequence: Sequence, start: str, newest: int, surfaces: dict[str, Surface]) -> list[dict[str, Any]]:
    """A row for every resolution: distances from the reference in each frame [m], and from the recording [m]."""
    reference = surfaces["recorded mesh"]
    rows = []
    for name, surface in surfaces.items():
        apart, off = [], []
        for t, vertices in enumerate(surface.vertices):
            same = surface is reference
            apart.append(0.0 if same else _between(vertices, surface, reference.vertices[t], reference))
            off.append(_between(vertices, surface, np.asarray(sequence.vertices[newest + 1 + t]), reference))
        rows.append(
            {"row": name, "sequence": sequence.name, "start": start, "faces": len(surface.faces)}
            | {
                "distance_m": float(np.mean(apart)),
                "from_recording_m": float(np.mean(off)),
                "distance_over_time_m": apart,
            }
            | {"start_distance_m": _between(surface.start, surface, reference.start, reference)}
        )
    return rows


_DISTANCES = ("distance_m", "start_distance_m", "from_recording_m")


def summarised(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over the sequences that stayed finite in all resolutions, so that all means are comparable."""
    keys = {(row["start"], row["sequence"]) for row in rows}
    bad = {(r["start"], r["sequence"]) for r in rows if not np.isfinite([r[key] for key in _DISTANCES]).all()}
    summary = []
    for start in STARTS:
        for name in dict.fromkeys(row["row"] for row in rows):
            of_row = [r for r in rows if (r["start"], r["row"]) == (start, name)]
            good = [r for r in of_row if (start, r["sequence"]) in keys - bad]
            mean = {k: float(np.mean([r[k] for r in good])) if good else float("nan") for k in ("faces", *_DISTANCES)}
            failed = sum(not np.isfinite(r["from_recording_m"]) for r in of_row)
            summary.append({"row": name, "start": start, **mean, "failed": failed, "sequences": len(of_row)})
    return summary


def _between(vertices: np.ndarray, surface: Surface, others: np.ndarray, other: Surface) -> float:
    return surface_distance(vertices, surface.faces, others, other.faces)


def _draw_curves(path: Path, rows: list[dict[str, Any]]) -> None:
    """Distance from the reference over time, as a mean over the sequences that are long enough."""
    figure, axes = axes_of(2, height=3.6, width=4.6, share_y=True)
    names = [name for name in dict.fromkeys(row["row"] for row in rows) if name != "recorded mesh"]
    for axis, start in zip(axes, STARTS, strict=True):
        for name, color in zip(names, (draw.CORAL, draw.TEAL, draw.OCHRE, draw.PLUM) * 9, strict=False):
            curves = [
                1e3 * np.array(r["distance_over_time_m"]) for r in rows if (r["row"], r["start"]) == (name, start)
            ]
            padded = np.full((len(curves), max(map(len, curves))), np.nan)
            for k, curve in enumerate(curves):
                padded[k, : len(curve)] = curve
            there = np.isfinite(padded)
            mean = np.where(there, padded, 0.0).sum(0) / np.where(there.any(0), there.sum(0), np.nan)
            axis.plot(np.arange(1, len(mean) + 1), mean, color=color, label=name)
        axis.set(title=f"{start} start", xlabel="predicted frame")
        axis.grid(alpha=0.3)
    axes[0].set(ylabel="distance from the recorded mesh's rollout [mm]")
    axes[0].set_ylim(bottom=0)
    axes[0].legend(frameon=False, fontsize=8)
    save(figure, path)


def _draw_surfaces(
    path: Path, sequence: Sequence, body: BodyMotion, surfaces: dict[str, Surface], history: int
) -> None:
    frames = len(surfaces["recorded mesh"].vertices)
    shown = BodyMotion(body.vertices[history : history + frames], body.faces, body.fps)
    rows: list[draw.Row] = []
    for (name, surface), color in zip(surfaces.items(), (draw.SLATE, *draw.PALETTE * 9), strict=False):
        title = f"{sequence.name}, {name}" + (f" ({len(surface.faces):,})" if name == "recorded mesh" else "")
        rows.append((title, [GarmentMotion(surface.vertices, surface.faces, body.fps)], [color]))
    draw.sheet(path, shown, rows, frames=6, size=(200, 290))
