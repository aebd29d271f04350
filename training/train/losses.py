"""The training loss: weighted L1 distances (section 4.3.2, equations 2-5; weights from the supplement, section 4).

    L = L_def + lambda_sv L_sv + lambda_vel L_vel        lambda_sv = 1, lambda_vel = 3

Each term sums the absolute differences of a face's (or component's) numbers and averages over faces (components).
With units "normalised", every number is divided by its standard deviation over the training set, so that large and
small numbers count equally. Units "physical" are those of the paper (Psi and Sigma without unit, metres per frame).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch

from warpgarment.nn.inputs import NormalisedOutput
from warpgarment.nn.network import GarmentNetwork


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms and their units.

    Attributes:
        deformation: Weight of the loss of Psi.
        singular_values: Weight of the loss of Sigma.
        velocity: Weight of the loss of q.
        units: "normalised" divides each number by its standard deviation over the training set; "physical" does not.
    """

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
    network: GarmentNetwork,
    config: LossConfig,
    velocity_mask: torch.Tensor | None = None,
    components: torch.Tensor | None = None,
    face_mask: torch.Tensor | None = None,
    faces: torch.Tensor | None = None,
) -> Losses:
    """Loss of a batch, in float32.

    Args:
        predicted: Normalised output of the network: [B,N,9], [B,N,3], [B,C,3].
        target: Desired output, normalised by the same statistics.
        network: Network with the standard deviations for "physical" units.
        config: Weights and units.
        velocity_mask: True where a component is real, [B,C]; None where all are.
        components: Divisor of the sum over components, a scalar; None for the number of real components. For a part of
            a batch, it is the number in the whole batch times the share of the part, so that the mean over equal parts
            is the loss of the whole batch.
        face_mask: True where a face is real, [B,N]; None where all are.
        faces: Divisor of the sums over faces, like `components`.
    """
    deformation, singular_values, velocity = _differences(predicted, target, network, config)
    if face_mask is not None:
        deformation, singular_values = (torch.where(face_mask, part, 0.0) for part in (deformation, singular_values))
        faces = face_mask.sum() if faces is None else faces
    deformation, singular_values = (
        part.mean() if faces is None else part.sum() / faces for part in (deformation, singular_values)
    )
    if velocity_mask is not None:
        velocity = torch.where(velocity_mask, velocity, 0.0)
        components = velocity_mask.sum() if components is None else components
    velocity = velocity.mean() if components is None else velocity.sum() / components
    return summed(deformation, singular_values, velocity, config)


def weighted(
    predicted: NormalisedOutput,
    target: NormalisedOutput,
    network: GarmentNetwork,
    config: LossConfig,
    face_weight: torch.Tensor,
    component_weight: torch.Tensor,
) -> Losses:
    """Loss with a weight for each face [B,N] and each component [B,C] instead of means; weights of padding are 0."""
    deformation, singular_values, velocity = _differences(predicted, target, network, config)
    parts = (
        (deformation * face_weight).sum(),
        (singular_values * face_weight).sum(),
        (velocity * component_weight).sum(),
    )
    return summed(*parts, config)


def _differences(
    predicted: NormalisedOutput, target: NormalisedOutput, network: GarmentNetwork, config: LossConfig
) -> list[torch.Tensor]:
    """Absolute differences, summed for each face [B,N] (Psi), [B,N] (Sigma), and for each component [B,C] (q)."""
    parts = [(a.float() - b).abs() for a, b in zip(predicted, target, strict=True)]
    if config.units == "physical":
        scale = (network.psi_std, network.singular_value_std, network.q_std)
        parts = [part * s for part, s in zip(parts, scale, strict=True)]
    return [part.sum(dim=-1) for part in parts]


def summed(
    deformation: torch.Tensor, singular_values: torch.Tensor, velocity: torch.Tensor, config: LossConfig
) -> Losses:
    """The losses of three terms, with their weighted sum."""
    total = config.deformation * deformation + config.singular_values * singular_values + config.velocity * velocity
    return Losses(total, deformation, singular_values, velocity)
