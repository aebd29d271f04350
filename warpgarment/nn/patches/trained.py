"""A layer of faces in training on a CPU: `kernels/dense/trained/layer.py` as a function of autograd.

The scale g and shift s of the layer norm are part of the weights of the kernels, and their gradients follow from those:

    W' = W g,  b' = b + W s        dW = dW' g + db' s^T,   dg = sum_o W dW',   ds = W^T db',   db = db'
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from warpgarment.kernels.dense import products
from warpgarment.kernels.dense.trained import layer as kernels

from .fused import packed_weights
from .gathered import Gathered, Made, Packed, behind_norm

if TYPE_CHECKING:
    from .bags import Sums
    from .network import FaceLayer


def fits(layer: FaceLayer, faces: torch.Tensor, around: Sums | None) -> bool:
    """Whether the kernels can do this layer, on these faces and on this processor."""
    width, hidden = layer.expand.in_features, layer.expand.out_features
    if faces.device.type != "cpu" or faces.dtype != torch.float32 or torch.is_autocast_enabled("cpu"):
        return False
    if not torch.is_grad_enabled() or (layer.hears and around is None) or layer.expand.weight.dtype != torch.float32:
        return False
    fit = all(size % products.STEP == 0 and size <= products.WIDEST for size in (width, hidden))
    return fit and len(faces) > 0 and layer.activation is nn.functional.gelu and products.available()


def forward(layer: FaceLayer, faces: torch.Tensor, around: Sums | None) -> torch.Tensor:
    """`FaceLayer.forward` of faces [N,F]."""
    weights, gathered, token = weights_of(layer)
    heard = _around(around if layer.hears else None)
    result: torch.Tensor = _Layer.apply(faces, token, weights, gathered, heard)
    return result


def _parameters(layer: FaceLayer) -> list[torch.Tensor]:
    """The parameters in the order in which their gradients are found."""
    found = [layer.norm.weight, layer.norm.bias, layer.expand.bias, layer.contract.weight, layer.contract.bias]
    return [*found, layer.expand.weight, *([layer.hear.weight] if layer.hears else [])]


def _unfolded(parameters: list[torch.Tensor], sums: torch.Tensor) -> list[torch.Tensor]:
    """Gradients of the parameters from those of W', b', V and c."""
    scale, shift, _, contract, _, *parts = parameters
    (hidden, width), wide = parts[0].shape, len(parts) * parts[0].shape[1]
    slope, of_bias, of_contract, of_contract_bias = sums.split([hidden * wide, hidden, contract.numel(), width])
    found = [
        behind_norm(some, of_bias, scale, shift, part)
        for part, some in zip(parts, slope.view(hidden, wide).split(width, dim=1), strict=True)
    ]
    of_scale, of_shift = (sum(values) for values in zip(*(norm for norm, _, _ in found), strict=True))
    return [
        of_scale,
        of_shift,
        of_bias,
        of_contract.view(contract.shape),
        of_contract_bias,
        *(of for _, of, _ in found),
    ]


def _make(layer: FaceLayer, parameters: list[torch.Tensor]) -> Made[kernels.Weights]:
    scale, shift, bias, contract, contract_bias, *parts = parameters
    expand = torch.cat([part * scale for part in parts], dim=1)
    bias = bias + sum(part @ shift for part in parts)
    back = packed_weights(expand.T), packed_weights(contract.T)
    weights = kernels.Weights(packed_weights(expand), bias, packed_weights(contract), contract_bias, *back)
    size = kernels.sums_size(layer.expand.in_features, layer.expand.out_features, layer.hears)
    return Made(weights, size, functools.partial(_unfolded, parameters))


weights_of = Packed(_parameters, _make)


def _around(around: Sums | None) -> kernels.Around:
    if around is None:
        empty = torch.zeros(0, dtype=torch.int64)
        return kernels.Around(empty, empty, empty)
    return kernels.Around(around.forward.entry, around.back.start, around.back.entry)


class _Layer(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        faces: torch.Tensor,
        token: torch.Tensor,
        weights: kernels.Weights,
        gathered: Gathered,
        around: kernels.Around,
    ) -> torch.Tensor:
        result, found = kernels.layer(faces, weights, around)
        ctx.made, ctx.of_weights = (weights, gathered, around, found), token.requires_grad
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        weights, gathered, around, found = ctx.made
        ctx.made, of_token = None, None
        gradient = gradient.contiguous()
        of_faces, slopes = kernels.gradients(gradient, found, weights, around)
        if ctx.of_weights:
            sums, aside = gathered.sums()
            for call in kernels.outer(gradient, slopes, found, around, sums):
                aside.add(call)
            of_token = sums.new_zeros(())
        return of_faces, of_token, None, None, None
