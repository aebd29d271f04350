"""The head of faces in training on a CPU: `kernels/dense/trained/head.py` as a function of autograd.

The scale and shift of the layer norm are part of the weights of the kernels, as in trained.py.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

from warpgarment.kernels.dense import products
from warpgarment.kernels.dense.trained import head as kernels

from .fused import folded
from .gathered import Gathered, Made, Packed, behind_norm

if TYPE_CHECKING:
    from .network import PatchTransformer


def fits(network: PatchTransformer, faces: torch.Tensor) -> bool:
    """Whether the kernels can do the head of this network, on faces [N,F] and on this processor."""
    if faces.device.type != "cpu" or faces.dtype != torch.float32 or torch.is_autocast_enabled("cpu"):
        return False
    if not torch.is_grad_enabled() or network.face_head.weight.dtype != torch.float32:
        return False
    return len(faces) > 0 and faces.shape[1] % products.STEP == 0 and products.available()


def forward(network: PatchTransformer, faces: torch.Tensor) -> torch.Tensor:
    """`face_head(face_norm(faces))` of faces [N,F]."""
    weights, gathered, token = _weights(network)
    result: torch.Tensor = _Head.apply(faces, token, weights, gathered)
    return result


def _parameters(network: PatchTransformer) -> list[torch.Tensor]:
    """The parameters in the order in which their gradients are found."""
    norm, head = network.face_norm, network.face_head
    return [norm.weight, norm.bias, head.weight, head.bias]


def _make(network: PatchTransformer, parameters: list[torch.Tensor]) -> Made[kernels.Weights]:
    weight, bias = folded(network.face_norm, *parameters[2:])
    return Made(kernels.Weights(weight, bias), weight.numel() + len(bias), functools.partial(_unfolded, parameters[:3]))


def _unfolded(parameters: list[torch.Tensor], sums: torch.Tensor) -> list[torch.Tensor]:
    """Gradients of the parameters from those of the weights of the kernels."""
    scale, shift, weight = parameters
    slope, of_bias = sums.split([weight.numel(), len(weight)])
    norm, of_weight, of_bias = behind_norm(slope.view(weight.shape), of_bias, scale, shift, weight)
    return [*norm, of_weight, of_bias]


_weights = Packed(_parameters, _make)


class _Head(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, faces: torch.Tensor, token: torch.Tensor, weights: kernels.Weights, gathered: Gathered
    ) -> torch.Tensor:
        result, found = kernels.head(faces, weights)
        ctx.made, ctx.of_weights = (weights, gathered, found), token.requires_grad
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        weights, gathered, found = ctx.made
        ctx.made, of_token = None, None
        gradient = gradient.contiguous()
        of_faces = kernels.gradients(gradient, found, weights)
        if ctx.of_weights:
            sums, aside = gathered.sums()
            for call in kernels.outer(gradient, found, sums):
                aside.add(call)
            of_token = sums.new_zeros(())
        return of_faces, of_token, None, None
