"""The benefit of materials and wind: rollouts of outfits with the right ones, with others, and without.

    warpgarment evaluate --table outdoor --data LAYERS --network out/fast_outdoor/best.safetensors

Every sequence is rolled out by the protocol (`protocol.py`), garment by garment, in these variants:

    right              the material of each garment, and the wind of the sequence
    other materials    the materials are permuted among all garments of all sequences, so that none keeps its own; for
                       each of some seeds
    no material        no garment has a material, which is the mean material of the training data
    no wind            the air is still
    neither            no material, and still air

Only the inputs of the network differ. Differences of errors are paired: sequence by sequence, from the same start.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence as Ordered
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from warpgarment.nn import checkpoint
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.data.splits import evenly
from warpgarment.training.rollouts import check_rate, predict, skinned
from warpgarment.training.tables.options import DataLacks, OptionMissing
from warpgarment.training.tables.protocol import STARTS
from warpgarment.training.tables.report import publish
from warpgarment.training.train.training_set import folders_of, reason_of

from .page import NOTE, RIGHT, draw_errors, table

SKINNED = "skinned"


@dataclass(frozen=True)
class Worn:
    """A sequence with other materials and another wind, as `rollouts.predict` reads it."""

    whole: Sequence
    materials: Ordered[Material | None]
    wind: np.ndarray | None

    @property
    def garment(self) -> Garment:
        """All garments as one."""
        return self.whole.garment

    @property
    def vertices(self) -> np.ndarray:
        """Recorded positions [m], [T,V,3]."""
        return self.whole.vertices

    @property
    def layers(self) -> Ordered[Any]:
        """The garments' ranges."""
        return self.whole.layers

    @property
    def worn(self) -> Ordered[Garment]:
        """The garments."""
        return self.whole.worn


@dataclass
class Case:
    """One sequence from one start, with the predictions of its variants.

    Attributes:
        name: Name of the sequence.
        start: "warm" or "cold".
        windy: Whether the sequence has wind.
        garments: Its number of garments.
        frames: Number of predicted frames.
        errors: Variant -> error [cm], one number per seed.
        moved: Variant -> distance from the right prediction [cm], one number per seed.
    """

    name: str
    start: str
    windy: bool
    garments: int
    frames: int
    errors: dict[str, list[float]] = field(default_factory=dict)
    moved: dict[str, list[float]] = field(default_factory=dict)


def make(config: Any) -> dict[str, Any]:
    """Rolls out, measures and writes the table.

    Raises:
        OptionMissing: There are no data.
        DataLacks: The network reads neither materials nor wind, or fewer than two garments have a material.
    """
    if config.data is None:
        raise OptionMissing("outdoor needs --data FOLDER")
    path = checkpoint.find(config.network, device=config.device)
    simulator = Simulator(checkpoint.load(path), config.device)
    if not simulator.network.reads & {"materials", "wind"}:
        raise DataLacks(f"{path.name} reads neither materials nor wind; train one with the setting outdoor")
    skipped: dict[str, str] = {}
    folders = evenly(folders_of(Path(config.data), config.split, skipped), config.max_sequences)
    loaded = _loaded(folders, simulator, skipped)
    others = [permuted([s.materials for s in loaded], seed) for seed in range(config.tables.shuffles)]
    cases = [
        measured(simulator, sequence, [other[k] for other in others], start, config.frames, config.baselines)
        for k, sequence in enumerate(tqdm(loaded, desc="evaluating", unit="sequence"))
        for start in STARTS
    ]
    for place in config.tables.against:
        other = checkpoint.find(place, device=config.device)
        _beside(Simulator(checkpoint.load(other), config.device), other.stem, loaded, cases, config.frames)
    rows = [row for start in STARTS for row in summary([case for case in cases if case.start == start])]
    result: dict[str, Any] = {"table": "outdoor", "title": "Materials and wind", "protocol": NOTE}
    result |= {"network": path.name, "shuffles": config.tables.shuffles, "rows": rows, "skipped": skipped}
    result["sequences"] = [dataclasses.asdict(case) for case in cases]
    count = sum(case.windy for case in cases) // len(STARTS)
    about = f"{len(loaded)} sequences, {count} with wind, {sum(len(s.layers) for s in loaded)} garments."
    publish(config, result, [about, "", NOTE, "", *table(rows)], lambda target: draw_errors(target, rows))
    return result


def permuted(materials: Ordered[Ordered[Material | None]], seed: int) -> list[list[Material | None]]:
    """The materials of garments exchanged among all garments that have one; none keeps its own.

    Args:
        materials: Materials of the garments of each sequence.
        seed: Seed of the permutation, one cycle through all of them.

    Raises:
        DataLacks: Fewer than two garments have a material.
    """
    found = [list(of_one) for of_one in materials]
    places = [(i, j) for i, of_one in enumerate(found) for j, item in enumerate(of_one) if item is not None]
    if len(places) < 2:
        raise DataLacks("fewer than two garments of these sequences have a material, so none can be exchanged")
    order = np.random.default_rng(seed).permutation(len(places))
    for here, there in zip(order, np.roll(order, -1), strict=True):
        (i, j), (k, m) = places[here], places[there]
        found[i][j] = materials[k][m]
    return found


def measured(
    simulator: Simulator,
    sequence: Sequence,
    others: Ordered[Ordered[Material | None]],
    start: str,
    frames: int | None,
    baselines: bool,
) -> Case:
    """All variants of a sequence from one start.

    Args:
        simulator: Simulator with a network that reads materials or wind.
        sequence: The sequence.
        others: Its garments' materials for each seed.
        start: "warm" or "cold".
        frames: Largest number of predicted frames; None for all.
        baselines: Whether the skinned baseline is measured, too.
    """
    body, newest, steps, truth = _part(simulator, sequence, start, frames)
    right, wind, none = sequence.materials, sequence.wind, [None] * len(sequence.layers)
    case = Case(sequence.name, start, wind is not None and bool(np.any(wind)), len(right), steps)
    variants: list[tuple[str, Ordered[Material | None], np.ndarray | None]] = [(RIGHT, right, wind)]
    if "materials" in simulator.network.reads:
        variants += [("other materials", other, wind) for other in others]
        variants.append(("no material", none, wind))
    if case.windy and "wind" in simulator.network.reads:
        variants.append(("no wind", right, None))
        variants += [("neither", none, None)] if "materials" in simulator.network.reads else []
    expected: np.ndarray | None = None
    for name, materials, air in variants:
        given = Worn(sequence, materials, air)
        found = predict(simulator, given, newest, steps, cold=start == "cold", body=body)
        expected = found if expected is None else expected
        case.errors.setdefault(name, []).append(_distance(found, truth))
        case.moved.setdefault(name, []).append(_distance(found, expected))
    if baselines:
        case.errors[SKINNED] = [_distance(_skinned(sequence, body, newest, steps), truth)]
    return case


def summary(cases: Ordered[Case]) -> list[dict[str, Any]]:
    """Means of the variants over cases of one start: of all that have the variant, and of those in the wind."""
    rows = []
    for name in dict.fromkeys(name for case in cases for name in case.errors):
        row: dict[str, Any] = {"start": cases[0].start, "variant": name}
        for group, chosen in (("all", list(cases)), ("windy", [case for case in cases if case.windy])):
            having = [case for case in chosen if name in case.errors]
            if not having or (group == "all" and len(having) < len(chosen)):
                continue  # there is no wind to leave out in still air
            own = [case for case in having if np.isfinite([*case.errors[name], *case.errors[RIGHT]]).all()]
            if not own:
                row[group] = {"failed": len(having)}
                continue
            more = [np.mean(case.errors[name]) - case.errors[RIGHT][0] for case in own]
            each = [error > case.errors[RIGHT][0] for case in own for error in case.errors[name]]
            row[group] = {
                "error_cm": float(np.mean([np.mean(case.errors[name]) for case in own])),
                "more_cm": float(np.mean(more)),
                "standard_error_cm": float(np.std(more, ddof=1) / np.sqrt(len(more))) if len(more) > 1 else np.nan,
                "larger": int(np.sum(each)),
                "compared": len(each),
                "sequences": len(own),
                "failed": len(having) - len(own),
            }
            if name in own[0].moved:
                row[group]["moved_cm"] = float(np.mean([np.mean(case.moved[name]) for case in own]))
        rows.append(row)
    return rows


def _loaded(folders: Ordered[Path], simulator: Simulator, skipped: dict[str, str]) -> list[Sequence]:
    """The sequences that can be rolled out; reasons for all others are added to `skipped`."""
    found, history = [], simulator.network.config.history
    for folder in folders:
        try:
            sequence = Sequence.load(folder)
            check_rate(sequence.fps, simulator.network.config.fps)
            if len(sequence) < history + 1 or not np.isfinite(np.asarray(sequence.vertices)).all():
                raise ValueError("too short, or not finite")
            sequence.materials  # noqa: B018 (raises if the manifest has none that can be read)
            found.append(sequence)
        except Exception as error:
            skipped[folder.name] = reason_of(error)
    return found


def _part(
    simulator: Simulator, sequence: Sequence, start: str, frames: int | None
) -> tuple[BodyMotion, int, int, np.ndarray]:
    """The body, the newest recorded frame, the number of frames to predict, and these as recorded."""
    body = sequence.body()
    newest = simulator.network.config.history - 1 if start == "warm" else 0
    last = min(len(sequence.vertices), body.frames) - 1
    steps = min(last - newest, frames or last)
    return body, newest, steps, np.array(sequence.vertices[newest + 1 : newest + steps + 1], np.float32)


def _beside(
    simulator: Simulator, name: str, loaded: Ordered[Sequence], cases: Ordered[Case], frames: int | None
) -> None:
    """Adds the errors of another network, with the right materials and wind if it reads them, to the cases."""
    by_name = {sequence.name: sequence for sequence in loaded}
    for case in tqdm(cases, desc=name, unit="rollout"):
        sequence = by_name[case.name]
        body, newest, steps, truth = _part(simulator, sequence, case.start, frames)
        found = predict(simulator, sequence, newest, steps, cold=case.start == "cold", body=body)
        case.errors[name] = [_distance(found, truth)]


def _skinned(sequence: Sequence, body: BodyMotion, newest: int, steps: int) -> np.ndarray:
    """Each garment moving like skin."""
    part = BodyMotion(body.vertices[newest : newest + steps + 1], body.faces, body.fps)
    first = np.array(sequence.vertices[newest], np.float32)
    return skinned(sequence.garment, first, part)[1:]


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance of vertices [cm]; NaN if one is not finite."""
    return float(100.0 * np.linalg.norm(a.astype(np.float64) - b, axis=-1).mean())
