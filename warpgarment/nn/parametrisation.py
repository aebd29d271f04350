"""The map between the output of the network and the step (Psi, Sigma, q) of section 4.1.

The setting `residual` of the network chooses one of two maps. Both can express every step:

    False (the paper)    Psi, Sigma and q are the output
    True                 Psi   = Psi_out R_i            R_i  rotation of the deformation of face i's nearest body face
                         Sigma = Sigma_out               (not relative: stretch must not accumulate)
                         q     = q_out + u_c             u_c  mean velocity of the body faces nearest to component c

So a residual output of identity and q = 0, which an untrained residual network gives, means that the garment moves like
skin. Its stretch is then the mean of the statistics, which is 1 before training.

`compose` and `targets` are inverses of each other, and work on padded [B,N,...] and packed [F,...] arrays alike.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from warpgarment.kernels.deformation.replaced import rotation
from warpgarment.kernels.features.channels import FEATURES, LAYOUT


class NetworkOutput(NamedTuple):
    """Output of the network, or its training target, in physical units and before `compose`."""

    psi: torch.Tensor  # [..., N,3,3]
    singular_values: torch.Tensor  # [..., N,3]
    velocity: torch.Tensor  # [..., C,3] metres per frame


class Step(NamedTuple):
    """The step from frame t to t+1, which does not depend on the parametrisation."""

    psi: torch.Tensor  # relative deformation gradient, [..., N,3,3]
    singular_values: torch.Tensor  # singular values of the next deformation gradient, [..., N,3]
    velocity: torch.Tensor  # velocity of the mean face centroid of each component, [..., C,3], metres per frame


class StepContext(NamedTuple):
    """The quantities of the newest frame that the residual parametrisation refers to."""

    body_rotation: torch.Tensor  # R_i, [..., N,3,3]
    body_velocity: torch.Tensor  # u_c, [..., C,3] metres per frame


def component_mean(
    values: torch.Tensor, face_component: torch.Tensor, count: int, face_mask: torch.Tensor | None = None
) -> torch.Tensor:
    """Mean over the faces of each component.

    Args:
        values: Values of the faces, shape [...,N,K].
        face_component: Component of each face, integer, shape [...,N].
        count: Number of components C, in a padded batch the largest one.
        face_mask: True where a face is real, shape [...,N]; None where all are.

    Returns:
        Means, shape [...,C,K]; zero for a component without faces.
    """
    index = face_component.long()
    if face_mask is not None:
        values = torch.where(face_mask[..., None], values, 0.0)
        index = torch.where(face_mask, index, 0)
        ones = face_mask.to(values.dtype)
    else:
        ones = torch.ones_like(values[..., 0])
    shape = (*values.shape[:-2], count)
    sums = values.new_zeros((*shape, values.shape[-1]))
    sums = sums.scatter_add(-2, index[..., None].expand_as(values), values)
    faces = values.new_zeros(shape).scatter_add(-1, index, ones)
    return sums / faces.clamp(min=1.0)[..., None]


def context(
    face_features: torch.Tensor, face_component: torch.Tensor, count: int, face_mask: torch.Tensor | None = None
) -> StepContext:
    """Reads the context from the newest frame of the features.

    Args:
        face_features: Features in world space, shape [...,N,34] or stacked [...,N,H*34] with the newest last.
        face_component: Component of each face, integer, shape [...,N].
        count: Number of components C.
        face_mask: True where a face is real, shape [...,N]; None where all are.

    Returns:
        The context, without gradients: the motion of the nearest body faces is a constant of features.
    """
    newest = face_features[..., -FEATURES:].detach()
    deformation = newest[..., LAYOUT["body_deformation"]]
    if face_mask is not None:  # a padded zero matrix has no rotation
        deformation = torch.where(face_mask[..., None], deformation, torch.eye(3, device=deformation.device).flatten())
    shape = deformation.shape[:-1]
    body_rotation = rotation(deformation.reshape(-1, 3, 3).contiguous()).reshape(*shape, 3, 3)
    velocity = component_mean(newest[..., LAYOUT["body_velocity"]], face_component, count, face_mask)
    return StepContext(body_rotation, velocity)


def compose(output: NetworkOutput, context: StepContext, *, residual: bool) -> Step:
    """The step that an output of the network stands for.

    Args:
        output: Output in physical units and world space.
        context: Context of the newest frame, in world space.
        residual: The network's setting.

    Returns:
        The step. Its singular values are those predicted, which need not be positive or sorted.
    """
    if not residual:
        return Step(*output)
    return Step(
        output.psi @ context.body_rotation,
        output.singular_values,
        output.velocity + context.body_velocity,
    )


def targets(step: Step, context: StepContext, *, residual: bool) -> NetworkOutput:
    """The network output that stands for a step: the inverse of `compose`, with the same `context` and `residual`."""
    if not residual:
        return NetworkOutput(*step)
    return NetworkOutput(
        step.psi @ context.body_rotation.mT,
        step.singular_values,
        step.velocity - context.body_velocity,
    )
