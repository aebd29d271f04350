"""A layer of faces on the products of products.py with its gradients, for training.

With n(x) = (x - mean) / deviation over the numbers of a face, and m the mean of n over three neighbours:

    y  = x + V gelu(h) + c,   h = W [n, m] + b
    dh = gelu'(h) * V^T dy,   dW = sum dh [n, m]^T,   db = sum dh,   dV = sum dy gelu(h)^T,   dc = sum dy
    dx = dy + n'(x)^T (the part of n in W^T dh, and a third of the part of m at each face that hears this one)

The scale and shift of the layer norm belong to W and b: see `warpgarment/nn/patches/trained.py`. Gradients of
weights are added up by calls of their own, since nothing that follows in a graph waits for them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.dense.products import BLOCK, argument
from warpgarment.kernels.launch import launch, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .layer_blocks import back_block, layer_block, norm_block, outer_faces, slope_block

wp.set_module_options(compiling.options())

LEAST = 16  # blocks that are worth another range of a launch
PART = 1024  # faces whose part of the gradients of weights is one call


@wp.kernel(enable_backward=False)
def norm_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    # In:
    faces: wp.array[wp.float32],
    # Out:
    own: wp.array[wp.float32],
    scale: wp.array[wp.float32],
):
    norm_block(from_row + wp.tid(), count, width, faces, own, scale)


@wp.kernel(enable_backward=False)
def layer_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    hidden: wp.int32,
    hears: wp.int32,
    # Model:
    side: wp.array[wp.int64],
    expand: wp.array[wp.float32],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    contract_bias: wp.array[wp.float32],
    # In:
    faces: wp.array[wp.float32],
    own: wp.array[wp.float32],
    # Out:
    inner: wp.array[wp.float32],
    result: wp.array[wp.float32],
):
    layer_block(
        from_row + wp.tid(),
        count,
        width,
        hidden,
        hears,
        side,
        expand,
        expand_bias,
        contract,
        contract_bias,
        faces,
        own,
        inner,
        result,
    )


@wp.kernel(enable_backward=False)
def slope_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    hidden: wp.int32,
    hears: wp.int32,
    # Model:
    expand: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    # In:
    inner: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    # Out:
    slopes: wp.array[wp.float32],
    heard: wp.array[wp.float32],
):
    slope_block(from_row + wp.tid(), count, width, hidden, hears, expand, contract, inner, gradient, slopes, heard)


@wp.kernel(enable_backward=False)
def outer_kernel(
    begin: wp.int32,
    end: wp.int32,
    width: wp.int32,
    hidden: wp.int32,
    hears: wp.int32,
    # Model:
    side: wp.array[wp.int64],
    # In:
    own: wp.array[wp.float32],
    inner: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    slopes: wp.array[wp.float32],
    # In and out:
    sums: wp.array[wp.float32],
):
    outer_faces(begin, end, width, hidden, hears, side, own, inner, gradient, slopes, sums)


@wp.kernel(enable_backward=False)
def back_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    hears: wp.int32,
    # Model:
    start: wp.array[wp.int64],
    owner: wp.array[wp.int64],
    # In:
    own: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    heard: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    # Out:
    result: wp.array[wp.float32],
):
    back_block(from_row + wp.tid(), count, width, hears, start, owner, own, scale, heard, gradient, result)


class Around(NamedTuple):
    """Who hears whom among N faces; empty arrays for a layer that hears no neighbours."""

    side: torch.Tensor  # int64 [3 N], the neighbours of each face
    start: torch.Tensor  # int64 [N], where the faces that hear a face begin in `owner`
    owner: torch.Tensor  # int64 [3 N]


class Weights(NamedTuple):
    """Weights with the norm folded in; packed are those of `products.pack`."""

    expand: torch.Tensor  # packed, of W [H,I] with I = F, or 2 F for faces that hear their neighbours
    expand_bias: torch.Tensor  # [H]
    contract: torch.Tensor  # packed, of V [F,H]
    contract_bias: torch.Tensor  # [F]
    expand_back: torch.Tensor  # packed, of W^T
    contract_back: torch.Tensor  # packed, of V^T


class Found(NamedTuple):
    """What the gradient needs of the layer."""

    own: torch.Tensor  # n [N,F]
    scale: torch.Tensor  # [N], one over the deviation
    inner: torch.Tensor  # h [N,H]


def layer(faces: torch.Tensor, weights: Weights, around: Around) -> tuple[torch.Tensor, Found]:
    """The layer on faces [N,F], end to end; returns new faces [N,F], and what `gradients` needs."""
    faces = faces.contiguous()
    count, width = faces.shape
    hidden, hears = len(weights.expand_bias), int(len(around.side) > 0)
    own, result = (allocate(faces.shape, torch.float32, faces.device) for _ in range(2))
    scale, inner = (allocate(shape, torch.float32, faces.device) for shape in ((count,), (count, hidden)))
    read = argument(faces)
    model = [argument(values) for values in (around.side, *weights[:4])]
    blocks = -(-count // BLOCK)
    with torch_stream(faces.device) as device:
        launch_rows(norm_kernel, blocks, [count, width, read], [argument(own), argument(scale)], device, least=LEAST)
        sizes = [count, width, hidden, hears]
        written = [argument(inner), argument(result)]
        launch_rows(layer_kernel, blocks, [*sizes, *model, read, argument(own)], written, device, least=LEAST)
    return result, Found(own, scale, inner)


def gradients(
    gradient: torch.Tensor, found: Found, weights: Weights, around: Around
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradients of faces [N,F] and of h [N,H] from that of the result, contiguous [N,F]."""
    count, width = gradient.shape
    hidden, hears = found.inner.shape[1], int(len(around.side) > 0)
    blocks = -(-count // BLOCK)
    heard = allocate((count, (1 + hears) * width), torch.float32, gradient.device)
    slopes = allocate(found.inner.shape, torch.float32, gradient.device)
    result = allocate(gradient.shape, torch.float32, gradient.device)
    own, given, read = argument(found.own), argument(gradient), argument(heard)
    with torch_stream(gradient.device) as device:
        model = [argument(weights.expand_back), argument(weights.contract_back)]
        inputs = [count, width, hidden, hears, *model, argument(found.inner), given]
        launch_rows(slope_kernel, blocks, inputs, [argument(slopes), read], device, least=LEAST)
        inputs = [count, width, hears, argument(around.start), argument(around.owner), own, argument(found.scale)]
        launch_rows(back_kernel, blocks, [*inputs, read, given], [argument(result)], device, least=LEAST)
    return result, slopes


def sums_size(width: int, hidden: int, hears: bool) -> int:
    """Number of entries of the gradients of W, b, V and c, which follow one another."""
    return hidden * (1 + hears) * width + hidden + width * hidden + width


def outer(
    gradient: torch.Tensor, slopes: torch.Tensor, found: Found, around: Around, sums: torch.Tensor
) -> list[Callable[[], None]]:
    """Calls that add the gradients of weights to `sums` [`sums_size`], of which no two may run at the same time."""
    count, width = gradient.shape
    hidden, hears = slopes.shape[1], int(len(around.side) > 0)

    def some(begin: int, end: int) -> None:
        read = [argument(values) for values in (around.side, found.own, found.inner, gradient, slopes, sums)]
        with torch_stream(gradient.device) as device:
            launch(outer_kernel, 1, [begin, end, width, hidden, hears, *read], device)

    return [functools.partial(some, begin, min(begin + PART, count)) for begin in range(0, count, PART)]
