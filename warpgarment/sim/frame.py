"""One frame of a batch on the device, the next one from it, and reading what the host wants to know of it."""

from __future__ import annotations

from typing import NamedTuple

import torch

from .history import History


class Frame(NamedTuple):
    """One frame of a batch: tensors on the device alone, so that a frame can follow another without the host."""

    positions: torch.Tensor  # [V,3] packed; of a garment that failed, where it was last finite
    body: torch.Tensor  # [U,3] packed
    features: torch.Tensor  # of the history, [F,H-1,34]
    velocities: torch.Tensor  # of the history, [C,H-1,3]
    finite: torch.Tensor  # bool [B]
    depth: torch.Tensor  # [B] metres
    solves: (
        torch.Tensor
    )  # float64 [2,3]: Poisson and collisions; iterations, components stopped, largest error of these

    @property
    def history(self) -> History:
        """What the network remembers."""
        return History(self.features, self.velocities)

    @property
    def outcome(self) -> tuple[torch.Tensor, ...]:
        """What `read` reads."""
        return self.positions, self.finite, self.depth, self.solves
