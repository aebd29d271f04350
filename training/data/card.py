"""A page about a data set: `warpgarment dataset card DIR` writes DIR/card.md and its pictures, DIR/card/*.png.

All contents are read from the set itself: its kind and the command that made it, counts by split and category, motions,
body shapes, quality figures, rejections, materials and wind if there are any, pictures, licences and credits.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.io.disk.atomic import atomic_file, atomic_folder, check_replaceable
from warpgarment.io.disk.outputs import check_writable

from .card_facts import Facts, Values
from .card_page import page
from .card_pictures import bars, contact_sheet, histograms
from .layout import SPLITS
from .sequence import read_array

PICTURES = 12
_FIGURES = {  # figure of the quality gate -> heading, factor
    "penetration": ("deepest vertex [mm]", 1e3),
    "inside": ("vertices inside the body [%]", 1e2),
    "stretch_mean": ("mean stretch [%]", 1e2),
    "stretch_p99": ("99th percentile of stretch [%]", 1e2),
    "stretch_max": ("largest stretch [%]", 1e2),
    "step_max": ("largest step [mm/frame]", 1e3),
}
_MATERIALS = {
    "density": ("density [kg/m²]", 1.0),
    "stretch": ("stretch stiffness [N/m]", 1.0),
    "shear": ("shear stiffness [N/m]", 1.0),
    "bend": ("bending stiffness [mN m]", 1e3),
    "damping": ("damping [µs]", 1e6),
    "friction": ("friction", 1.0),
}


class EmptyDataset(ValueError):
    """A data set without any good sequence."""


def write_card(
    root: str | Path, out: str | Path | None = None, *, pictures: int = PICTURES, size: tuple[int, int] = (240, 320)
) -> Path:
    """Writes the page and its pictures.

    Args:
        root: Folder of the data set.
        out: Folder for `card.md` and `card/`; None for the folder of the data set.
        pictures: Number of sequences on the contact sheet.
        size: Width and height of each picture in pixels.

    Returns:
        Path of the page.

    Raises:
        FileNotFoundError: There is no such folder.
        EmptyDataset: The folder holds no good sequence.
        OutputError, FileExistsError: The page cannot be written to `out`, or a folder `card` holds something else.
        MissingExtra: The extra for pictures is not installed (`pip install "warpgarment[view]"`).
    """
    root = Path(root)
    out = root if out is None else Path(out)
    check_writable(out / "card.md")
    check_writable(out / "card", folder=True)
    check_replaceable(out / "card", "*.png")
    facts = Facts.of(root)
    if not facts.good:
        raise EmptyDataset(f"{root} holds no good sequence. Make some with `warpgarment generate --out {root}`.")
    with atomic_folder(out / "card", "*.png") as folder:
        contact_sheet(folder / "sequences.png", chosen(facts.good, pictures), size=size)
        drawn = {"bodies": bodies(facts), "figures": figures(facts), "materials": materials(facts), "wind": wind(facts)}
        for name, values in drawn.items():
            if values:
                histograms(folder / f"{name}.png", values)
        reasons = Counter(kind_of_reason(str(m.get("reason"))) for m in facts.rejected)
        if reasons:
            bars(folder / "rejections.png", dict(reasons.most_common()), "attempts rejected, by reason")
    with atomic_file(out / "card.md") as temporary:
        temporary.write_text(page(facts, drawn, reasons), "utf-8")
    return out / "card.md"


def chosen(good: Mapping[Path, Mapping[str, Any]], count: int) -> list[Path]:
    """Folders of sequences for the contact sheet: categories in turn, evenly spread within each."""
    of: dict[str, list[Path]] = defaultdict(list)
    for folder, manifest in good.items():
        of[str(manifest.get("category"))].append(folder)
    quota = dict.fromkeys(of, 0)
    wanted = min(count, len(good))
    for category in itertools.cycle(of):
        if sum(quota.values()) == wanted:
            break
        quota[category] += quota[category] < len(of[category])
    spread = {c: [group[(i * len(group)) // quota[c]] for i in range(quota[c])] for c, group in of.items()}
    turns = itertools.zip_longest(*spread.values())
    return [folder for turn in turns for folder in turn if folder is not None]


def bodies(facts: Facts) -> Values:
    """Shape parameters by split."""
    shapes = [(m, m["body"]) for m in facts.good.values() if isinstance(m.get("body"), dict)]
    return _by_split((m, key, value) for m, shape in shapes for key, value in shape.items())


def figures(facts: Facts) -> Values:
    """Quality figures by split; figures of layers are shares (0 to 1)."""
    rows: list[tuple[Mapping[str, Any], str, Any]] = []
    for manifest in facts.good.values():
        values = manifest.get("figures", {})
        rows += [(manifest, heading, values[key] * by) for key, (heading, by) in _FIGURES.items() if key in values]
        rows += [(manifest, key.replace("_", " "), value) for key, value in values.items() if key.startswith("layer")]
    return _by_split(rows)


def materials(facts: Facts) -> Values:
    """Cloth parameters of every garment by split; empty if all garments have the same."""
    rows: list[tuple[Mapping[str, Any], str, Any]] = []
    for manifest in facts.good.values():
        for garment in manifest.get("garments") or []:
            for key, value in (garment.get("material") or {}).items():
                heading, by = _MATERIALS.get(key, (key, 1.0))
                rows += [(manifest, heading, value * by)] if _is_number(value) else []
    values = _by_split(rows)
    return values if any(len({x for v in splits.values() for x in v}) > 1 for splits in values.values()) else {}


def wind(facts: Facts) -> Values:
    """Mean and largest speed of the air [m/s] by split, of the sequences with wind."""
    rows: list[tuple[Mapping[str, Any], str, Any]] = []
    for folder, manifest in facts.good.items():
        if (folder / "wind.npy").exists():
            speed = np.linalg.norm(read_array(folder, "wind").reshape(-1, 3), axis=1)
            rows += [(manifest, "mean wind [m/s]", float(speed.mean())), (manifest, "gusts [m/s]", float(speed.max()))]
    return _by_split(rows)


def _by_split(rows: Iterable[tuple[Mapping[str, Any], str, Any]]) -> Values:
    values: Values = {}
    for manifest, key, value in rows:
        if _is_number(value):
            splits = values.setdefault(key, {})
            splits.setdefault(str(manifest.get("split")), []).append(float(value))
    return {key: {s: splits[s] for s in SPLITS if s in splits} for key, splits in values.items()}


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def kind_of_reason(reason: str) -> str:
    """The subject of a reason without its numbers: "frame 54: penetration 11.5 mm is over 10 mm" -> "penetration"."""
    text = re.sub(r"^frame \d+: ", "", reason)
    if gate := re.match(r"(\w+) [-\d.]+ ?(?:%|mm) is over", text):
        return gate[1]
    return re.sub(r"\d[\d.,]*", "N", re.split(r"[.:;(]\s", text)[0])[:60].strip()
