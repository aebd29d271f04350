"""The rows of the comparison: what both builds do, on how many threads, and the ratio that is aimed at."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Case:
    """One row.

    Attributes:
        name: What `--only` names it by.
        what: What the table says.
        kind: Key of `worker.CASES`, or "train".
        target: Largest ratio of today's figure to the earlier build's; None for a row without one.
        options: Arguments of the case; `faces` are numbers of faces, in whose place scenes are made.
        threads: Threads of both builds.
        share: Number by which times are divided, such as the garments of a batch.
        rounds: Largest number of turns.
        warm_up: Number of runs before the first turn; in the first fifteen frames what later ones do is recorded.
        fresh: Whether each turn is a process of its own.
        unit: Unit of the figure: "ms", "s", or "MB" for the largest memory of a process of its own.
        cached: Whether a process of its own finds compiled kernels.
    """

    name: str
    what: str
    kind: str
    target: float | None = None
    options: dict[str, Any] = field(default_factory=dict)
    threads: int = 1
    share: int = 1
    rounds: int = 60
    warm_up: int = 16
    fresh: bool = False
    unit: str = "ms"
    cached: bool = True


CASES = (
    Case("state", "one frame from the same state, largest distance", "next", options={"starts": [0, 30, 60, 90, 120]}),
    Case("frame-2000", "whole frame, 1,764 faces, one core", "frames", 0.5, {"faces": [2000]}),
    Case("frame-10000", "whole frame, 8,698 faces, one core", "frames", 0.4, {"faces": [10_000]}),
    Case("frame-1000", "whole frame, 1,000 faces, one core", "frames", None, {"faces": [1000]}),
    Case("frame-5000", "whole frame, 5,000 faces, one core", "frames", None, {"faces": [5000]}),
    Case("cores-2000", "whole frame, 1,764 faces, two cores", "frames", 0.3, {"faces": [2000]}, threads=2),
    Case("cores-10000", "whole frame, 8,698 faces, two cores", "frames", None, {"faces": [10_000]}, threads=2),
    Case("cores-1000", "whole frame, 1,000 faces, two cores", "frames", None, {"faces": [1000]}, threads=2),
    Case("cores-5000", "whole frame, 5,000 faces, two cores", "frames", None, {"faces": [5000]}, threads=2),
    Case("batch", "16 garments, two cores, per garment", "frames", 0.3, {"faces": [2000] * 16}, 2, 16, 12),
    Case("set-up", "geodesics and set-up, 8,698 faces, one core", "set-up", 0.5, {"faces": [10_000], "alone": True},
         rounds=5, warm_up=0),
    Case("train", "step of unrolled training, two cores", "train", 0.4, threads=2, unit="s"),
    Case("memory-200", "largest memory, 200 garments", "frames", 0.6, {"faces": [1000] * 200}, rounds=2, fresh=True,
         unit="MB"),
    Case("memory-first", "largest memory, loading and a rollout", "first", 0.8, rounds=3, fresh=True, unit="MB"),
    Case("first", "first rollout of a process, kernels cached", "first", 0.6, rounds=8, fresh=True, unit="s"),
    Case("compile", "first rollout of a process, nothing cached", "first", 0.5, rounds=2, fresh=True, unit="s",
         cached=False),
)  # fmt: skip
"""Cases in the order of the table; 2,000 and 10,000 faces are those asked of the remesher."""
