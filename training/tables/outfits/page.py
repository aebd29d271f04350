"""Tables 4 and 5 as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from warpgarment.training.tables.report import grid
from warpgarment.view.markdown import escape

from .figures import TIGHT, WINDY
from .means import Rollout, beside, means
from .published import CATEGORIES, CELLS, NOT_COMPARABLE, TABLE4, TABLE5, TABLE5_COLUMNS

Results = dict[str, list[Rollout]]  # row -> its rollouts
STARTS = {
    "window": "35-frame windows, frames 61 to 95 from the recorded frames before them",
    "whole": "Whole sequences, cold from frame 0",
}
DEFINITIONS = (
    "Error: mean distance of vertices for each garment, then the mean over garments ± standard deviation, at life "
    "size. H: share of all vertices behind the plane of the nearest vertex of the body (published), or inside its "
    "surface. L: share of the outermost garment's vertices behind the plane of the nearest vertex of all inner ones "
    "(published), or share of the vertices of all garments but the innermost that are beneath the surface of one "
    "further in, within 3 cm. Pairs: crossing triangles of two garments, or of one with itself, in a frame; free: "
    "frames in which no two garments cross. Collisions are "
    "means over frames, then over sequences, and come from code of their own in float64, not from the contact stage. "
    "Means are over the sequences that stayed finite; failed: those that did not. A frame's time includes set-up. The "
    "body is the part with which cloth collides, without hands and forearms."
)
COLLISIONS = {
    "h_published": ("H [%]", "{:.2%}"), "h_surface": ("H surface [%]", "{:.2%}"), "l_published": ("L [%]", "{:.2%}"),
    "l_surface": ("L surface [%]", "{:.2%}"), "crossings_layers": ("pairs between", "{:.1f}"),
    "crossings_itself": ("pairs itself", "{:.1f}"), "free": ("free [%]", "{:.0%}"),
}  # fmt: skip


def table4(results: Results) -> list[str]:
    """Table 4 by tight or loose inner garments and wind."""
    lines = [
        f"Inner garments, all but the outermost, are tight up to a mean distance of {100 * TIGHT:g} cm from the body "
        f"in frame 0. There is wind where the air moves at {WINDY:g} m/s and more on average.",
        "", DEFINITIONS,
    ]  # fmt: skip
    for start, title in STARTS.items():
        here = _with(results, "start", start)
        if not any(here.values()):
            continue
        lines += ["", f"## {title}", "", "Error of all garments [mm].", ""]
        headings = ["", *(f"{cell} ({len(_in(here, cell)['recording'])})" for cell in CELLS), "all", "of skinned"]
        rows = []
        for name, rollouts in here.items():
            cells = [_error(means(_in(here, cell)[name])) for cell in CELLS]
            rows.append([escape(name), *cells, _error(means(rollouts)), _share(beside(rollouts, here["skinned"]))])
        lines += grid(headings, rows)
        for cell, what in CELLS.items():
            these = _in(here, cell)
            if these["recording"]:
                lines += ["", f"### {cell}: {what}", "", _numbers(these["recording"]), ""]
                lines += _collisions(these, split_errors=True)
        empty = [f"{cell} ({what})" for cell, what in CELLS.items() if not _in(here, cell)["recording"]]
        if empty:
            lines += ["", f"No sequence: {'; '.join(empty)}."]
    lines += ["", "## The paper", "", "Error [mm], divided by ten as its data are ten times life size.", ""]
    lines += grid(["", *CELLS], [[name, *(_published(x) for x in values)] for name, values in TABLE4.items()])
    return [*lines, "", NOT_COMPARABLE]


def table5(results: Results) -> list[str]:
    """Table 5 by category."""
    lines = [DEFINITIONS]
    for start, title in STARTS.items():
        here = _with(results, "start", start)
        if not any(here.values()):
            continue
        recorded = here["recording"]
        known = [c for c in CATEGORIES if any(c in r["garments"] for r in recorded)]
        known += sorted({c for r in recorded for c in r["garments"]} - set(known))
        rows = []
        for name, rollouts in here.items():
            cells = [_error(means(rollouts, _is(category))) for category in known]
            rows.append([escape(name), *cells, _error(means(rollouts)), _share(beside(rollouts, here["skinned"]))])
        counts = [sum(r["garments"].count(c) for r in recorded) for c in known]
        headings = [f"{escape(CATEGORIES.get(c, c))} ({n})" for c, n in zip(known, counts, strict=True)]
        lines += ["", f"## {title}", "", f"{_numbers(recorded)} Error [mm]; in brackets the number of garments.", ""]
        lines += [*grid(["", *headings, "overall", "of skinned"], rows), "", *_collisions(here)]
        lacking = [CATEGORIES[c] for c in CATEGORIES if c not in known and c != "top"]
        if lacking:
            lines += ["", f"No garment of these categories of the paper: {', '.join(lacking)}."]
    lines += ["", "## The paper", "", "Error [mm], divided by ten; collisions in per cent as published.", ""]
    rows = [
        [name, *(_published(x) for x in values[:-2]), *(f"{a:.2f}±{b:.2f}" for a, b in values[-2:])]
        for name, values in TABLE5.items()
    ]
    return [*lines, *grid(["", *TABLE5_COLUMNS], rows), "", NOT_COMPARABLE]


def _collisions(results: Results, *, split_errors: bool = False) -> list[str]:
    """Collisions of each row, and with `split_errors` the errors of inner and outermost garments before them."""
    headings = ["", *(["inner [mm]", "outermost [mm]"] if split_errors else [])]
    headings += [*(heading for heading, _ in COLLISIONS.values()), "failed", "frame [ms]"]
    rows = []
    for name, rollouts in results.items():
        mean = means(rollouts)
        cells = []
        if split_errors:
            cells.append(_error(means(rollouts, lambda k, of: k < len(of) - 1)))
            cells.append(_error(means(rollouts, lambda k, of: k == len(of) - 1)))
        cells += ["" if math.isnan(mean[key]) else form.format(mean[key]) for key, (_, form) in COLLISIONS.items()]
        time = "" if name == "recording" or mean["ms"] is None else f"{mean['ms']:.0f}"
        rows.append([escape(name), *cells, f"{mean['failed']} of {mean['sequences']}", time])
    return grid(headings, rows)


def _with(results: Results, key: str, value: str) -> Results:
    """The rollouts with a value, row by row."""
    return {name: [r for r in rollouts if r[key] == value] for name, rollouts in results.items()}


def _in(results: Results, cell: str) -> Results:
    return _with(results, "cell", cell)


def _is(category: str) -> Callable[[int, list[str]], bool]:
    """Whether a garment is of a category."""
    return lambda k, categories: categories[k] == category


def _numbers(recorded: list[Rollout]) -> str:
    """How many sequences and frames there are, and how many start free of crossings."""
    count, frames = len(recorded), sum(r["frames"] for r in recorded)
    splits = sorted({str(r["split"]) for r in recorded})
    shares = ", ".join(f"{sum(str(r['split']) == s for r in recorded)} {s}" for s in splits)
    free = sum(r["crossings_at_start"][0] == 0 for r in recorded)
    many = "1 sequence" if count == 1 else f"{count} sequences"
    return f"{many} ({shares}), {frames:,} predicted frames; {free} start without crossing garments."


def _error(mean: dict[str, Any]) -> str:
    if not mean["garments"]:
        return "failed" if mean["failed"] else ""
    spread = f"±{mean['spread_mm']:.1f}" if mean["garments"] > 1 else ""
    return f"{mean['error_mm']:.1f}{spread}"


def _share(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f}"


def _published(value: tuple[float, float]) -> str:
    return f"{value[0] / 10:.1f}±{value[1] / 10:.1f}"
