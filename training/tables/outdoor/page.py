"""The table of materials and wind as Markdown, and its errors as bars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.training.tables.pictures import axes_of, save
from warpgarment.training.tables.report import grid
from warpgarment.view import draw
from warpgarment.view.markdown import escape

RIGHT = "right"  # the variant with which the others are compared
NOTE = (
    "Error: mean distance of vertices from the recording over all predicted frames, mean over sequences that stayed "
    "finite. More: how much larger the error is than with the right material and wind, sequence by sequence, ± the "
    "standard error of that mean; larger in: in how many sequences (for other materials, sequences and seeds) it is "
    "larger. Moved: mean distance of the two predictions from each other. Windy: only the sequences with wind. Other "
    "materials are permuted among all garments here, and none keeps its own. Warm: from ten recorded frames; cold: "
    "from the first alone."
)


def table(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The rows as a Markdown table."""
    headings = ["start", "variant", "error [cm]", "more [cm]", "larger in", "moved [cm]"]
    headings += [f"windy: {heading}" for heading in headings[2:]]
    lines = []
    for row in rows:
        cells = []
        for group in ("all", "windy"):
            figures = row.get(group)
            if figures is None or "error_cm" not in figures:
                cells += ["", "", "", ""] if figures is None else ["failed", "", "", ""]
                continue
            cells.append(f"{figures['error_cm']:.3f}")
            if row["variant"] == RIGHT:
                cells += [""] * 3
                continue
            cells += [f"{figures['more_cm']:+.3f} ± {figures['standard_error_cm']:.3f}"]
            cells += [f"{figures['larger']} of {figures['compared']}"]
            cells += [f"{figures['moved_cm']:.3f}" if "moved_cm" in figures else ""]
        lines.append([row["start"], escape(row["variant"]), *cells])
    return grid(headings, lines)


def draw_errors(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Bars of the error of every variant, over all sequences and over those in the wind."""
    figure, axes = axes_of(2, height=0.8 + 0.32 * len(rows), width=5.5, share_y=True)
    labels = [f"{row['variant']}, {row['start']}" for row in rows]
    place = np.arange(len(rows))[::-1]
    for axis, group in zip(axes, ("all", "windy"), strict=True):
        values = [row.get(group, {}).get("error_cm", 0.0) for row in rows]
        drawn = axis.barh(place, values, 0.7, color=[draw.CORAL if r["start"] == "warm" else draw.OCHRE for r in rows])
        axis.bar_label(drawn, [f"{v:.2f}" if v else "" for v in values], fontsize=7, padding=2)
        axis.set(title={"all": "all sequences", "windy": "those in the wind"}[group], xlabel="error [cm]")
        axis.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(place, labels)
    save(figure, path)
