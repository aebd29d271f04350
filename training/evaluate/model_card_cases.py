"""The rollouts that a model card shows as pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

AGREE = 0.05  # a rollout made again is expected to have the error it had before, up to this share


@dataclass(frozen=True)
class Case:
    """A sequence that is drawn.

    Attributes:
        role: "best", "median", "second worst", "worst", or several of them where there are few sequences.
        row: Its row of the evaluation, from a cold start.
        ratio: Of the network's error to the skinned garment's; infinite where the network's rollout failed.
    """

    role: str
    row: Mapping[str, Any]
    ratio: float

    @property
    def file(self) -> str:
        """Name of its picture."""
        return self.role.split(",")[0].replace(" ", "_") + ".png"


@dataclass(frozen=True)
class Drawn:
    """A case as it was rolled out again: frames of the sequence that are drawn, and errors [cm] of all predicted ones.

    `errors[k]` belongs to frame k + 1, since frame 0 is given; NaN from where a rollout failed.
    """

    case: Case
    moments: list[int]
    errors: np.ndarray

    @property
    def error(self) -> float:
        """Mean over the predicted frames [cm]; NaN for a rollout that failed."""
        return float(self.errors.mean())

    @property
    def differs(self) -> bool:
        """Whether this is not the rollout that was evaluated."""
        before = self.case.row["network"].get("mean_vertex_error_cm")
        before = math.nan if before is None else before
        return not (math.isnan(self.error) and math.isnan(before)) and not abs(self.error - before) <= AGREE * before
