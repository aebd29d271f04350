"""The text of a network's page, Markdown."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.nn.network import GarmentNetwork
from warpgarment.training.data.card_page import counts, credits, table
from warpgarment.training.tables.protocol import FIGURES, METHODS, STARTS
from warpgarment.view.markdown import code, escape

if TYPE_CHECKING:
    from warpgarment.training.data.card_facts import Facts

    from .model_card_cases import Drawn

_ERROR = "mean_vertex_error_cm"
_SCALE = {"max_penetration_m": 1000.0}
_STARTS = {"warm": "from the recorded frames a network remembers", "cold": "from one recorded frame"}


def page(
    name: str,
    network: GarmentNetwork,
    notes: Mapping[str, Any],
    evaluation: Mapping[str, Any],
    facts: Facts,
    drawn: Sequence[Drawn],
    log: Sequence[Mapping[str, Any]],
    rule: str,
) -> str:
    """The text of the page.

    Args:
        name: Name of the checkpoint.
        network: Network that the page describes.
        notes: Notes of its checkpoint.
        evaluation: Result of `evaluate`.
        facts: Manifests of the data of the evaluation.
        drawn: Sequences that are shown.
        log: Lines of the training log; empty if there is no picture of it.
        rule: Rule by which the sequences were chosen.
    """
    return (
        "\n".join(
            [
                f"# {escape(name.removesuffix('.safetensors'))}",
                "",
                f"{network.parameter_count():,} parameters.",
                "",
                *table(["setting", "value"], network.config.as_dict().items()),
                "## Data",
                "",
                *_data(notes, facts),
                "## Training",
                "",
                *_training(notes, log),
                "## Figures",
                "",
                *figures(evaluation),
                "## Where it fails",
                "",
                *_cases(evaluation["sequences"], drawn, rule),
                "## Licences and credits",
                "",
                *credits(facts),
            ]
        )
        + "\n"
    )


def ratio(row: Mapping[str, Any]) -> float:
    """Ratio of the network's error to that of the skinned garment; infinite if the network's rollout failed."""
    error, reference = (row[method].get("mean_vertex_error_cm") for method in ("network", "skinned"))
    return error / reference if error is not None and reference and row["network"]["finite"] else math.inf


def _data(notes: Mapping[str, Any], facts: Facts) -> list[str]:
    known = notes.get("data")
    trained = (
        f"Trained on: {escape(_plainly(known))}." if known else "The checkpoint does not say what it was trained on."
    )
    good = list(facts.good.values())
    lines = [f"{trained} Evaluated on {code(facts.root.resolve().name)}:", "", *counts(good)]
    if facts.common.get("command"):
        lines += ["To make that set again:", "", "    " + " ".join(str(facts.common["command"]).split()), ""]
    return lines


def _training(notes: Mapping[str, Any], log: Sequence[Mapping[str, Any]]) -> list[str]:
    settings = notes.get("training")
    rows = [[escape(k), escape(_plainly(value))] for k, value in notes.items() if k not in ("training", "data")]
    lines = table(["budget", "value"], rows) if rows else ["The checkpoint has no notes.", ""]
    if isinstance(settings, Mapping):
        lines += [
            "Settings: " + ", ".join(escape(f"{key} {_plainly(value)}") for key, value in _flat(settings)) + ".",
            "",
        ]
    if log:
        lines += ["![Training loss and validation error](card/training.png)", ""]
        best = [line for line in log if isinstance(line.get("rollout_error_cm"), (int, float))]
        if best:
            least = min(best, key=lambda line: line["rollout_error_cm"])
            lines += [f"Least validation error: {least['rollout_error_cm']:.2f} cm, at step {least['step']:,}.", ""]
    return lines


def figures(evaluation: Mapping[str, Any]) -> list[str]:
    """The tables of an evaluation, of which names and reasons are shown as text."""
    settings, mean, rows = evaluation.get("settings", {}), evaluation["mean"], evaluation["sequences"]
    starts = [start for start in STARTS if start in mean]
    lines = [
        f"`warpgarment evaluate` on the {escape(settings.get('split', 'test'))} split, "
        f"{evaluation.get('frames_predicted', 0):,} predicted frames. "
        + "; ".join(f"{start}: {_STARTS[start]}" for start in starts)
        + ". Means over the sequences whose rollout stayed finite; deepest: of all frames.",
        "",
    ]
    headings = ["start", "method", *(heading for heading, _ in FIGURES.values()), "sequences", "failed"]
    body = [
        [
            start,
            escape(method),
            *map(_cell, [figures] * len(FIGURES), FIGURES),
            figures.get("sequences", ""),
            figures.get("failed", ""),
        ]
        for start in starts
        for method, figures in mean[start].items()
    ]
    lines += [*table(headings, body), "Mean vertex error [cm] by category:", ""]
    methods = [method for method in METHODS if any(method in row for row in rows)]
    body = []
    for category in sorted({str(row.get("category") or "-") for row in rows}):
        for start in starts:
            here = [r for r in rows if r["start"] == start and str(r.get("category") or "-") == category]
            means = [_mean(row[method].get(_ERROR) for row in here if method in row) for method in methods]
            body += [[escape(category), start, len(here), *means]] if here else []
    lines += table(["category", "start", "sequences", *methods], body)
    skipped = evaluation.get("skipped") or {}
    told = "; ".join(escape(f"{name} ({reason})") for name, reason in skipped.items())
    return lines + ([f"Not evaluated: {told}.", ""] if skipped else [])


def _cases(rows: Sequence[Mapping[str, Any]], drawn: Sequence[Drawn], rule: str) -> list[str]:
    ratios = [ratio(row) for row in rows if row["start"] == "cold"]
    better = sum(value < 1.0 for value in ratios)
    failed = sum(math.isinf(value) for value in ratios)
    lines = [
        f"From a cold start the network is better than skinning on {better} of {len(ratios)} sequences; on {failed} "
        f"its rollout failed. {rule}",
        "",
    ]
    for shown in drawn:
        row, case = shown.case.row, shown.case
        error = "failed" if math.isnan(shown.error) else f"{shown.error:.2f} cm"
        skin = row["skinned"][_ERROR]
        at = ", ".join(f"{t} ({shown.errors[t - 1]:.1f} cm)" if t else "0 (given)" for t in shown.moments)
        lines += [
            f"**{case.role.capitalize()}**: {escape(row['sequence'])}, "
            f"{escape(row.get('category') or 'no category')}, "
            f"{escape(row.get('motion') or 'motion not named')}. Network {error}, skinned {skin:.2f} cm, ratio "
            f"{case.ratio:.2f}. Frames {at}.",
            "",
        ]
        if shown.differs:
            before = row["network"].get(_ERROR)
            outcome = "failed" if before is None else f"gave {before:.2f} cm"
            lines += [f"Rolled out again for the picture; when it was evaluated it {outcome}.", ""]
        lines += [f"![{case.role}: {escape(row['sequence'])}](card/{case.file})", ""]
    return lines


def _cell(figures: Mapping[str, Any], key: str) -> str:
    value = figures.get(key)
    return "-" if value is None else FIGURES[key][1].format(value * _SCALE.get(key, 1.0))


def _mean(values: Iterable[float | None]) -> str:
    """Mean of the finite values as text, with the number of those that are not finite."""
    everything = list(values)
    good = [value for value in everything if value is not None and math.isfinite(value)]
    failed = len(everything) - len(good)
    shown = f"{np.mean(good):.2f}" if good else "-"
    return f"{shown} ({failed} failed)" if failed else shown


def _flat(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Settings with their values; a setting in a group has the name group.name."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield before + key, value


def _plainly(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return value if isinstance(value, str) else json.dumps(value, default=str)
