"""The training loss: weighted L1 distances (section 4.3.2, equations 2-5; weights from the supplement, section 4).

    L = L_def + lambda_sv L_sv + lambda_vel L_vel        lambda_sv = 1, lambda_vel = 3

Each term sums the absolute differences of a face's (or component's) numbers and averages over faces (components).
`units` says in which units: "normalised" divides every number by its standard deviation over the training set, so
that nine small numbers and three smaller ones count alike; "physical" is the paper as printed (dimensionless Psi and
Sigma, metres per frame).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch

from warpgarment.network import ManifoldAwareTransformer, NormalisedOutput


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms and their units."""

    deformation: float = 1.0
    singular_values: float = 1.0
    velocity: float = 3.0
    units: Literal["normalised", "physical"] = "normalised"


class Losses(NamedTuple):
    """Scalars; `total` is the weighted sum of the others."""

    total: torch.Tensor
    deformation: torch.Tensor
    singular_values: torch.Tensor
    velocity: torch.Tensor


def loss(
    predicted: NormalisedOutput,
    target: NormalisedOutput,
    network: ManifoldAwareTransformer,
    config: LossConfig,
    velocity_mask: torch.Tensor | None = None,
) -> Losses:
    """Loss of a batch.

    Args:
        predicted: Normalised output of the network: [B,N,9], [B,N,3], [B,C,3].
        target: What it should be, normalised by the same statistics.
        network: Whose standard deviations turn normalised differences into physical ones.
        config: Weights and units.
        velocity_mask: True where a component is real, [B,C]; None where all are.
    """
    scale = [torch.ones(())] * 3
    if config.units == "physical":
        scale = [network.psi_std, network.singular_value_std, network.q_std]
    parts = [
        ((a.float() - b).abs() * s.to(b.device)).sum(dim=-1) for a, b, s in zip(predicted, target, scale, strict=True)
    ]
    deformation, singular_values = parts[0].mean(), parts[1].mean()
    if velocity_mask is None:
        velocity = parts[2].mean()
    else:
        velocity = torch.where(velocity_mask, parts[2], 0.0).sum() / velocity_mask.sum()
    total = config.deformation * deformation + config.singular_values * singular_values + config.velocity * velocity
    return Losses(total, deformation, singular_values, velocity)
