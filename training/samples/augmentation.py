"""Symmetries of the problem, applied to training samples.

Mirroring and turning about the vertical are exact, since gravity does not change. A change of size is not exact.
Lengths and displacements per frame (positions, closest points, distances, velocities, geodesics, the target q) are
multiplied by the factor s; Phi, Psi, Sigma, normals, directions and the body's deformation have no unit and do not
change. But a recording that is scaled by s is one with gravity s * 9.8 m/s^2, and with cloth whose ratios of bending to
weight and of air drag to weight are wrong by powers of s. For a few per cent this is within the differences between
materials; a larger change teaches wrong dynamics. So it is off by default, and limited to `LARGEST_SCALE`.

There is no remeshing. Recorded frames could be resampled to another triangulation of the rest pose (by barycentric
coordinates on its faces). But a new triangle across a fold of the recording is flatter than the cloth was, so its
singular values, which the network learns, show a compression that never happened. On a recorded skirt of 1,000 faces,
resampled to 1,000 others, the smaller singular value fell from 1.1 % to 6.0 % below 1 on average, and from 9 % to 44 %
below 1 at the first percentile. New triangulations come from the teacher: each generated sequence has its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from warpgarment.nn.parametrisation import NetworkOutput
from warpgarment.nn.run import mirror_inputs, mirror_output

LARGEST_SCALE = 0.1  # largest value of `Augmentation.scale`


@dataclass(frozen=True)
class Augmentation:
    """Random symmetries and changes of size of samples.

    Attributes:
        mirror: Share of samples that are mirrored in x.
        yaw: Standard deviation [degrees] of a random turn of world and rest pose together.
        world_yaw: Whether the world is turned by any angle (for networks with heading "world").
        scale: Largest relative change of the size of body and garment, whose factor is drawn uniformly from
            [1 - scale, 1 + scale]. Gravity does not scale with it, so 0.05 or less is advised.
    """

    mirror: float = 0.5
    yaw: float = 5.0
    world_yaw: bool = False
    scale: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.scale <= LARGEST_SCALE:
            raise ValueError(
                f"augmentation scale must lie between 0 and {LARGEST_SCALE}, since gravity does not scale with it, "
                f"got {self.scale}"
            )


def mirror(
    features: torch.Tensor, velocities: torch.Tensor, target: NetworkOutput, chosen: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, NetworkOutput]:
    """Mirrors samples in x: vectors v -> M v, maps A -> M A M with M = diag(-1, 1, 1); distances do not change.

    The faces of the mirrored garment have the opposite winding, so its normals M n point outward.

    Args:
        features: Stacked features, shape [B,N,H*34].
        velocities: Velocities of components [m/frame], shape [B,C,K*3].
        target: Target of the network, shapes [B,N,3,3], [B,N,3], [B,C,3].
        chosen: Mask of the samples to mirror, bool [B].
    """
    return *mirror_inputs(features, velocities, chosen), mirror_output(target, chosen)
