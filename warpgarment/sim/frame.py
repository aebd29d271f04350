"""One frame of a batch on the device."""

from __future__ import annotations

from typing import NamedTuple

import torch

from warpgarment.nn.inputs import Frames

from .history import History

FIGURES = 4
"""Columns of the figures of cloth that meets cloth: crossing pairs with other garments, with itself, lag [m], pairs not
looked at."""


class Frame(NamedTuple):
    """One frame of a batch. All of it is on the device, so that the next frame can be computed without the host."""

    positions: torch.Tensor  # [V,3] packed [m]; for a garment that failed, its last finite positions
    body: torch.Tensor  # [U,3] packed [m]
    features: torch.Tensor | Frames  # [F,H-1,34] of the history; never `Frames` on a GPU
    velocities: torch.Tensor  # [C,H-1,3] of the history [m/frame]
    finite: torch.Tensor  # bool [B], whether a garment has been finite so far
    depth: torch.Tensor  # [B] depth of the deepest point of each garment in its body [m]
    solves: (
        torch.Tensor
    )  # float64 [2,3]: for Poisson and collisions, iterations, number of stopped components, their largest error
    meeting: torch.Tensor  # [B,4] figures of cloth that meets cloth, see `FIGURES`; NaN for no outfit

    previous: torch.Tensor  # [2,V,3] positions at t-1 and t-2 [m]; [0,V,3] if the network does not read them
    previous_body: torch.Tensor  # [2,U,3] the same of the bodies; or [0,U,3]
    wind: torch.Tensor  # [2,B,3] velocity of the air at t and t-1 [m/s]; [0,B,3] if the network does not read it

    @property
    def history(self) -> History:
        """The features and velocities of earlier frames."""
        return History(self.features, self.velocities)

    def blown(self, wind: torch.Tensor | None) -> Frame:
        """The same frame with the wind of t+1 before that of t; it is that of t if None is given.

        Args:
            wind: Velocity of the air at t+1 [m/s], shape [B,3].
        """
        if not len(self.wind):
            return self
        return self._replace(wind=earlier(self.wind, self.wind[0] if wind is None else wind))

    @property
    def outcome(self) -> tuple[torch.Tensor, ...]:
        """The tensors that `recording.read` copies to the host."""
        return self.positions, self.finite, self.depth, self.solves, self.meeting


def earlier(frames: torch.Tensor, newest: torch.Tensor) -> torch.Tensor:
    """Some past frames, newest first, moved on by one: [K,*,3] and [*,3] -> [K,*,3]; nothing if K is 0."""
    return torch.cat([newest[None], frames[:-1]]) if len(frames) else frames
