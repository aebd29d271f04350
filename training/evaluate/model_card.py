"""A page about a trained network, with pictures of rollouts that include its failures, chosen by a printed rule.

    python -m warpgarment.training.evaluate.model_card --data sequences --network out/run/best.safetensors \\
        --evaluation out/evaluation/evaluation.json --out out/card

The page, `card.md` with `card/*.png`, describes the network, the data, the training and its curves (from the run's
`log.jsonl`), the figures of an evaluation by start, method and category, and rollouts beside the teacher's, chosen by
`RULE`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.atomic import atomic_file, atomic_folder
from warpgarment.io.disk.plain import below, parsed_json, read_json, read_plain
from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.card_facts import Facts
from warpgarment.training.data.schema import is_finite
from warpgarment.training.data.sequence import Sequence as SequenceOnDisk
from warpgarment.training.rollouts import predict
from warpgarment.training.tables.protocol import METHODS
from warpgarment.training.train.log import LOG_LARGEST

from .model_card_cases import Case, Drawn
from .model_card_page import page, ratio
from .model_card_pictures import curves, rollout_sheet

RULE = (
    "Sequences are ordered by the ratio of the network's mean vertex error to that of the garment skinned to its "
    "nearest body faces, both from a cold start; a rollout that failed comes last, and equal ratios go by name. Shown "
    "are the first, the median (of an even number the better one) and the last two, each at the frames of largest "
    "error that are at least half a second apart; the network above, the teacher below."
)
APART = 0.5  # least time between the frames that are drawn [s]


class CardError(ValueError):
    """The page cannot be written from these files; the message names the file and the reason."""


@dataclass(frozen=True)
class ModelCardConfig:
    """Settings of a page.

    Attributes:
        data: Folder of the sequences that were evaluated.
        network: Checkpoint file or folder, or the name of a network that ships.
        evaluation: `evaluation.json` of this network, with baselines.
        out: Folder for `card.md` and `card/`.
        log: `log.jsonl` of the training; by default the one beside the checkpoint, if there is one.
        moments: Frames drawn per sequence.
        device: Of the rollouts, "cpu" or "cuda"; None: a GPU where there is one.
        size: Width and height of each picture in pixels.
    """

    data: Path
    network: str
    evaluation: Path
    out: Path
    log: Path | None = None
    moments: int = 4
    device: str | None = None
    size: tuple[int, int] = (210, 290)


def write_card(config: ModelCardConfig) -> Path:
    """Writes the page and its pictures.

    Returns:
        Path of `card.md`.

    Raises:
        CardError: The evaluation is damaged, of another network, without baselines, or of other sequences.
        CheckpointError: The network does not exist or cannot be read.
        MissingExtra: The extra for pictures is not installed (`pip install "warpgarment[view]"`).
    """
    path = checkpoint.find(config.network, device=config.device)
    network = checkpoint.load(path)
    _, notes = checkpoint.read_metadata(path)
    evaluation = read_evaluation(config.evaluation, network.config.as_dict(), notes)
    log = config.log or (path if path.is_dir() else path.parent) / "log.jsonl"
    if config.log is not None and not log.is_file():
        raise CardError(f"{log}: no such file; leave log away for a page without curves")
    lines = read_log(log) if log.is_file() else []
    cases = chosen(evaluation["sequences"])
    facts = Facts.of(config.data)
    simulator = Simulator(network, config.device)
    drawn = []
    with atomic_folder(Path(config.out) / "card", "*.png") as folder:
        pictured = curves(folder / "training.png", lines)
        for case in cases:
            drawn.append(_draw(folder / case.file, case, config, simulator))
        text = page(path.name, network, notes, evaluation, facts, drawn, lines if pictured else [], RULE)
    with atomic_file(Path(config.out) / "card.md") as temporary:
        temporary.write_text(text, "utf-8")
    return Path(config.out) / "card.md"


def read_evaluation(path: Path, config: Mapping[str, Any], notes: Mapping[str, Any]) -> dict[str, Any]:
    """The result of `evaluate`, after a check that it is of the network with this configuration and these notes.

    Raises:
        CardError: The result is of another network, or damaged.
    """
    try:
        result = read_json(path)
        about, mean = result["network"], result["mean"]
        _objects(about, mean, result.get("settings", {}), result.get("skipped") or {})
        _objects(about.get("config") or {}, *mean.values())
        for row in (row for start in mean.values() for row in start.values()):
            _check_figures(row)
        if not isinstance(result.get("frames_predicted", 0), int):
            raise ValueError("a number of frames that is none")
        for row in result["sequences"]:
            _check_row(row)
        rows = [row for row in result["sequences"] if row["start"] == "cold"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CardError(f"{path}: no result of an evaluation ({type(error).__name__}: {error})") from error
    # A setting that was introduced later has its default value in older files.
    settings = NetworkConfig().as_dict() | dict(about.get("config") or {})
    if settings != dict(config) or about.get("notes") != dict(notes):
        raise CardError(
            f"{path}: is of another network ({about.get('file')}; its settings or notes differ). Evaluate this one."
        )
    if not rows or not all("skinned" in row for row in rows) or "cold" not in mean:
        raise CardError(f"{path}: has no cold starts with the skinned baseline. Evaluate again, with baselines.")
    return result


def _objects(*parts: object) -> None:
    """Raises TypeError unless all are JSON objects."""
    if not all(isinstance(part, dict) for part in parts):
        raise TypeError("a list, a text or a number in place of an object")


def _check_figures(figures: object) -> None:
    """Raises ValueError unless these are numbers by name."""
    known = isinstance(figures, dict) and all(
        v is None or isinstance(v, bool) or is_finite(v) for v in figures.values()
    )
    if not known:
        raise ValueError("figures that are no numbers")


def _check_row(row: Mapping[str, Any]) -> None:
    """Raises ValueError where a row of an evaluation holds something else than the page shows."""
    _objects(row, row["network"])
    for method in METHODS:
        _check_figures(row.get(method, {}))
    error = row["network"].get("mean_vertex_error_cm")
    if not isinstance(row["sequence"], str) or not isinstance(row["frames"], int):
        raise ValueError("a row that does not name its sequence, or number its frames")
    if not isinstance(row["network"].get("finite"), bool):
        raise ValueError(f"the row of {row['sequence'][:60]!r} does not say whether the rollout was finite")
    if error is not None and not is_finite(error):
        raise ValueError(f"the error of {row['sequence'][:60]!r} is no number")


def read_log(path: Path) -> list[dict[str, Any]]:
    """Lines of a training log by step. Of lines that a resumed run wrote again, the later ones count; a torn line is
    left out."""
    entries: dict[tuple[int, bool], dict[str, Any]] = {}
    for line in read_plain(path, LOG_LARGEST).decode("utf-8", errors="replace").splitlines():
        try:
            entry = parsed_json(path, line)
        except MeshError:
            continue
        if isinstance(entry, dict) and isinstance(entry.get("step"), int):
            for kind in ("loss", "rollout_error_cm"):
                if kind in entry:
                    entries[entry["step"], kind == "loss"] = entry
    return [entries[key] for key in sorted(entries)]


def chosen(rows: Sequence[Mapping[str, Any]]) -> list[Case]:
    """The best, the median, the second worst and the worst of the cold starts, by `RULE`.

    Args:
        rows: Rows of an evaluation, one per sequence and start.

    Returns:
        Cases from best to worst; a sequence with several roles is one case with all of them.
    """
    order = sorted((row for row in rows if row["start"] == "cold"), key=lambda row: (ratio(row), row["sequence"]))
    last = len(order) - 1
    roles: dict[int, list[str]] = {}
    for role, place in {"best": 0, "median": last // 2, "second worst": max(last - 1, 0), "worst": last}.items():
        roles.setdefault(place, []).append(role)
    return [Case(", ".join(roles[place]), order[place], ratio(order[place])) for place in sorted(roles)]


def largest(errors: np.ndarray, count: int, apart: int) -> list[int]:
    """Places of the largest errors.

    Args:
        errors: Errors, [T]; NaN does not count.
        count: Largest number of places.
        apart: Least distance between two places.

    Returns:
        Indices into the errors, ascending.
    """
    left = np.where(np.isfinite(errors), errors, -np.inf)
    places: list[int] = []
    while len(places) < count and np.isfinite(left).any():
        place = int(left.argmax())
        places.append(place)
        left[max(place - apart + 1, 0) : place + apart] = -np.inf
    return sorted(places)


def _draw(path: Path, case: Case, config: ModelCardConfig, simulator: Simulator) -> Drawn:
    """Rolls a sequence out again, as in the evaluation, and draws it."""
    folder = below(config.data, case.row["sequence"], f"{config.evaluation}: a sequence")
    if not folder.is_dir():
        raise CardError(
            f"{config.data}: has no sequence {folder.name}, which was evaluated. Name the data of that time."
        )
    sequence = SequenceOnDisk.load(folder)
    steps = int(case.row["frames"])
    if len(sequence) < steps + 1:
        raise CardError(
            f"{folder}: has {len(sequence)} frames, {steps + 1} were evaluated. Name the data of that time."
        )
    truth = np.array(sequence.vertices[: steps + 1], np.float32)
    moved = np.concatenate([truth[:1], predict(simulator, sequence, 0, steps, cold=True)])
    errors = 100.0 * np.linalg.norm(moved[1:].astype(np.float64) - truth[1:], axis=-1).mean(axis=1)
    moments = [place + 1 for place in largest(errors, config.moments, max(round(APART * sequence.fps), 1))] or [0]
    drawn = Drawn(case, moments, errors)
    rollout_sheet(path, sequence, moved, truth, drawn, size=config.size)
    return drawn


if __name__ == "__main__":
    import tyro

    print(write_card(tyro.cli(ModelCardConfig, description="Writes a page about a trained network.")))
