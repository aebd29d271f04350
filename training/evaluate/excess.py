"""The second part of an evaluation: error over the teacher's own, and how the cloth looks beside the recording.

For every rollout of the network, the figures of `shape` are taken over the predicted frames: those of the network
against the recording, and where a twin of the sequence is stored (`twins`) those of the twin over the same frames, the
floor. The excess of a frame is its error minus the twin's distance in that frame; both are kept. Slow and fast parts of
the twin were divided over the whole recording, those of a rollout over its own frames: within half a second of its ends
the two are means over different frames.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.objects.body import BodyMotion
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.tables.protocol import STARTS
from warpgarment.training.tables.report import grid
from warpgarment.view.markdown import escape

from .shape import DIFFERENCE, LOOKS, QUARTERS, WAVELENGTH, WINDOW, Shape
from .twins.scene import TwinError
from .twins.stored import Twin, read_twin, shape_of

SHARES = ("bending", "acceleration")  # of the recording's
STRAINS = ("strain_1", "strain_99")
ERRORS = (*DIFFERENCE, "bias")
ABOUT = (
    "Mean distance from the recording [cm]: of all vertices, by quarter of a garment's height, of differences in waves "
    f"longer (low) and shorter (high) than {100 * WAVELENGTH:.0f} cm over the rest mesh, of their mean over "
    f"{WINDOW:g} s (slow) and the rest of them (fast), and of their mean over all frames (bias), the last three as the "
    "garment sees them."
)
BOTH = "Each is followed by the same figure of the teacher's twin, where one is stored; excess is the difference."
NONE = (
    "No sequence has a twin of the teacher here, so there is no floor. Make twins with "
    "`python -m warpgarment.training.evaluate.twins --data DATA`."
)
LOOK = (
    "Bending energy (mean squared change of dihedral angles) and acceleration as shares of the recording's; the 1st "
    "and the 99th percentile of edge strain [%]."
)


class Excess:
    """Measures rollouts as they are made; `observe` is a callback of `tables.protocol.measure`.

    Args:
        twins: Folder of the twins.

    Attributes:
        rows: Figures of each rollout.
        without: Sequence -> reason why it has no floor.
    """

    def __init__(self, twins: Path):
        self._twins = twins
        self.rows: list[dict[str, Any]] = []
        self.without: dict[str, str] = {}
        self._known: tuple[Path, Shape, Twin | None] | None = None

    def observe(self, sequence: Sequence, body: BodyMotion, start: str, newest: int, vertices: np.ndarray) -> None:
        """Measures one rollout of the network.

        Args:
            sequence: The sequence.
            body: Its body, which is not read.
            start: "warm" or "cold".
            newest: Newest recorded frame that was an input.
            vertices: Predicted positions [m], [T,V,3], of the frames after it.
        """
        if self._known is None or self._known[0] != sequence.folder:
            self._known = sequence.folder, shape_of(sequence), self._twin(sequence)
        _, shape, twin = self._known
        shown = slice(newest + 1, newest + 1 + len(vertices))
        row = {"sequence": sequence.name, "start": start, "frames": len(vertices)}
        row["finite"] = bool(np.isfinite(vertices).all())
        self.rows.append(
            row | (figures(shape, vertices, sequence.vertices[shown], twin, shown) if row["finite"] else {})
        )

    def result(self) -> dict[str, Any]:
        """All figures: rows, means over the rollouts that stayed finite, those over the ones with a floor, and which
        sequences have none."""
        means = {start: mean([row for row in self.rows if row["start"] == start]) for start in STARTS}
        floored = {start: [r for r in self.rows if r["start"] == start and r.get("floor")] for start in STARTS}
        means_with = {start: mean(rows) for start, rows in floored.items() if rows}
        settings = {"wavelength_m": WAVELENGTH, "window_s": WINDOW}
        return {
            "rows": self.rows,
            "mean": means,
            "mean_with_floor": means_with,
            "without_floor": self.without,
            "measures": settings,
        }

    def _twin(self, sequence: Sequence) -> Twin | None:
        try:
            return read_twin(self._twins / f"{sequence.name}.json", sequence)
        except (FileNotFoundError, TwinError) as error:
            self.without[sequence.name] = (
                str(error).removeprefix(f"{sequence.name} ").removeprefix(f"{sequence.name}: ")
            )
            return None


def figures(
    shape: Shape, vertices: np.ndarray, recorded: np.ndarray, twin: Twin | None, shown: slice
) -> dict[str, Any]:
    """The figures of one rollout.

    Args:
        shape: Measures of the sequence.
        vertices: Predicted positions [m], [T,V,3].
        recorded: Recorded positions of the same frames [m], [T,V,3].
        twin: Twin of the sequence.
        shown: These frames among all of the recording.

    Returns:
        `error`, `floor` (None without a twin) and `excess` (error - floor) by figure [cm]; `looks` of the network,
        the recording and the twin (`bending` and `acceleration` as shares of the recording's); `error_over_time`,
        `floor_over_time` [cm].
    """
    found = shape.differences(vertices, recorded)
    error = {name: _mean(values) for name, values in found.items()} | {"bias": shape.bias(vertices, recorded)}
    seen = shape.looks(recorded)
    looks = {"network": _looks(shape.looks(vertices), seen), "recording": _looks(seen, seen), "twin": None}
    row: dict[str, Any] = {"error": error, "floor": None, "excess": None, "looks": looks}
    row |= {"error_over_time": _rounded(found["distance"]), "floor_over_time": None}
    if twin is not None:
        part = {name: values[shown] for name, values in twin.figures.items()}
        whole = shown.stop == len(twin.figures["distance"])
        floor = {name: _mean(part[name]) for name in DIFFERENCE}
        floor["bias"] = twin.bias.get(shown.start, math.nan) if whole else math.nan
        row |= {"floor": floor, "excess": {name: error[name] - floor[name] for name in ERRORS}}
        row["floor_over_time"] = _rounded(part["distance"])
        part["acceleration"] = np.concatenate([[np.nan], part["acceleration"][1:-1], [np.nan]])  # as in a rollout
        looks["twin"] = _looks(part, seen)
    return row


def mean(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over the rollouts that stayed finite; `floor` and `excess` are None unless all of these have a floor."""
    good = [row for row in rows if row["finite"]]
    floored = [row for row in good if row["floor"] is not None]
    both = floored if len(floored) == len(good) else []  # a difference of means over different rollouts says nothing
    result: dict[str, Any] = {"sequences": len(rows), "failed": len(rows) - len(good), "with_floor": len(floored)}
    for key, names, of in (("error", ERRORS, good), ("floor", ERRORS, both), ("excess", ERRORS, both)):
        result[key] = {name: _mean([row[key][name] for row in of]) for name in names} if of else None
    result["looks"] = {
        who: {name: _mean([row["looks"][who][name] for row in of]) for name in LOOKS} if of else None
        for who, of in (("network", good), ("recording", good), ("twin", both))
    }
    return result


def lines(result: dict[str, Any]) -> list[str]:
    """This part of the evaluation as Markdown."""
    floored = any(found["with_floor"] for found in result["mean"].values())
    names = ["error", *QUARTERS, "low", "high", "slow", "fast", "bias"]
    headings = ["sequence", "start", *names[:1], *(["excess"] if floored else []), *names[1:]]
    text = ["## Error over the teacher's own", "", f"{ABOUT} {BOTH if floored else NONE}", ""]
    shown = [("**mean**", start, found) for start, found in result["mean"].items()]
    if floored and result["without_floor"]:
        shown += [("**mean with floor**", start, found) for start, found in result["mean_with_floor"].items()]
    shown += [(escape(row["sequence"]), row["start"], row) for row in result["rows"] if row["finite"]]
    rows = []
    for name, start, found in shown:
        if not found["error"]:
            continue
        pairs = [_pair(found, key) for key in ("distance", *names[1:])]
        more = [_number(found["excess"]["distance"] if found["excess"] else math.nan)] if floored else []
        rows.append([name, start, pairs[0], *more, *pairs[1:]])
    text += [*grid(headings, rows), ""]
    if floored and result["without_floor"]:
        text += [f"{len(result['without_floor'])} without a floor:", ""]
        text += [*(f"- {escape(f'{name}: {why}')}" for name, why in sorted(result["without_floor"].items())), ""]
    text += ["## How the cloth looks", "", LOOK, ""]
    rows = []
    for name, start, found in shown:
        for who, values in (found.get("looks") or {}).items():
            if values:
                shares = [f"{values[key]:.2f}" for key in SHARES]
                rows.append([name, start, who, shares[0], *(f"{100 * values[key]:.1f}" for key in STRAINS), shares[1]])
    return [*text, *grid(["sequence", "start", "of", "bending", "1st", "99th", "acceleration"], rows), ""]


def _looks(values: dict[str, np.ndarray], recorded: dict[str, np.ndarray]) -> dict[str, float]:
    found = {name: _mean(values[name]) for name in STRAINS}
    for name in SHARES:
        whole = _mean(recorded[name])
        found[name] = _mean(values[name]) / whole if whole > 0 else math.nan
    return {name: found[name] for name in LOOKS}


def _pair(found: dict[str, Any], name: str) -> str:
    error = _number(found["error"][name])
    return f"{error} / {_number(found['floor'][name])}" if found["floor"] else error


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"


def _mean(values: Any) -> float:
    finite = [v for v in np.ravel(values) if np.isfinite(v)]
    return float(np.mean(finite)) if finite else math.nan


def _rounded(values: np.ndarray) -> list[float]:
    return [round(float(v), 4) for v in values]
