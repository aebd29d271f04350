"""The rollouts that a model card shows as pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

AGREE = 0.05  # largest relative difference between the error of a repeated rollout and that of the evaluation


@dataclass(frozen=True)
class Case:
    """A sequence that is drawn.

    Attributes:
        role: "best", "median", "second worst", "worst", or several of them if there are few sequences.
        row: Row of the sequence in the evaluation, from a cold start.
        ratio: Ratio of the network's error to that of the skinned garment; infinite if the network's rollout failed.
    """

    role: str
    row: Mapping[str, Any]
    ratio: float

    @property
    def file(self) -> str:
        """File name of the picture."""
        return self.role.split(",")[0].replace(" ", "_") + ".png"


@dataclass(frozen=True)
class Drawn:
    """A case that was rolled out again, with `moments`, the frames that are drawn, and `errors` of all predicted frames
    [cm].

    `errors[k]` belongs to frame k + 1, since frame 0 is given. Errors are NaN from the frame on in which a rollout
    failed.
    """

    case: Case
    moments: list[int]
    errors: np.ndarray

    @property
    def error(self) -> float:
        """Mean error over the predicted frames [cm]; NaN for a rollout that failed."""
        return float(self.errors.mean())

    @property
    def differs(self) -> bool:
        """Whether the error differs from that of the evaluated rollout by more than `AGREE`."""
        before = self.case.row["network"].get("mean_vertex_error_cm")
        before = math.nan if before is None else before
        return not (math.isnan(self.error) and math.isnan(before)) and not abs(self.error - before) <= AGREE * before
