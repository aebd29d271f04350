"""Layers of faces with the products of products.py: one launch for each layer, all between two products in it.

A thread works on a block of 32 faces of a row. With n(x) = (x - mean) / deviation, over the numbers of a face:

    embed      e = W (f - centre) + b                         f  features of all frames, W of this row or of all
    first      x = x + V gelu(W n(x) + b) + c
    spread     x = x + sum_k share_k heard[patch_k],  own = n(x)
    hear       x = x + V gelu(W [own, mean of own over three neighbours] + b) + c,  own' = n(x)
    head       answer = W own + b

The scale and shift of a layer norm belong to the W and b after it: see `warpgarment/nn/patches/fused.py`. Arrays of R
rows are padded to N faces. Those that describe garments may have one row, which then serves all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import launch_rows, torch_stream
from warpgarment.kernels.operator import allocate
from warpgarment.kernels.replay.recording import addresses

from .face_blocks import embed_block, first_block, head_block, hear_block, spread_block
from .products import BLOCK, argument

wp.set_module_options(compiling.options())
_ALONE = compiling.apart(f"{__name__}.alone")

LEAST = 16  # blocks that are worth another range of a launch
SHARES, SIDES = 4, 3  # patches of a face, and its neighbours


@wp.kernel(enable_backward=False)
def embed_kernel(
    from_row: wp.int32,
    count: wp.int32,
    channels: wp.int32,
    pitch: wp.int32,
    width: wp.int32,
    packs: wp.int32,
    # Model:
    centre: wp.array[wp.float32],
    weight: wp.array[wp.float32],
    bias: wp.array[wp.float32],
    # In:
    index: wp.array[wp.int64],
    frames: wp.array[wp.int64],
    # Out:
    result: wp.array[wp.float32],
):
    embed_block(from_row + wp.tid(), count, channels, pitch, width, packs, index, frames, centre, weight, bias, result)


@wp.kernel(enable_backward=False)
def first_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    hidden: wp.int32,
    # Model:
    expand: wp.array[wp.float32],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    contract_bias: wp.array[wp.float32],
    # In and out:
    faces: wp.array[wp.float32],
):
    first_block(from_row + wp.tid(), count, width, hidden, expand, expand_bias, contract, contract_bias, faces)


@wp.kernel(enable_backward=False)
def spread_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    patches: wp.int32,
    layouts: wp.int32,
    # Model:
    patch: wp.array[wp.int64],
    share: wp.array[wp.float32],
    # In:
    heard: wp.array[wp.float32],
    # In and out:
    faces: wp.array[wp.float32],
    # Out:
    own: wp.array[wp.float32],
):
    spread_block(from_row + wp.tid(), count, width, patches, layouts, patch, share, heard, faces, own)


@wp.kernel(enable_backward=False)
def hear_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    hidden: wp.int32,
    layouts: wp.int32,
    hears: wp.int32,
    outputs: wp.int32,
    # Model:
    side: wp.array[wp.int64],
    expand: wp.array[wp.float32],
    expand_bias: wp.array[wp.float32],
    contract: wp.array[wp.float32],
    contract_bias: wp.array[wp.float32],
    head: wp.array[wp.float32],
    head_bias: wp.array[wp.float32],
    # In:
    own: wp.array[wp.float32],
    # In and out:
    faces: wp.array[wp.float32],
    # Out:
    result: wp.array[wp.float32],
):
    hear_block(
        from_row + wp.tid(),
        count,
        width,
        hidden,
        layouts,
        hears,
        outputs,
        side,
        expand,
        expand_bias,
        contract,
        contract_bias,
        head,
        head_bias,
        own,
        faces,
        result,
    )


@wp.kernel(module=_ALONE, enable_backward=False)
def head_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    outputs: wp.int32,
    # Model:
    weight: wp.array[wp.float32],
    bias: wp.array[wp.float32],
    # In:
    own: wp.array[wp.float32],
    # Out:
    answer: wp.array[wp.float32],
):
    head_block(from_row + wp.tid(), count, width, outputs, weight, bias, own, answer)


class Perceptron(NamedTuple):
    """The weights of a layer, packed, with the norm before it folded in."""

    expand: torch.Tensor  # packed, of [H,F] or, for faces that hear their neighbours, [H,2F]
    expand_bias: torch.Tensor  # [H]
    contract: torch.Tensor  # packed, of [F,H]
    contract_bias: torch.Tensor  # [F]

    @property
    def arguments(self) -> list[object]:
        """Arguments of a launch."""
        return [argument(values) for values in self]


def _launch(kernel: wp.Kernel, faces: torch.Tensor, inputs: list[object], outputs: list[torch.Tensor]) -> None:
    """Launches a kernel over the blocks of faces [R,N,*]."""
    rows, count = faces.shape[:2]
    with torch_stream(faces.device) as device:
        launch_rows(
            kernel,
            rows * (-(-count // BLOCK)),
            [count, *inputs],
            [argument(values) for values in outputs],
            device,
            least=LEAST,
            even=True,
        )


def embed(
    frames: Sequence[torch.Tensor], index: torch.Tensor, centre: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor
) -> torch.Tensor:
    """The first layer.

    Args:
        frames: Features of packed faces in H frames, shape [M,K] each; side by side they are the I inputs.
        index: Which faces are those of each row, int64 [R,N]; -1 for padding, which is embedded as zeros.
        centre: What is subtracted from them, from `turned.turned`, shape [R,I'] or [1,I'].
        weight: Packed weights of the same rows.
        bias: Biases, shape [F].

    Returns:
        Embedded faces, shape [R,N,F].
    """
    pitch, channels = frames[-1].stride(0), frames[-1].shape[1]
    if any(frame.stride() != (pitch, 1) for frame in frames):
        frames, pitch = [frame.contiguous() for frame in frames], channels
    places = addresses(frames)
    result = allocate((*index.shape, len(bias)), torch.float32, index.device)
    sizes = [channels, pitch, len(bias), len(weight)]
    given = [argument(values) for values in (centre, weight, bias, index, places)]
    _launch(embed_kernel, index, [*sizes, *given], [result])
    return result


def first(faces: torch.Tensor, layer: Perceptron) -> None:
    """The layer before the patches, on faces [R,N,F], which are overwritten."""
    sizes = [faces.shape[2], len(layer.expand_bias)]
    _launch(first_kernel, faces, [*sizes, *layer.arguments], [faces])


def spread(faces: torch.Tensor, patch: torch.Tensor, share: torch.Tensor, heard: torch.Tensor) -> torch.Tensor:
    """Adds to faces what their patches have heard.

    Args:
        faces: Faces, shape [R,N,F]; overwritten.
        patch: Patches of each face, int64, shape [R,N,4] or [1,N,4].
        share: Share of the face in each, same shape.
        heard: Change of each patch, shape [R,P,F].

    Returns:
        The faces, normalised, shape [R,N,F].
    """
    own = allocate(faces.shape, faces.dtype, faces.device)
    sizes = [faces.shape[2], heard.shape[1], len(patch)]
    _launch(spread_kernel, faces, [*sizes, *(argument(values) for values in (patch, share, heard))], [faces, own])
    return own


class Head(NamedTuple):
    """The last layer."""

    weight: torch.Tensor  # packed, of [O,F]
    bias: torch.Tensor  # [O]


def hear(
    faces: torch.Tensor,
    own: torch.Tensor,
    neighbours: torch.Tensor | None,
    layer: Perceptron,
    result: torch.Tensor,
    last: Head | None = None,
) -> None:
    """A layer after the patches.

    Args:
        faces: Faces, shape [R,N,F]; overwritten, unless this is the last layer but one.
        own: The same, normalised.
        neighbours: Faces across the edges, int64, shape [R,N,3] or [1,N,3]; None for subsets, whose layer has no
            weights for neighbours.
        layer: The weights.
        result: Room for the new faces, normalised; other memory than `own`, which neighbours read. With `last`, for
            the outputs [R,N,O] instead.
        last: The layer after this one, if it is the last.
    """
    sides = torch.zeros((1, 1, SIDES), dtype=torch.int64) if neighbours is None else neighbours
    head = Head(layer.expand, layer.expand_bias) if last is None else last
    outputs = 0 if last is None else len(last.bias)
    sizes = [faces.shape[2], len(layer.expand_bias), len(sides), int(neighbours is not None), outputs]
    given = [argument(sides), *layer.arguments, argument(head.weight), argument(head.bias), argument(own)]
    _launch(hear_kernel, faces, [*sizes, *given], [faces, result])


def head(own: torch.Tensor, last: Head) -> torch.Tensor:
    """The last layer alone: normalised faces [R,N,F] -> [R,N,O]."""
    weight, bias = last
    answer = allocate((*own.shape[:2], len(bias)), own.dtype, own.device)
    _launch(head_kernel, own, [own.shape[2], len(bias), argument(weight), argument(bias), argument(own)], [answer])
    return answer
