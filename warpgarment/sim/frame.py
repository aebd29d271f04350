"""One frame of a batch on the device."""

from __future__ import annotations

from typing import NamedTuple

import torch

from .history import History


class Frame(NamedTuple):
    """One frame of a batch. All of it is on the device, so that the next frame can be computed without the host."""

    positions: torch.Tensor  # [V,3] packed [m]; for a garment that failed, its last finite positions
    body: torch.Tensor  # [U,3] packed [m]
    features: torch.Tensor  # [F,H-1,34] of the history
    velocities: torch.Tensor  # [C,H-1,3] of the history [m/frame]
    finite: torch.Tensor  # bool [B], whether a garment has been finite so far
    depth: torch.Tensor  # [B] depth of the deepest point of each garment in its body [m]
    solves: (
        torch.Tensor
    )  # float64 [2,3]: for Poisson and collisions, iterations, number of stopped components, their largest error
    meeting: torch.Tensor  # [B,4] figures of cloth that meets cloth, see `stages.meet.FIGURES`; NaN for no outfit

    @property
    def history(self) -> History:
        """The features and velocities of earlier frames."""
        return History(self.features, self.velocities)

    @property
    def outcome(self) -> tuple[torch.Tensor, ...]:
        """The tensors that `recording.read` copies to the host."""
        return self.positions, self.finite, self.depth, self.solves, self.meeting
