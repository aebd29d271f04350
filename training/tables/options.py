"""Options of `warpgarment evaluate --table`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

TableName = Literal[
    "table1", "table2", "figure5", "figure7", "figure9", "figure12", "category", "long", "recipe", "outdoor"
]

RESULTS = Path("benchmarks/results")  # default folder of tables


@dataclass(frozen=True)
class TableOptions:
    """What the tables need beside the options of every evaluation. Each table reads its own.

    Attributes:
        runs: Of table1, table2 and recipe: the row `full` of table1 is trained in RUNS/table1/full. Runs that are
            complete are not repeated, interrupted ones go on, and those made with other settings are refused.
        rows: Only these rows of table1, table2 or recipe; none: all.
        steps: Training steps of every row.
        time_limit: Instead of steps: minutes of training of every row.
        overrides: Network settings of every row, name=value.
        settings: Training settings of every row, name=value, as in batch_size=8 or pushforward.share=0.
        seed: Of every row's training.
        against: Of figure9, figure12, category and outdoor: other networks to measure on the same sequences.
        held_out: Of category: what was not trained on; none: what the data set's set.json says.
        faces: Of figure5 and figure7: numbers of faces to compare.
        long_frames: Of long: frames of each rollout.
        garments: Of long: bundled garments to take for a walk.
        shuffles: Of outdoor: number of permutations of the materials, by the seeds 0, 1, ...
    """

    runs: Path = Path("runs")
    rows: tuple[str, ...] = ()
    steps: int | None = None
    time_limit: float | None = None
    overrides: tuple[str, ...] = ("dropout=0.0",)
    settings: tuple[str, ...] = ()
    seed: int = 0
    against: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()
    faces: tuple[int, ...] = (1000, 2000, 5000)
    long_frames: int = 1000
    garments: tuple[str, ...] = ("dress", "tshirt")
    shuffles: int = 3


class OptionMissing(ValueError):
    """An option that the evaluation needs was not given."""


class DataLacks(ValueError):
    """The data set lacks what this table compares; the message has the command that makes it."""
