"""The encoder on patches in training on a CPU: `kernels/dense/trained/encoder.py` as a function of autograd.

The scale g and shift s of a layer norm are part of the weights of the kernels, as in trained.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from warpgarment.kernels.dense import products
from warpgarment.kernels.dense.trained import encoder as kernels

from .fused import folded
from .gathered import Gathered, Made, Packed, behind_norm

if TYPE_CHECKING:
    from warpgarment.nn.attention import EncoderLayer

    from .layout import PatchLayout
    from .network import PatchTransformer


def fits(network: PatchTransformer, faces: torch.Tensor, layout: PatchLayout) -> bool:
    """Whether the kernels can do the encoder of this network, on faces [R,N,F] and on this processor."""
    config = network.config
    if faces.device.type != "cpu" or faces.dtype != torch.float32 or torch.is_autocast_enabled("cpu"):
        return False
    if not torch.is_grad_enabled() or network.to_patches.weight.dtype != torch.float32:
        return False
    head = config.embedding // config.heads
    widths = config.embedding, config.face_embedding, config.feed_forward, head
    fit = all(width % products.STEP == 0 for width in widths)
    plain = config.norm_first and config.activation == "gelu" and not (config.dropout and network.training)
    tokens = layout.start.shape[1] + layout.pieces.shape[1]
    return fit and plain and tokens <= kernels.MOST_TOKENS and products.available()


def forward(
    network: PatchTransformer,
    faces: torch.Tensor,
    given: torch.Tensor,
    layout: PatchLayout,
    mask: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """From faces after the first layer to what follows the encoder.

    Args:
        network: The network.
        faces: Faces [R,N,F].
        given: Embedded velocities [R,C,E].
        layout: Patches of R rows, or of one that serves all.
        mask: True where a token is real, shape [R,1,1,P+C]; None where all are.

    Returns:
        Faces with what they hear of the patches [R,N,F]; normalised velocities [R,C,3].
    """
    weights, gathered, token = _weights(network)
    real = None if mask is None else mask.flatten(1)
    pooled = layout.start, layout.member, layout.member_weight
    pools = kernels.Pools(*pooled, layout.patch, layout.share, layout.pieces, layout.weights, real)
    heard: tuple[torch.Tensor, torch.Tensor] = _Encoder.apply(faces, given, token, weights, gathered, pools)
    return heard


def _parameters(network: PatchTransformer) -> list[torch.Tensor]:
    """The parameters in the order in which their gradients are found."""
    found = []
    for layer in cast("list[EncoderLayer]", network.layers):
        attention, before, between = layer.attention, layer.attention_norm, layer.feed_forward_norm
        found += [before.weight, before.bias, attention.qkv.weight, attention.qkv.bias]
        found += [attention.out.weight, attention.out.bias]
        found += [between.weight, between.bias, layer.expand.weight, layer.expand.bias]
        found += [layer.contract.weight, layer.contract.bias]
    last = cast("nn.LayerNorm", network.final_norm)
    for linear in (network.from_patches, network.to_patches):
        found += [linear.weight, linear.bias]
    head = network.velocity_head
    return [*found, network.to_velocity.weight, last.weight, last.bias, head.weight, head.bias]


def _make(network: PatchTransformer, parameters: list[torch.Tensor]) -> Made[kernels.Weights]:
    weights, root = _pack(network)
    shape = _shape(network)
    return Made(weights, kernels.sums_of(shape).size, lambda sums: _unfolded(shape, parameters, root, sums))


def _shape(network: PatchTransformer) -> kernels.Shape:
    """The shape of an encoder with one token, for the lengths of its gradients."""
    config = network.config
    head = config.embedding // config.heads
    learned = config.embedding - config.manifold_heads * head
    widths = config.embedding, config.face_embedding, learned, config.feed_forward, head
    return kernels.Shape(2, 1, *widths, 1, config.layers, 1, 1, 1)


def _pack(network: PatchTransformer) -> tuple[kernels.Weights, torch.Tensor]:
    """The weights of the kernels, and the factors [Q] of the rows of queries, keys and values."""
    shape = _shape(network)
    root = torch.ones(shape.columns)
    root[: shape.learned] = shape.head**-0.5
    matrices, biases = [], []
    for layer in cast("list[EncoderLayer]", network.layers):
        qkv, out = layer.attention.qkv, layer.attention.out
        unused = len(qkv.weight) - shape.columns
        weight, bias = folded(layer.attention_norm, qkv.weight[unused:], qkv.bias[unused:])
        expand, expand_bias = folded(layer.feed_forward_norm, layer.expand.weight, layer.expand.bias)
        matrices += [weight * root[:, None], out.weight, expand, layer.contract.weight]
        biases += [bias * root, out.bias, expand_bias, layer.contract.bias]
    matrices += [network.from_patches.weight, network.to_patches.weight, network.to_velocity.weight]
    head, head_bias = folded(network.final_norm, network.velocity_head.weight, network.velocity_head.bias)
    biases += [network.from_patches.bias, network.to_patches.bias, head_bias]
    both = [part.flatten() for matrix in matrices for part in (matrix.T, matrix)]
    widths = shape.width, shape.learned, shape.head, shape.hidden
    return kernels.Weights(widths, shape.layers, torch.cat([*both, head.flatten()]), torch.cat(biases)), root


def _unfolded(
    shape: kernels.Shape, parameters: list[torch.Tensor], root: torch.Tensor, sums: torch.Tensor
) -> list[torch.Tensor]:
    """Gradients of the parameters from those of the weights of the kernels."""
    slopes: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
    at = 0
    for name, rows, columns, biased in kernels.sums_of(shape).lengths:
        end = at + rows * columns
        slopes[name] = sums[at:end].view(rows, columns), sums[end : end + rows * biased]
        at = end + rows * biased
    found: list[torch.Tensor] = []
    for n in range(shape.layers):
        scale, shift, qkv, _, _, _, between, offset, expand, *_ = parameters[12 * n :]
        unused = len(qkv) - len(root)
        slope, of_bias = slopes[f"keys{n}"]
        norm, weight, bias = behind_norm(slope * root[:, None], of_bias * root, scale, shift, qkv[unused:])
        nothing = nn.functional.pad(weight, (0, 0, unused, 0)), nn.functional.pad(bias, (unused, 0))
        found += [*norm, *nothing, *slopes[f"out{n}"]]
        norm, weight, bias = behind_norm(*slopes[f"expand{n}"], between, offset, expand)
        found += [*norm, weight, bias, *slopes[f"contract{n}"]]
    scale, shift, head, _ = parameters[-4:]
    norm, weight, bias = behind_norm(*slopes["velocity"], scale, shift, head)
    return [*found, *slopes["heard"], *slopes["pool"], slopes["lift"][0], *norm, weight, bias]


_weights = Packed(_parameters, _make)


class _Encoder(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        faces: torch.Tensor,
        given: torch.Tensor,
        token: torch.Tensor,
        weights: kernels.Weights,
        gathered: Gathered,
        pools: kernels.Pools,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        heard, velocity, found = kernels.forward(faces, given, weights, pools)
        ctx.made = weights, gathered, pools, found
        ctx.of_weights = token.requires_grad
        return heard, velocity

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor, of_velocity: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        weights, gathered, pools, found = ctx.made
        of_faces, of_given, slopes = kernels.gradients(gradient, of_velocity, found, weights, pools)
        of_token = None
        if ctx.of_weights:
            sums, aside = gathered.sums()
            aside.add(lambda: kernels.outer(found, slopes, sums))
            of_token = sums.new_zeros(())
        ctx.made = None
        return of_faces, of_given, of_token, None, None, None
