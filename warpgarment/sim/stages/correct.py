"""Correctors, which change positions after contact, such as a few iterations of physics. By default there are none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch

from warpgarment.objects.pack import PackedGarments
from warpgarment.objects.sizes import Sizes
from warpgarment.sim.timing import Timings

from .finite import keep_finite


class Corrector(Protocol):
    """Changes the positions of the garments of a batch after contact."""

    name: str
    """Name of the corrector, and its key in `Simulator.timings`."""

    def __call__(
        self, before: torch.Tensor, after: torch.Tensor, next_body: torch.Tensor, finite: torch.Tensor
    ) -> torch.Tensor:
        """Positions at t+1.

        Frames are recorded as CUDA graphs. So nothing here may wait for the device, as `.item()` and indexing by a mask
        do, and shapes must not change from frame to frame.

        Args:
            before: Garments at t [m], float32 [V,3].
            after: Garments at t+1 after contact and earlier correctors [m], float32 [V,3]; not to be changed in place.
            next_body: Bodies at t+1 [m], float32 [U,3].
            finite: Which garments are simulated, bool [B]; those that are not have stopped, and stay where they are.

        Returns:
            Positions [m], float32 [V,3]. A garment whose positions are not finite stops.
        """
        ...

    def memory(self, sizes: Sizes) -> dict[str, int]:
        """Bytes that it needs on the device for a batch of these sizes, by purpose."""
        ...


class Correct:
    """Runs the correctors of a batch one after another.

    Args:
        correctors: The correctors; more may be appended before the first frame.
        packed: The batch.
        depth: Function that measures the depth of garments [V,3] in bodies [U,3], shape [B], all in metres.
        timings: Times of the stages, to which each corrector adds its own, by its name.
    """

    def __init__(
        self,
        correctors: Sequence[Corrector],
        packed: PackedGarments,
        depth: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
        timings: Timings,
    ) -> None:
        self._correctors, self._packed, self._depth, self._timings = correctors, packed, depth, timings

    def __call__(
        self,
        before: torch.Tensor,
        after: torch.Tensor,
        next_body: torch.Tensor,
        finite: torch.Tensor,
        depth: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Corrected positions [V,3], which garments are finite [B], and their depths in the bodies [m], shape [B].

        Without correctors, the arguments are returned.

        Args:
            before: Garments at t [m], shape [V,3].
            after: Garments at t+1 [m], shape [V,3].
            next_body: Bodies at t+1 [m], shape [U,3].
            finite: Which garments are simulated, bool [B].
            depth: Depths of `after` [m], shape [B].
        """
        for corrector in self._correctors:
            with self._timings(corrector.name):
                corrected = corrector(before, after, next_body, finite)
                after, finite = keep_finite(self._packed, corrected, after, finite)
        if self._correctors:
            with self._timings("collision"):
                depth = torch.where(finite, self._depth(after, next_body), depth)
        return after, finite, depth
