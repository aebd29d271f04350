"""The encoder on patches with its gradients, for training: from faces to what they hear of the patches.

    y_p = sum_m weight_m faces_m,  x_p = W y_p + b,  x_(P+c) = given_c + W_v sum_p pieces_cp y_p
    x = x + W_o [softmax(q k^T) v, A v] + b_o,  x = x + V gelu(W n(x) + b) + c         in each layer, q k v from n(x)
    faces_f = faces_f + sum_k share_fk heard_(patch_fk),  heard = W_h (x - x at the start) + b_h
    velocity_c = W_q n(x_(P+c)) + b_q

as in tokens.py, whose symbols these are. One thread does a row, forward or back, so that it waits for no other. The
gradients of weights are sums over tokens of outer products; `outer` adds them up afterwards, for all rows of a call.
The scale and shift of a layer norm belong to the layer after it.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.dense.products import BLOCK, argument
from warpgarment.kernels.launch import launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .encoder_blocks import encoder_row, gradient_row, outer_part

wp.set_module_options(compiling.options())

MOST_TOKENS = 1024
PART = 32  # rows of a gradient that one thread adds up
VELOCITY = 16  # distance of the gradients of velocities in memory


@wp.kernel(enable_backward=False)
def encoder_kernel(
    from_row: wp.int32,
    masks: wp.int32,
    sizes: wp.array[wp.int32],
    # Model:
    start: wp.array[wp.int64],
    member: wp.array[wp.int64],
    member_weight: wp.array[wp.float32],
    patch: wp.array[wp.int64],
    share: wp.array[wp.float32],
    pieces: wp.array[wp.float32],
    geodesic: wp.array[wp.float32],
    mask: wp.array[wp.uint8],
    weights: wp.array[wp.float32],
    biases: wp.array[wp.float32],
    # In:
    faces: wp.array[wp.float32],
    given: wp.array[wp.float32],
    # Out:
    room: wp.array[wp.float32],
    kept: wp.array[wp.float32],
    heard: wp.array[wp.float32],
    velocity: wp.array[wp.float32],
):
    encoder_row(
        from_row + wp.tid(),
        masks,
        sizes,
        start,
        member,
        member_weight,
        patch,
        share,
        pieces,
        geodesic,
        mask,
        weights,
        biases,
        faces,
        given,
        room,
        kept,
        heard,
        velocity,
    )


@wp.kernel(enable_backward=False)
def gradient_kernel(
    from_row: wp.int32,
    sizes: wp.array[wp.int32],
    # Model:
    start: wp.array[wp.int64],
    member: wp.array[wp.int64],
    member_weight: wp.array[wp.float32],
    patch: wp.array[wp.int64],
    share: wp.array[wp.float32],
    pieces: wp.array[wp.float32],
    geodesic: wp.array[wp.float32],
    weights: wp.array[wp.float32],
    biases: wp.array[wp.float32],
    # In:
    kept: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    of_velocity: wp.array[wp.float32],
    # Out:
    room: wp.array[wp.float32],
    found: wp.array[wp.float32],
    of_faces: wp.array[wp.float32],
    of_given: wp.array[wp.float32],
):
    gradient_row(
        from_row + wp.tid(),
        sizes,
        start,
        member,
        member_weight,
        patch,
        share,
        pieces,
        geodesic,
        weights,
        biases,
        kept,
        gradient,
        of_velocity,
        room,
        found,
        of_faces,
        of_given,
    )


@wp.kernel(enable_backward=False)
def outer_kernel(
    from_row: wp.int32,
    rows: wp.int32,
    found_length: wp.int32,
    kept_length: wp.int32,
    # In:
    table: wp.array[wp.int32],
    found: wp.array[wp.float32],
    kept: wp.array[wp.float32],
    # In and out:
    sums: wp.array[wp.float32],
):
    outer_part(from_row + wp.tid(), rows, found_length, kept_length, table, found, kept, sums)


class Shape(NamedTuple):
    """Widths of an encoder and numbers of what a row has."""

    tokens: int  # T
    patches: int  # P
    width: int  # E
    faces_width: int  # F
    learned: int  # L, columns of heads that compare
    hidden: int  # H
    head: int  # D, columns of a head
    layouts: int  # rows of the arrays of `Pools`
    layers: int
    faces: int  # N
    members: int
    shares: int

    @property
    def whole(self) -> int:
        """Tokens of whole blocks."""
        return -(-self.tokens // BLOCK) * BLOCK

    @property
    def columns(self) -> int:
        """Q, of queries, keys and values."""
        return 2 * self.learned + self.width


class Pools(NamedTuple):
    """How faces are pooled into patches and hear them; arrays have R rows or one that serves all."""

    start: torch.Tensor  # int64 [R,P]
    member: torch.Tensor  # int64 [R,M]
    weight: torch.Tensor  # [R,M]
    patch: torch.Tensor  # int64 [R,N,K]
    share: torch.Tensor  # [R,N,K]
    pieces: torch.Tensor  # [R,C,P]
    geodesic: torch.Tensor  # [R,P,P]
    mask: torch.Tensor | None  # True where a token is real, shape [R,T]; None where all are


class Weights(NamedTuple):
    """Weights of the encoder with the norms folded in, in one dimension.

    Each matrix [O,I] is there as its transpose and then as it is. Layers come first: queries, keys and values (queries
    hold the root of their width), out, expand, contract; then W_h, W, W_v, and of the velocity head [3,E] as it is.
    """

    widths: tuple[int, int, int, int]  # E, L, D, H
    layers: int
    weights: torch.Tensor
    biases: torch.Tensor  # of the same in their order, without W_v


class Found(NamedTuple):
    """What the gradient needs of the encoder."""

    shape: Shape
    rows: int
    kept: torch.Tensor


def places(shape: Shape) -> tuple[dict[str, int], int]:
    """Where the forward pass keeps arrays of a row, and their length; those of layer l end with l."""
    t, p, c, e, f, h = (
        shape.tokens,
        shape.patches,
        shape.tokens - shape.patches,
        shape.width,
        shape.faces_width,
        shape.hidden,
    )
    sizes = {"pooled": p * f, "means": c * f, "change": p * e, "last": c * e, "last_scale": c}
    for layer in range(shape.layers):
        inner = {"own": t * e, "keys": t * shape.columns, "probable": shape.learned // shape.head * t * shape.whole}
        inner |= {"attended": t * e, "other": t * e, "hidden": t * h, "active": t * h, "scales": 2 * t}
        sizes |= {f"{name}{layer}": size for name, size in inner.items()}
    return _cumulative(sizes)


def found_places(shape: Shape) -> tuple[dict[str, int], int]:
    """The same of the gradients of which those of weights are made."""
    t, p, e = shape.tokens, shape.patches, shape.width
    sizes = {"heard": p * shape.faces_width, "velocity": VELOCITY * (t - p), "start": t * e}
    for layer in range(shape.layers):
        inner = {"keys": t * shape.columns, "out": t * e, "expand": t * shape.hidden, "contract": t * e}
        sizes |= {f"{name}{layer}": size for name, size in inner.items()}
    return _cumulative(sizes)


def _cumulative(sizes: dict[str, int]) -> tuple[dict[str, int], int]:
    found, at = {}, 0
    for name, size in sizes.items():
        found[name] = at
        at += size
    return found, at


def forward(
    faces: torch.Tensor, given: torch.Tensor, model: Weights, pools: Pools
) -> tuple[torch.Tensor, torch.Tensor, Found]:
    """Runs the encoder.

    Args:
        faces: Faces, shape [R,N,F].
        given: Embedded velocities, shape [R,C,E].
        model: The weights.
        pools: The patches.

    Returns:
        Faces with what they hear, [R,N,F]; normalised velocities [R,C,3]; and what `gradients` needs.

    Raises:
        ValueError: There are too many tokens, or not as many velocities as pieces.
    """
    rows, count, width = faces.shape
    patches = pools.start.shape[1]
    tokens = patches + given.shape[1]
    if tokens > MOST_TOKENS or pools.pieces.shape[1] != given.shape[1]:
        raise ValueError(
            f"{given.shape[1]} velocities for {pools.pieces.shape[1]} pieces, {tokens} tokens; at most {MOST_TOKENS}"
        )
    e, learned, head, hidden = model.widths
    ends = len(pools.start), model.layers, count, pools.member.shape[1], pools.patch.shape[2]
    shape = Shape(tokens, patches, e, width, learned, hidden, head, *ends)
    device, faces, given = faces.device, faces.contiguous(), given.contiguous()
    heard = allocate(faces.shape, torch.float32, device)
    velocity = allocate((rows, given.shape[1], 3), torch.float32, device)
    kept = allocate((rows, places(shape)[1]), torch.float32, device)
    length = 2 * tokens * e + learned * shape.whole + patches * width + shape.whole
    room = allocate((rows, length), torch.float32, device)
    real = torch.zeros(1, dtype=torch.uint8) if pools.mask is None else pools.mask.contiguous().view(torch.uint8)
    sizes = _sizes(shape)
    inputs = [sizes, *pools[:7], real, model.weights, model.biases, faces, given]
    with torch_stream(device) as on:
        arguments = [int(pools.mask is not None), *(argument(values) for values in inputs)]
        written = [argument(values) for values in (room, kept, heard, velocity)]
        launch_rows(encoder_kernel, rows, arguments, written, on, least=1, even=True)
    return heard, velocity, Found(shape, rows, kept)


@functools.lru_cache(maxsize=64)
def _sizes(shape: Shape) -> torch.Tensor:
    return torch.tensor(shape, dtype=torch.int32)


def gradients(
    gradient: torch.Tensor, of_velocity: torch.Tensor, found: Found, model: Weights, pools: Pools
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Gradients of faces [R,N,F] and of given velocities [R,C,E] from those of the results of `forward`.

    Returns:
        The two, and what `outer` needs.
    """
    shape, rows, kept = found
    device, gradient, of_velocity = gradient.device, gradient.contiguous(), of_velocity.contiguous()
    e, tokens, patches, width = shape.width, shape.tokens, shape.patches, shape.faces_width
    length = tokens * (3 * e + shape.hidden + shape.whole + width) + shape.learned * shape.whole
    room = allocate((rows, length), torch.float32, device)
    slopes = allocate((rows, found_places(shape)[1]), torch.float32, device)
    of_faces = allocate(gradient.shape, torch.float32, device)
    of_given = allocate((rows, tokens - patches, e), torch.float32, device)
    inputs = [_sizes(shape), *pools[:7], model.weights, model.biases, kept, gradient, of_velocity]
    with torch_stream(device) as on:
        arguments = [argument(values) for values in inputs]
        written = [argument(values) for values in (room, slopes, of_faces, of_given)]
        launch_rows(gradient_kernel, rows, arguments, written, on, least=1, even=True)
    return of_faces, of_given, slopes


class Sums(NamedTuple):
    """Lengths of the gradients of weights in the memory that `outer` adds to, and the products that it adds."""

    lengths: list[tuple[str, int, int, bool]]  # name, rows, columns, and whether a bias [rows] comes after it
    table: torch.Tensor  # int32 [parts,9]
    size: int


@functools.lru_cache(maxsize=64)
def sums_of(shape: Shape) -> Sums:
    """The gradients of weights of an encoder, on rows of one shape; their order does not depend on the rows."""
    t, p, e, f, h, q = shape.tokens, shape.patches, shape.width, shape.faces_width, shape.hidden, shape.columns
    found, kept = found_places(shape)[0], places(shape)[0]
    wanted = []  # name, gradient, its distance, rows; values, columns; depth; bias
    for n in range(shape.layers):
        wanted += [
            (f"keys{n}", found[f"keys{n}"], q, q, kept[f"own{n}"], e, t, True),
            (f"out{n}", found[f"out{n}"], e, e, kept[f"attended{n}"], e, t, True),
            (f"expand{n}", found[f"expand{n}"], h, h, kept[f"other{n}"], e, t, True),
            (f"contract{n}", found[f"contract{n}"], e, e, kept[f"active{n}"], h, t, True),
        ]
    wanted += [
        ("heard", found["heard"], f, f, kept["change"], e, p, True),
        ("pool", found["start"], e, e, kept["pooled"], f, p, True),
        ("lift", found["start"] + p * e, e, e, kept["means"], f, t - p, False),
        ("velocity", found["velocity"], VELOCITY, 3, kept["last"], e, t - p, True),
    ]
    lengths, table, at = [], [], 0
    for name, a, distance, rows, b, columns, depth, bias in wanted:
        end = at + rows * columns
        for m in range(0, rows, PART):
            some = min(PART, rows - m)
            table.append([a + m, distance, some, b, columns, columns, depth, at + m * columns, end + m if bias else -1])
        lengths.append((name, rows, columns, bias))
        at = end + (rows if bias else 0)
    return Sums(lengths, torch.tensor(table, dtype=torch.int32), at)


def outer(found: Found, slopes: torch.Tensor, sums: torch.Tensor) -> None:
    """Adds the gradients of all weights to `sums`, float32 [`sums_of(shape).size`]."""
    table = sums_of(found.shape).table
    with torch_stream(sums.device) as on:
        inputs = [found.rows, slopes.shape[1], found.kept.shape[1]]
        arguments = [argument(values) for values in (table, slopes, found.kept)]
        launch_rows(outer_kernel, len(table), [*inputs, *arguments], [argument(sums)], on, least=8)
