"""The head of faces in training on a CPU: `kernels/dense/trained/head.py` as a function of autograd.

The scale and shift of the layer norm are part of the weights of the kernels, as in trained.py.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from warpgarment.kernels.dense import products
from warpgarment.kernels.dense.trained import head as kernels
from warpgarment.kernels.threads import torch_on_one

from . import changes
from .fused import folded
from .gathered import Gathered, behind_norm

if TYPE_CHECKING:
    from .network import PatchTransformer

Key = tuple[int, tuple[tuple[int, int, bool], ...]]
Known = tuple[Key, kernels.Weights, Gathered, torch.Tensor]
_known: WeakKeyDictionary[nn.Module, Known] = WeakKeyDictionary()


def fits(network: PatchTransformer, faces: torch.Tensor) -> bool:
    """Whether the kernels can do the head of this network, on faces [N,F] and on this processor."""
    if faces.device.type != "cpu" or faces.dtype != torch.float32 or torch.is_autocast_enabled("cpu"):
        return False
    if not torch.is_grad_enabled() or network.face_head.weight.dtype != torch.float32:
        return False
    return len(faces) > 0 and faces.shape[1] % products.STEP == 0 and products.available()


def forward(network: PatchTransformer, faces: torch.Tensor) -> torch.Tensor:
    """`face_head(face_norm(faces))` of faces [N,F]."""
    _, weights, gathered, token = _weights(network)
    result: torch.Tensor = _Head.apply(faces, token, weights, gathered)
    return result


def _weights(network: PatchTransformer) -> Known:
    """The weights of the kernels, and what gathers their gradients; made anew when one has changed."""
    norm, head = network.face_norm, network.face_head
    parameters = [norm.weight, norm.bias, head.weight, head.bias]
    versions = [(each.data_ptr(), changes.version(each), each.requires_grad) for each in parameters]
    key = changes.optimiser_steps(), tuple(versions)
    known = _known.get(network)
    if known is None or known[0] != key or known[2].asked:
        with torch.no_grad(), torch_on_one():
            weight, bias = folded(norm, head.weight, head.bias)
        fixed = [each.detach() for each in parameters[:3]]
        gathered = Gathered(weight.numel() + len(bias), functools.partial(_unfolded, fixed))
        known = key, kernels.Weights(weight, bias), gathered, gathered.token(parameters)
        _known[network] = known
    return known


def _unfolded(parameters: list[torch.Tensor], sums: torch.Tensor) -> list[torch.Tensor]:
    """Gradients of the parameters from those of the weights of the kernels."""
    scale, shift, weight = parameters
    slope, of_bias = sums.split([weight.numel(), len(weight)])
    norm, of_weight, of_bias = behind_norm(slope.view(weight.shape), of_bias, scale, shift, weight)
    return [*norm, of_weight, of_bias]


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
