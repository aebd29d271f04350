"""A layer of faces in training on a CPU: `kernels/dense/trained.py` as a function of autograd.

The scale g and shift s of the layer norm are part of the weights of the kernels, and their gradients follow from those:

    W' = W g,  b' = b + W s        dW = dW' g + db' s^T,   dg = sum_o W dW',   ds = W^T db',   db = db'
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from warpgarment.kernels.dense import products, trained

from . import changes
from .fused import packed_weights

if TYPE_CHECKING:
    from .bags import Sums
    from .network import FaceLayer

Key = tuple[int, tuple[tuple[int, int], ...]]
_packed: WeakKeyDictionary[nn.Module, tuple[Key, trained.Weights]] = WeakKeyDictionary()


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
    hear = [layer.hear.weight] if layer.hears else []
    given = [layer.norm.weight, layer.norm.bias, layer.expand.weight, layer.expand.bias]
    result: torch.Tensor = _Layer.apply(
        faces, layer, around if layer.hears else None, *given, layer.contract.weight, layer.contract.bias, *hear
    )
    return result


def weights_of(layer: FaceLayer) -> trained.Weights:
    """The packed weights of a layer, made anew when one has changed."""
    versions = [(parameter.data_ptr(), changes.version(parameter)) for parameter in layer.parameters()]
    key = changes.optimiser_steps(), tuple(versions)
    known = _packed.get(layer)
    if known is None or known[0] != key:
        known = key, _pack(layer)
        _packed[layer] = known
    return known[1]


@torch.no_grad()
def _pack(layer: FaceLayer) -> trained.Weights:
    parts = [layer.expand.weight, *([layer.hear.weight] if layer.hears else [])]
    expand = torch.cat([part * layer.norm.weight for part in parts], dim=1)
    bias = layer.expand.bias + sum(part @ layer.norm.bias for part in parts)
    contract = layer.contract.weight
    back = packed_weights(expand.T), packed_weights(contract.T)
    return trained.Weights(packed_weights(expand), bias, packed_weights(contract), layer.contract.bias.detach(), *back)


def _around(around: Sums | None) -> trained.Around:
    if around is None:
        empty = torch.zeros(0, dtype=torch.int64)
        return trained.Around(empty, empty, empty)
    return trained.Around(around.forward.entry, around.back.start, around.back.entry)


class _Layer(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, faces: torch.Tensor, layer: FaceLayer, around: Sums | None, *given: torch.Tensor) -> Any:
        ctx.weights, ctx.around = weights_of(layer), _around(around)
        result, found = trained.layer(faces, ctx.weights, ctx.around)
        ctx.save_for_backward(*given)
        ctx.found = found
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        scale, shift, weight, _bias, _contract, _contract_bias, *hear = ctx.saved_tensors
        found = trained.gradients(gradient, ctx.found, ctx.weights, ctx.around)
        ctx.found = None
        parts = [weight, *hear]
        of_scale, of_shift, of_parts = torch.zeros_like(scale), torch.zeros_like(shift), []
        shifted = torch.outer(found.expand_bias, shift)
        for part, slope in zip(parts, found.expand.split(weight.shape[1], dim=1), strict=True):
            of_parts.append(torch.addcmul(shifted, slope, scale))
            of_scale += (part * slope).sum(dim=0)
            of_shift += found.expand_bias @ part
        of_contract = found.contract, found.contract_bias
        return (
            found.faces, None, None, of_scale, of_shift, of_parts[0], found.expand_bias, *of_contract, *of_parts[1:]
        )  # fmt: skip
