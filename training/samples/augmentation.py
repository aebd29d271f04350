"""Symmetries of the problem, applied to training samples.

Mirroring and turning about the vertical are exact: gravity stays where it is. A change of size is not. Lengths and
displacements per frame (positions, closest points, distances, velocities, geodesics, the target q) take the factor s;
Phi, Psi, Sigma, normals, directions and the body's deformation have no unit and stay. But gravity (9.8 m/s^2) and the
frame's 1/30 s do not take it, so a recording at size s is a world with gravity s * 9.8 m/s^2, and cloth whose ratios of
bending to weight, and of air drag to weight, are off by powers of s. For a few per cent this lies within what materials
differ by; beyond, it teaches wrong dynamics. Hence it is off unless asked for, and limited to `LARGEST_SCALE`.

Remeshing is not here. Recorded frames can be resampled onto another triangulation of the rest pose (barycentric
coordinates on its faces), but where a new triangle spans a fold of the recording it is flatter than the cloth was, and
its singular values, which are what the network learns, say compression that never happened: on a recorded skirt of
1,000 faces, resampled to 1,000 others, the smallest one fell from 1.1 % to 6.0 % below 1 on average, and at the first
percentile from 9 % to 44 %. New triangulations come from the teacher: every generated sequence has its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from warpgarment.nn.parametrisation import NetworkOutput
from warpgarment.nn.run import mirror_inputs, mirror_output

LARGEST_SCALE = 0.1


@dataclass(frozen=True)
class Augmentation:
    """What is done to samples at random.

    Attributes:
        mirror: Share of samples mirrored in x.
        yaw: Standard deviation [degrees] of a joint turn of world and rest pose.
        world_yaw: Turn the world by any angle (for networks with heading "world").
        scale: Body and garment are scaled by a factor drawn uniformly from [1 - scale, 1 + scale]. Gravity is not, so
            0.05 or less is advised.
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
    """Samples as a mirror in x shows them: v -> M v, maps A -> M A M, M = diag(-1, 1, 1); distances stay.

    The mirrored garment's faces run the other way round, so that its normals point outward; they are M n.

    Args:
        features: [B,N,H*34].
        velocities: [B,C,K*3].
        target: [B,N,3,3], [B,N,3], [B,C,3].
        chosen: Which samples, bool [B].
    """
    return *mirror_inputs(features, velocities, chosen), mirror_output(target, chosen)
