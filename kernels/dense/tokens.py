"""The encoder layers of patches on the products of products.py: pooling, attention and feed-forward in one launch each.

A thread works on a block of 32 tokens of a row. A row has P patches and C velocities, T = P + C tokens x [T,E]:

    pool       y_p = sum of weight_m faces_m over the members m of patch p,  x_p = W y_p + b
    stage 0    x_(P+c) = given_c + W_v sum_p pieces_cp y_p;  queries, keys and values of layer 1 from n(x)
    stage l    x = x + W_o [softmax(q k^T) v, A v] + b_o          A  geodesic weights; a velocity keeps its own v
               x = x + V gelu(W n(x) + b) + c;  queries, keys and values of layer l + 1 from n(x)
    last       heard_p = W_h (x_p - x_p at the start) + b_h,  velocity_c = W_q n(x_(P+c)) + b_q

The first `learned` columns of the values belong to heads that compare, and queries hold the root of their width. The
scale and shift of a layer norm belong to the layer after it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .products import BLOCK, argument
from .token_blocks import pool_block, stage_block

wp.set_module_options(compiling.options())

MOST_TOKENS = 1024  # for which a block has room
MOST_COLUMNS = 512  # of queries, keys and values together


@wp.kernel(enable_backward=False)
def pool_kernel(
    from_row: wp.int32,
    sizes: wp.array[wp.int32],
    count: wp.int32,
    members: wp.int32,
    # Model:
    start: wp.array[wp.int64],
    member: wp.array[wp.int64],
    weight: wp.array[wp.float32],
    packed: wp.array[wp.float32],
    bias: wp.array[wp.float32],
    # In:
    faces: wp.array[wp.float32],
    # Out:
    room: wp.array[wp.float32],
):
    pool_block(from_row + wp.tid(), sizes, count, members, start, member, weight, packed, bias, faces, room)


@wp.kernel(enable_backward=False)
def stage_kernel(
    from_row: wp.int32,
    stage: wp.int32,
    masks: wp.int32,
    sizes: wp.array[wp.int32],
    # Model:
    pieces: wp.array[wp.float32],
    geodesic: wp.array[wp.float32],
    mask: wp.array[wp.uint8],
    weights: wp.array[wp.float32],
    biases: wp.array[wp.float32],
    # In:
    given: wp.array[wp.float32],
    # In and out:
    room: wp.array[wp.float32],
    # Out:
    heard: wp.array[wp.float32],
    velocity: wp.array[wp.float32],
):
    stage_block(
        from_row + wp.tid(),
        stage,
        masks,
        sizes,
        pieces,
        geodesic,
        mask,
        weights,
        biases,
        given,
        room,
        heard,
        velocity,
    )


class Encoder(NamedTuple):
    """The weights of the encoder layers and of the layers around them."""

    width: int  # E
    learned: int  # columns of heads that compare
    head: int  # D, columns of a head
    hidden: int  # H
    layers: int
    pool: torch.Tensor  # packed, of [E,F]
    pool_bias: torch.Tensor  # [E]
    weights: (
        torch.Tensor
    )  # of `pack_inner`: each layer's queries, keys, values; out; expand; contract. Of `pack`: heard [F,E]
    biases: torch.Tensor  # of the same; of the velocity head, [3]; its weights [3,E]; weights W_v [E,F]


class Pools(NamedTuple):
    """How faces are pooled into patches; arrays have R rows or one that serves all."""

    start: torch.Tensor  # int64 [R,P]
    member: torch.Tensor  # int64 [R,M]
    weight: torch.Tensor  # [R,M]
    pieces: torch.Tensor  # [R,C,P]
    geodesic: torch.Tensor  # [R,P,P]


def encode(
    encoder: Encoder, faces: torch.Tensor, given: torch.Tensor, pools: Pools, mask: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Runs the encoder on patches and velocities.

    Args:
        encoder: The weights.
        faces: Faces, shape [R,N,F].
        given: Embedded velocities, shape [R,C,E].
        pools: The patches.
        mask: True where a token is real, shape [R,T]; None where all are.

    Returns:
        Change of each patch, as faces hear it, shape [R,P,F]; normalised velocities [R,C,3].

    Raises:
        ValueError: There are too many tokens, or not as many velocities as pieces.
    """
    rows, count, width = faces.shape
    patches, members = pools.start.shape[1], pools.member.shape[1]
    tokens = patches + given.shape[1]
    if tokens > MOST_TOKENS or pools.pieces.shape[1] != given.shape[1]:
        raise ValueError(
            f"{given.shape[1]} velocities for {pools.pieces.shape[1]} pieces, {tokens} tokens; at most {MOST_TOKENS}"
        )
    whole = -(-tokens // BLOCK) * BLOCK
    columns = 2 * encoder.learned + encoder.width
    room = allocate((rows, whole * (2 * encoder.width + width + 2 * columns)), torch.float32, faces.device)
    heard = allocate((rows, patches, width), torch.float32, faces.device)
    velocity = allocate((rows, given.shape[1], 3), torch.float32, faces.device)
    shape = [tokens, patches, encoder.width, width, encoder.learned, encoder.hidden, encoder.head, len(pools.start)]
    sizes = torch.tensor([*shape, encoder.layers], dtype=torch.int32)
    real = torch.zeros(1, dtype=torch.uint8) if mask is None else mask.contiguous().view(torch.uint8)
    given = given.contiguous()
    model = [pools.start, pools.member, pools.weight, encoder.pool, encoder.pool_bias, faces]
    stages = [pools.pieces, pools.geodesic, real, encoder.weights, encoder.biases, given, room]
    arguments, out = [argument(values) for values in stages], [argument(heard), argument(velocity)]
    with torch_stream(faces.device) as device:
        pooled = [argument(sizes), count, members, *(argument(values) for values in model)]
        launch_rows(pool_kernel, rows * -(-patches // BLOCK), pooled, [argument(room)], device, least=2)
        for stage in range(encoder.layers + 1):
            given_to = [stage, int(mask is not None), argument(sizes), *arguments]
            launch_rows(stage_kernel, rows * (whole // BLOCK), given_to, out, device, least=2)
    return heard, velocity
