"""The state of a simulation between two frames."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from warpgarment.history import History
from warpgarment.scene import Scene
from warpgarment.status import RolloutStatus


@dataclasses.dataclass(frozen=True)
class SimulationState:
    """Garments and bodies at one frame, with the history the network needs. `Simulator.step` returns a new one.

    States are values: stepping one leaves it as it was, so a state may be kept, and stepped twice with different
    bodies. The bodies' search trees are shared by all states of a `start` and moved as needed, so states of one `start`
    must not be stepped from several threads at a time.
    """

    scene: Scene
    single: bool  # one garment, not a list
    frame: int
    positions: torch.Tensor  # [V,3] packed, on the device; of a garment that failed, where it was last finite
    body: torch.Tensor  # [U,3] packed, on the device
    history: History
    finite: np.ndarray  # bool [B]
    depth: np.ndarray  # float32 [B]
    poisson_iterations: int
    collision_iterations: int

    @property
    def vertices(self) -> Any:
        """Positions [m], float32 [V,3]; a list of such for a list of garments. NaN for a garment that has failed."""
        parts = self.split()
        return parts[0] if self.single else parts

    @property
    def status(self) -> Any:
        """The `RolloutStatus` of this frame; a list of them for a list of garments."""
        statuses = self.statuses()
        return statuses[0] if self.single else statuses

    def split(self) -> list[np.ndarray]:
        """Positions of each garment of the batch, as copies."""
        parts = [part.copy() for part in self.scene.packed.split(self.positions.cpu().numpy())]
        for part, finite in zip(parts, self.finite, strict=True):
            if not finite:
                part[:] = np.nan
        return parts

    def statuses(self) -> list[RolloutStatus]:
        """The status of each garment of the batch."""
        iterations = (self.poisson_iterations, self.collision_iterations)
        return [
            RolloutStatus.judged(self.frame, bool(finite), float(depth), *iterations)
            for finite, depth in zip(self.finite, self.depth, strict=True)
        ]
