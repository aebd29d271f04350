"""What the network remembers: the last H frames of features and the H-1 velocities between them (Algorithm 1).

A history is never changed, only followed by the next one, so old states of a simulation stay usable. It is cheap: the
one array written per frame is the stack the network reads anyway, and the next history is a view of it.
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
    velocities: torch.Tensor  # [C,H-1,3] centroid of the component at k minus at k-1, metres per frame

    @classmethod
    def cold(cls, features: torch.Tensor, components: int, frames: int) -> History:
        """The first frame repeated, at rest: body deformation identity, all velocities zero.

        Args:
            features: Of the first frame, shape [F,34]; what they say of the body's motion is replaced.
            components: Number of connected components C.
            frames: H.
        """
        repeated = FACE.still(features)[:, None].expand(-1, frames - 1, -1)
        return cls(repeated, features.new_zeros((components, frames - 1, 3)))

    def stacked(self, newest: torch.Tensor) -> torch.Tensor:
        """Features of all H frames; `newest` [F,34] are those of frame t. Shape [F,H,34]."""
        return torch.cat([self.features, newest[:, None]], dim=1)

    def followed(self, stacked: torch.Tensor, velocity: torch.Tensor) -> History:
        """The history one frame later.

        Args:
            stacked: What `stacked` returned.
            velocity: Of each component from frame t to t+1 [m/frame], shape [C,3].
        """
        return History(stacked[:, 1:], torch.cat([self.velocities[:, 1:], velocity[:, None]], dim=1))
