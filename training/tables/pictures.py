"""Pictures of tables: bars, sweeps, curves, and rollouts drawn beside the recording."""

from __future__ import annotations

import math
from collections.abc import Sequence as Ordered
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MissingExtra
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.motion import GarmentMotion
from warpgarment.view import draw

from .options import RESULTS
from .protocol import FIGURES, STARTS

INCHES = 0.24  # height of a bar [inches]
COLOURS = {"warm": draw.CORAL, "cold": draw.OCHRE}
PANELS = ("mean_vertex_error_cm", "geodesic_distortion_m")
SWEPT = {"power": "power p", "radius": "radius r [m]"}
MOMENTS = 6


class Keeper:
    """Keeps warm rollouts of some sequences for pictures; an argument `observe` of `protocol.measure`.

    Args:
        names: Names of the sequences.
    """

    def __init__(self, names: set[str]) -> None:
        self.names = names
        self.kept: dict[str, tuple[Any, int, np.ndarray]] = {}

    def __call__(self, sequence: Any, body: BodyMotion, start: str, newest: int, vertices: np.ndarray) -> None:
        """Keeps the sequence, its newest recorded frame and the prediction."""
        if start == "warm" and sequence.name in self.names:
            self.kept[sequence.name] = sequence, newest, vertices


def rollouts(
    path: Path,
    keeper: Keeper,
    titles: Ordered[tuple[str, str]],
    size: tuple[int, int] = (200, 290),
    samples: int = 2,
) -> bool:
    """Draws the kept rollouts: for each sequence a row of frames of the network and one of the recording.

    Args:
        path: PNG file to write.
        keeper: Keeper of the rollouts.
        titles: Text and sequence of each pair of rows; a sequence is drawn once, and sequences that were not kept are
            left out.
        size: Width and height of a picture in pixels.
        samples: Number of samples per pixel in each direction.

    Returns:
        Whether there was anything to draw.
    """
    strips, drawn = [], set()
    for text, name in titles:
        if name not in keeper.kept or name in drawn:
            continue
        drawn.add(name)
        sequence, newest, vertices = keeper.kept[name]
        frames = slice(newest + 1, newest + 1 + len(vertices))
        whole = sequence.full_body()
        body = BodyMotion(whole.vertices[frames], whole.faces, whole.fps)
        network = GarmentMotion(vertices, sequence.garment.faces, whole.fps)
        recorded = GarmentMotion(np.asarray(sequence.vertices[frames]), sequence.garment.faces, whole.fps)
        moments = np.linspace(0, len(vertices) - 1, MOMENTS).round().astype(int)
        camera = draw.chase([body, recorded], size=size)
        for title, worn, color in (
            (f"{text}: {name}, network", network, draw.CORAL),
            ("recorded", recorded, draw.SLATE),
        ):
            panels = draw.film(body, [worn], size=size, colors=[color], frames=moments, camera=camera, samples=samples)
            strip = [draw.caption(p, f"{t / whole.fps:.1f} s") for p, t in zip(panels, moments, strict=True)]
            strips.append(draw.titled(np.concatenate(strip, axis=1), title, size=13))
    if strips:
        draw.write_png(path, np.concatenate(strips, axis=0), colors=256)
    return bool(strips)


def results_file(config: Any, name: str) -> Path:
    """Path of a file beside those of the table."""
    return Path(config.out or RESULTS) / name


def bars(path: Path, rows: Ordered[dict[str, Any]]) -> None:
    """Draws error and geodesic distortion of every row and method, warm and cold."""
    entries = []
    for row in rows:
        for method in row["mean"].get("warm", {}):
            label = row["label"] if method == "network" else f"{row['label']}: {method}" if row["label"] else method
            entries.append((label, method, {start: row["mean"][start][method] for start in STARTS}))
    figure, axes = axes_of(2, height=1.0 + 2 * INCHES * len(entries), width=6.5, share_y=True)
    place = np.arange(len(entries))[::-1]
    for axis, key in zip(axes, PANELS, strict=True):
        for start, shift in (("warm", 0.2), ("cold", -0.2)):
            values = [shown(figures[start][key]) for _, _, figures in entries]
            drawn = axis.barh(place + shift, values, 0.38, color=COLOURS[start], label=f"{start} start")
            for bar, (_, method, _) in zip(drawn, entries, strict=True):
                bar.set_alpha(1.0 if method == "network" else 0.45)
            axis.bar_label(drawn, [FIGURES[key][1].format(v) for v in values], fontsize=7, padding=2)
        axis.set(title=FIGURES[key][0], xlim=(0, 1.2 * max(1e-9, axis.get_xlim()[1])))
        axis.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(place, [label for label, _, _ in entries])
    figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    save(figure, path)


def sweeps(path: Path, rows: Ordered[dict[str, Any]]) -> None:
    """Draws the error over power and over radius."""
    having = {key: [row for row in rows if key in row.get("value", {})] for key in SWEPT}
    swept = {key: swept_rows for key, swept_rows in having.items() if len(swept_rows) > 1} or having
    figure, axes = axes_of(len(swept), height=3.6, width=4.6)
    baselines: dict[str, Any] = next((row["mean"] for row in rows if row["row"] == "baselines"), {})
    for axis, (key, swept_rows) in zip(axes, swept.items(), strict=True):
        swept_rows.sort(key=partial(_swept_value, key))
        for start, line in (("warm", "-"), ("cold", "--")):
            values = [shown(row["mean"][start]["network"]["mean_vertex_error_cm"]) for row in swept_rows]
            axis.plot([row["value"][key] for row in swept_rows], values, f"o{line}", color=COLOURS[start], label=start)
            if start in baselines:
                level = shown(baselines[start]["skinned"]["mean_vertex_error_cm"])
                axis.axhline(level, ls=line, color=draw.SLATE, lw=1, label=f"skinned, {start}")
        axis.set(xscale="log", xlabel=SWEPT[key], ylabel="mean vertex error [cm]")
        axis.set_ylim(0, 1.05 * max(1e-9, axis.get_ylim()[1]))
        axis.grid(alpha=0.3)
    axes[0].legend(frameon=False, fontsize=8)
    save(figure, path)


def _swept_value(key: str, row: dict[str, Any]) -> float:
    return row["value"][key]


def axes_of(
    columns: int, *, height: float, width: float, rows: int = 1, share_y: bool = False
) -> tuple[Any, list[Any]]:
    """An empty figure and its axes; height and width of the figure are in inches."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("train", "The picture of a table (switched off by --no-picture)") from error
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns, sharey=share_y)))


def save(figure: Any, path: Path) -> None:
    """Writes a figure as PNG, for any suffix of the path."""
    figure.savefig(path, dpi=130, format="png")


def shown(value: float) -> float:
    """A number that can be drawn; one that is not finite becomes 0."""
    return value if math.isfinite(value) else 0.0
