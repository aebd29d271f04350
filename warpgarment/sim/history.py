"""The input of the network from earlier frames: features of H frames and the H-1 velocities between them (Algorithm 1).

A history is never changed. Each frame makes a new one, so old states of a simulation stay usable. This is cheap: the
only array written per frame is the stack that the network reads, and the next history is a view of it.
"""

from __future__ import annotations

import dataclasses

import torch

from warpgarment.kernels.features.channels import FACE


@dataclasses.dataclass(frozen=True)
class History:
    """Features of frames t-H+1 ... t-1 and velocities up to frame t, oldest first.

    Frame t itself is missing from the features because they need the body at t+1.
    """

    features: torch.Tensor  # [F,H-1,34]
    velocities: torch.Tensor  # [C,H-1,3] centroid of each component at frame k minus that at k-1, metres per frame

    @classmethod
    def cold(cls, features: torch.Tensor, components: int, frames: int) -> History:
        """A history that repeats the first frame at rest: body deformations are the identity, all velocities zero.

        Args:
            features: Features of the first frame, shape [F,34]; those of the body's motion are replaced.
            components: Number of connected components C.
            frames: Number of frames H.
        """
        repeated = FACE.still(features)[:, None].expand(-1, frames - 1, -1)
        return cls(repeated, features.new_zeros((components, frames - 1, 3)))

    def stacked(self, newest: torch.Tensor) -> torch.Tensor:
        """Features of all H frames, shape [F,H,34]; `newest` are those of frame t, shape [F,34]."""
        return torch.cat([self.features, newest[:, None]], dim=1)

    def followed(self, stacked: torch.Tensor, velocity: torch.Tensor) -> History:
        """The history one frame later.

        Args:
            stacked: The result of `stacked`.
            velocity: Velocity of each component from frame t to t+1 [m/frame], shape [C,3].
        """
        return History(stacked[:, 1:], torch.cat([self.velocities[:, 1:], velocity[:, None]], dim=1))
