"""The pictures of a data set's card: a contact sheet of sequences, histograms, bars."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MissingExtra
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.progress import counted
from warpgarment.view import draw

from .sequence import Sequence as SequenceOnDisk

COLOURS = {"train": draw.TEAL, "validation": draw.OCHRE, "test": draw.CORAL}  # of splits


def contact_sheet(
    path: Path, folders: Sequence[Path], *, columns: int = 6, size: tuple[int, int] = (240, 320), samples: int = 2
) -> None:
    """Draws each sequence at the middle of its motion.

    Args:
        path: PNG file to write.
        folders: Folders of the sequences, at least one.
        columns: Number of pictures in a row.
        size: Width and height of a picture in pixels.
        samples: Number of samples per pixel in each direction.
    """
    shown = counted(folders, "drawing", unit="sequence")
    panels = [_panel(SequenceOnDisk.load(folder), k, size, samples) for k, folder in enumerate(shown)]
    columns = min(columns, len(panels))
    blank = np.full_like(panels[0], 255)
    panels += [blank] * (-len(panels) % columns)
    rows = [np.concatenate(panels[i : i + columns], axis=1) for i in range(0, len(panels), columns)]
    draw.write_png(path, np.concatenate(rows, axis=0), colors=256)


def _panel(sequence: SequenceOnDisk, number: int, size: tuple[int, int], samples: int) -> np.ndarray:
    """The picture of one sequence; colours depend on its number, so that neighbours differ."""
    frame = len(sequence) // 2
    body, worn = sequence.body_in(slice(frame, frame + 1)), sequence.vertices[frame]
    surfaces = [draw.Surface(body.vertices[0], body.faces)]
    colors = itertools.islice(itertools.cycle(draw.PALETTE), number % len(draw.PALETTE), None)
    for layer, color in zip(sequence.layers, colors, strict=False):
        faces = sequence.garment.faces[layer.faces] - layer.vertices.start
        surfaces.append(draw.Surface(worn[layer.vertices], faces, color, lining=True))
    floor = float(body.vertices[0][:, 1].min())
    picture = draw.render(surfaces, size=size, floor=floor, samples=samples)
    text = f"{sequence.name}, {sequence.manifest.get('motion', '')}"
    return draw.titled(picture, text[: size[0] // 6], size=11)


def histograms(
    path: Path, values: Mapping[str, Mapping[str, Sequence[float]]], *, columns: int = 3, bins: int = 16
) -> None:
    """Draws one histogram per quantity, stacked by split.

    Args:
        path: PNG file to write.
        values: Quantity -> split -> values.
        columns: Number of histograms in a row.
        bins: Number of bins of each histogram.
    """
    figure, axes = _axes(len(values), columns)
    for axis, (title, splits) in zip(axes, values.items(), strict=True):
        everything = np.concatenate([np.asarray(v, float) for v in splits.values()])
        edges = np.histogram_bin_edges(everything, bins)
        axis.hist(list(splits.values()), edges, stacked=True, label=list(splits), color=[COLOURS[s] for s in splits])
        axis.set_title(title[:60], fontsize=9, parse_math=False)
    axes[0].legend(frameon=False, fontsize=8)
    wide, high = figure.get_size_inches()
    edges_of = {"left": 0.35 / wide, "right": 1 - 0.1 / wide, "bottom": 0.25 / high, "top": 1 - 0.3 / high}
    figure.subplots_adjust(**edges_of, wspace=0.2, hspace=0.4)
    _save(path, figure)


def bars(path: Path, counts: Mapping[str, int], title: str) -> None:
    """Draws one horizontal bar per entry, the first on top."""
    figure, (axis,) = _axes(1, 1, height=0.8 + 0.24 * len(counts), width=7.0)
    names = list(counts)[::-1]
    axis.barh(range(len(names)), [counts[name] for name in names], color=draw.SLATE)
    axis.set_yticks(range(len(names)), names, parse_math=False)
    axis.set_title(title, fontsize=9)
    axis.locator_params(axis="x", integer=True)
    figure.set_layout_engine("constrained")
    _save(path, figure)


def _axes(count: int, columns: int, *, width: float = 2.8, height: float = 2.1) -> tuple[Any, list[Any]]:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("view", "Drawing histograms") from error
    columns = min(columns, count)
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(width * columns, height * rows))
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(count)]
    for axis in axes:
        axis.tick_params(labelsize=7)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _save(path: Path, figure: Any) -> None:
    with atomic_file(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")
