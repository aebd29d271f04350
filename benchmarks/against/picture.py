"""Draws the times of a frame over the number of faces, of both builds, on one core and on two."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpgarment.io.disk.atomic import atomic_files

BUILDS = (("before", "tab:gray"), ("now", "tab:blue"))
STYLES = {1: "-", 2: "--"}  # threads


def draw(rows: Sequence[dict[str, Any]], path: Path, commit: str) -> None:
    """Writes a PNG with a line for each build and number of threads, from the rows that time one garment.

    Args:
        rows: Rows of the comparison, those with "faces" are drawn.
        path: File to write.
        commit: What the earlier build is called.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6.4, 4.2))
    for name, colour in BUILDS:
        for threads, style in STYLES.items():
            mine = sorted((row["faces"], row[f"{name}_least"]) for row in rows if row.get("threads") == threads)
            if not mine:
                continue
            label = f"{commit if name == 'before' else 'today'}, {threads} core{'s' if threads > 1 else ''}"
            axes.plot(*zip(*mine, strict=True), style, marker="o", color=colour, label=label)
    axes.set(xscale="log", yscale="log", xlabel="faces asked of the remesher", ylabel="least time of a frame [ms]")
    axes.grid(which="both", alpha=0.3)
    axes.legend()
    figure.tight_layout()
    with atomic_files(path) as (written,):
        figure.savefig(written, dpi=120, format="png")
    pyplot.close(figure)
