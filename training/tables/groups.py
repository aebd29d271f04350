"""Figures 9 and 12 and the unseen category: one network on groups of test sequences, seen in training or not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import read_manifest
from warpgarment.training.data.set_manifest import read_set_manifest
from warpgarment.training.data.splits import evenly
from warpgarment.training.generate.recipes import TRAINING_CUTS
from warpgarment.training.train.training_set import folders_of
from warpgarment.view.markdown import escape

from .options import DataLacks, OptionMissing
from .pictures import Keeper, bars, results_file, rollouts
from .protocol import means, measure
from .report import PROTOCOL, means_table, publish

OTHERS = (
    "What was trained on and never seen is said of this set's training split; a network trained on other data may have "
    "seen more, or less."
)


@dataclass(frozen=True)
class Group:
    """Sequences of one row.

    Attributes:
        name: Name of the row.
        label: Label of the row in the table.
        seen: Whether training has seen the cuts, bodies or categories of the row.
        folders: Folders of the sequences.
    """

    name: str
    label: str
    seen: bool
    folders: list[Path]


Manifests = dict[Path, dict[str, Any]]


def make(config: Any) -> dict[str, Any]:
    """Measures the groups of a table and writes it.

    Raises:
        OptionMissing: There are no data.
        DataLacks: The data set does not have both sides of the comparison.
    """
    if config.data is None:
        raise OptionMissing(f"{config.table} needs --data FOLDER")
    title, find, note = TABLES[config.table]
    skipped: dict[str, str] = {}
    groups = find(Path(config.data), config, skipped)
    rows: list[dict[str, Any]] = []
    left_out, keeper = dict[str, str](), Keeper({group.folders[0].name for group in groups})
    for place in (config.network, *config.tables.against):
        path = checkpoint.find(place, device=config.device)
        simulator = Simulator(checkpoint.load(path), config.device)
        first = not rows
        folders = {folder: None for group in groups for folder in evenly(group.folders, config.max_sequences)}
        measured = measure(
            simulator,
            list(folders),
            frames=config.frames,
            geodesic_frames=config.geodesic_frames,
            baselines=config.baselines and first,
            observe=keeper if first and config.picture else None,
        )
        skipped |= measured.skipped
        for group in groups:
            names = {folder.name for folder in evenly(group.folders, config.max_sequences)}
            own = [row for row in measured.rows if row["sequence"] in names]
            if not own:
                left_out[group.label] = "; ".join(f"{n}: {r}" for n, r in measured.skipped.items() if n in names)
                continue
            label = group.label + (f", {_label(path)}" if config.tables.against else "")
            rows.append(
                {"row": group.name, "label": label, "seen": group.seen, "network": _label(path), "mean": means(own)}
                | {"count": len({row["sequence"] for row in own}), "sequences": own}
            )
    if {row["seen"] for row in rows} != {True, False}:
        reasons = "; ".join(f"{label}: {reason}" for label, reason in left_out.items())
        raise DataLacks(f"{config.data}: too few groups can be evaluated to compare any ({reasons})")
    result = {"table": config.table, "title": title, "protocol": PROTOCOL, "rows": rows, "skipped": skipped}
    result |= {"left_out": left_out}
    if config.tables.against:
        note += f" {OTHERS}"
    body = [note, "", PROTOCOL, "", *means_table(rows, {"count": "sequences"})]
    body += [
        line
        for label in left_out
        for line in ("", f"No row for {escape(label)}: none of its sequences can be evaluated.")
    ]
    if config.picture:
        drawn = results_file(config, f"{config.table}_rollouts.png")
        if rollouts(drawn, keeper, [(group.label, group.folders[0].name) for group in groups]):
            body += ["", f"![One sequence of each group]({drawn.name})"]
    publish(config, result, body, lambda path: bars(path, rows))
    return result


def cuts(root: Path, config: Any, skipped: dict[str, str]) -> list[Group]:
    """Figure 9: cuts trained on, with training motions and with unseen motions, and cuts never seen."""
    manifests = _manifests(root, None, skipped)
    cut = {folder: n for folder, m in manifests.items() if (n := _cut(m)) is not None}
    trained = {n for folder, n in cut.items() if manifests[folder].get("split") == "train"}

    def of_split(split: str, seen: bool) -> list[Path]:
        return [f for f, n in cut.items() if manifests[f].get("split") == split and (n in trained) == seen]

    groups = [
        Group("unseen_cuts", "unseen cuts, unseen motions", False, of_split("test", False)),
        Group("training_cuts", "cuts trained on, motions not trained on", True, of_split("validation", True)),
        Group("training_sequences", "cuts and motions trained on", True, of_split("train", True)),
    ]
    if not groups[0].folders or not any(group.folders for group in groups[1:]):
        raise DataLacks(
            f"{root}: no garments with seam cuts of which some are trained on and others are not (the recipe trains "
            f"on {TRAINING_CUTS}). `warpgarment generate --recipe seams --sequences 48 --out DIR` makes such a set"
        )
    return [group for group in groups if group.folders]


def bodies(root: Path, config: Any, skipped: dict[str, str]) -> list[Group]:
    """Figure 12: bodies of kinds that no training sequence has, and bodies of kinds that some have."""
    manifests = _manifests(root, config.split, skipped)
    trained = {_kind(m) for m in _manifests(root, "train", skipped).values()}
    kinds = {folder: _kind(m) for folder, m in manifests.items()}
    seen = [f for f, k in kinds.items() if k in trained]
    unseen = [f for f, k in kinds.items() if k not in trained]
    if not unseen or not seen:
        lack = "has a body of a kind not trained on" if seen else "has a body of a kind that is trained on"
        raise DataLacks(
            f"{root}: no {config.split} sequence {lack} (there are {', '.join(sorted(set(kinds.values()))) or 'none'})."
            " `warpgarment generate --out DIR` tests on a mannequin and a creature"
        )
    groups = [Group("seen", f"bodies as trained on ({', '.join(sorted(trained))})", True, seen)]
    worn = {str(manifests[f].get("category")) for f in unseen}
    same = [f for f in seen if str(manifests[f].get("category")) in worn]
    if same and len(same) < len(seen):
        names = ", ".join(sorted(worn))
        groups.append(Group("seen_same_categories", f"... in the categories below ({names})", True, same))
    for kind in sorted({kinds[f] for f in unseen}):
        groups.append(Group(kind, f"{kind}, never seen", False, [f for f in unseen if kinds[f] == kind]))
    return groups


def categories(root: Path, config: Any, skipped: dict[str, str]) -> list[Group]:
    """The unseen category: test sequences of held-out categories, and of the others one by one and together."""
    held_out = tuple(config.tables.held_out) or _held_out(root)
    manifests = _manifests(root, config.split, skipped)
    kinds = {folder: str(m.get("category")) for folder, m in manifests.items()}
    trained = [str(m.get("category")) for m in _manifests(root, "train", skipped).values()]
    make_it = "`warpgarment generate --held-out skirt --out DIR` makes a set that tests on skirts only"
    if not held_out:
        raise DataLacks(f"{root}: no set.json says which categories are held out; give --held-out NAME. {make_it}")
    for name in held_out:
        if name in trained:
            raise DataLacks(
                f"{root}: {name} is not held out, {trained.count(name)} training sequences have it. {make_it}"
            )
    unseen = [f for f, k in kinds.items() if k in held_out]
    seen = [f for f, k in kinds.items() if k not in held_out]
    if not unseen or not seen:
        lack = ", ".join(held_out) if not unseen else "another category"
        raise DataLacks(f"{root}: no {config.split} sequence with {lack}. {make_it}")
    groups = [Group("seen", "all categories trained on", True, seen)]
    for kind in sorted({kinds[f] for f in seen}):
        groups.append(Group(kind, kind, True, [f for f in seen if kinds[f] == kind]))
    for kind in sorted({kinds[f] for f in unseen}):
        groups.append(Group(kind, f"{kind}, never seen", False, [f for f in unseen if kinds[f] == kind]))
    return groups


def _manifests(root: Path, split: str | None, skipped: dict[str, str]) -> Manifests:
    return {folder: read_manifest(folder) for folder in folders_of(root, split, skipped)}


def _cut(manifest: dict[str, Any]) -> int | None:
    parameters = manifest.get("parameters")
    cut = parameters.get("cut") if isinstance(parameters, dict) else None
    return cut if isinstance(cut, int) else None


def _kind(manifest: dict[str, Any]) -> str:
    body = manifest.get("body")
    return str(body.get("kind", "unknown")) if isinstance(body, dict) else str(body)


def _held_out(root: Path) -> tuple[str, ...]:
    manifest = read_set_manifest(root) or {}
    return tuple(map(str, (manifest.get("configuration") or {}).get("held_out") or ()))


def _label(path: Path) -> str:
    """Name of the run's folder if the file has the name that all runs use, otherwise the name of the file."""
    return path.parent.name if path.stem in ("best", "network") else path.stem


TABLES: dict[str, tuple[str, Callable[[Path, Any, dict[str, str]], list[Group]], str]] = {
    "figure9": (
        "Figure 9: seam cuts never seen",
        cuts,
        "Trained on: by a network trained on this set. Motions not trained on are those of validation, which choose "
        "the best checkpoint of such a run.",
    ),
    "figure12": ("Figure 12: bodies never seen", bodies, "Bodies of a kind that no training sequence of the set has."),
    "category": ("A garment category never seen", categories, "Categories that no training sequence of the set has."),
}
