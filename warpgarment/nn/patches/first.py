"""The first layer of the network of patches in training: turn, mirror and normalisation are part of its weights.

    W ((S T f - mean) / std) + b = (W / std) S T f + (b - (W / std) mean)

f are the features of a frame in world space; T turns them, S are the signs of a mirror. So the features of all frames
are read once, and only the newest ones, which gradients flow to, get a gradient.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd.function import once_differentiable

from warpgarment.kernels.features.channels import FACE
from warpgarment.kernels.threads import spread
from warpgarment.nn.inputs import RowInputs

from . import blocks

if TYPE_CHECKING:
    from .network import PatchTransformer


class _Embed(torch.autograd.Function):
    """Rows [R,N,I] times weights [R,O,I], plus biases [O]; `live` are the last of I as tensors with gradients."""

    @staticmethod
    def forward(
        ctx: Any, rows: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, *live: torch.Tensor
    ) -> torch.Tensor:
        ctx.save_for_backward(weight)
        ctx.rows = rows  # not as a tensor that must not change: frames after these may be written beside them
        ctx.widths = [frame.shape[-1] for frame in live]
        if _spread(rows):
            return blocks.linear(rows, weight, bias)
        if len(weight) == 1:
            return torch.nn.functional.linear(rows, weight[0], bias)
        return torch.baddbmm(bias, rows, weight.mT)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (weight,), rows = ctx.saved_tensors, ctx.rows
        last = weight[..., weight.shape[-1] - sum(ctx.widths) :]
        if _spread(rows):
            of_weight, found = _by_blocks(gradient, rows, weight, last)
        else:
            of_weight, found = torch.bmm(gradient.mT, rows), torch.bmm(gradient, last)
        return None, of_weight, gradient.sum(dim=(0, 1)), *found.split(ctx.widths, dim=-1)


def _spread(rows: torch.Tensor) -> bool:
    """Whether the products of these rows are shared among threads here."""
    return rows.device.type == "cpu" and rows.dtype == torch.float32 and not torch.is_autocast_enabled("cpu")


def _by_blocks(
    gradient: torch.Tensor, rows: torch.Tensor, weight: torch.Tensor, last: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The products of the gradient on several threads: with the rows [R,O,I], and with the last weights [R,N,K]."""
    of_weight = torch.empty((len(rows), *weight.shape[1:]))
    found = torch.empty((*rows.shape[:2], last.shape[-1]))
    calls = []
    for r, slope in enumerate(gradient):
        for some in torch.arange(slope.shape[1]).tensor_split(2):
            a, b = int(some[0]), int(some[-1]) + 1
            calls.append(partial(torch.mm, slope[:, a:b].T, rows[r], out=of_weight[r, a:b]))
        for a, b in blocks.ranges(len(slope)) if last.shape[-1] else ():
            calls.append(partial(torch.mm, slope[a:b], last[r % len(last)], out=found[r, a:b]))
    spread(calls)
    return of_weight, found


def embedded(network: PatchTransformer, inputs: RowInputs, turn: torch.Tensor | None) -> torch.Tensor:
    """The first layer of rows that are turned and mirrored, without the outdoor channels, [R,N,F].

    Args:
        network: The network.
        inputs: The rows, in world space.
        turn: Rotation to the network's frame, shape [R,3,3]; None for no rotation.
    """
    layout, rows = network.channels, len(inputs.features)
    weight = network.embed_faces.weight
    weight = weight[:, : weight.shape[1] - network.outdoor.width].unflatten(1, (-1, layout.width))
    scaled = weight / network.feature_std  # [F,H,K]
    bias = network.embed_faces.bias - scaled.sum(dim=1) @ network.feature_mean
    if turn is None:
        turn = torch.eye(3, dtype=weight.dtype, device=weight.device).expand(rows, 3, 3)
    turned = layout.turn(turn, inputs.rest_turn)
    if inputs.mirrored is not None:
        signs = layout.mirror(weight.device)
        turned = turned * torch.where(inputs.mirrored[:, None], signs, torch.ones_like(signs))[..., None]
    own = torch.einsum("ehi,bij->behj", scaled, turned).flatten(2)
    live, mask = [FACE.take(frame, layout.names) for frame in inputs.live], inputs.face_mask
    read = network.read(inputs.features)
    if mask is not None:
        live = [torch.where(mask[..., None], frame, 0.0) for frame in live]
        read = torch.where(mask[..., None], read, 0.0)
    if inputs.features.requires_grad and not inputs.live:
        live = [read]
    result: torch.Tensor = _Embed.apply(read, own, bias, *live)
    return result
