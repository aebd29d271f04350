"""What the network of patches needs of a whole garment before its faces, in one launch, and its velocities after them.

The newest features of a face hold its deformation gradient Phi and the velocity u of the body near it. For a row:

    G = R_y(-theta),  theta = atan2(M02 - M20, M00 + M22),  M = sum of Phi over its faces      see nn/heading.py
    turns    the matrix by which G turns the features of a frame, as products of two entries of (G, 1, 0)
    token    W [(G v - mean) / deviation] + b for each of its pieces, v the past velocities of the piece
    around   mean of u over the faces of the piece

`velocities` gives the velocities of the pieces: G^T (deviation q + mean) [+ around, if residual].
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import launch_rows, rows_in_memory, torch_stream
from warpgarment.kernels.operator import allocate

from .products import argument

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def heading_kernel(
    from_row: wp.int32,
    count: wp.int32,
    pieces: wp.int32,
    gradient: wp.int32,
    body_velocity: wp.int32,
    pitch: wp.int32,
    past: wp.int32,
    canonical: wp.int32,
    entries: wp.int32,
    width: wp.int32,
    # Model:
    index: wp.array[wp.int64],
    piece: wp.array[wp.int64],
    piece_of_face: wp.array[wp.int32],
    first: wp.array[wp.int64],
    second: wp.array[wp.int64],
    scale: wp.array[wp.float32],
    weight: wp.array[wp.float32],
    bias: wp.array[wp.float32],
    # In:
    features: wp.array[wp.float32],
    velocity: wp.array[wp.float32],
    # Out:
    turn: wp.array[wp.float32],
    turns: wp.array[wp.float32],
    tokens: wp.array[wp.float32],
    around: wp.array[wp.float32],
    faces: wp.array[wp.float32],
):
    thread, _ = wp.tid()  # see compiling.py
    r = from_row + thread
    for p in range(pieces):
        for k in range(3):
            around[3 * (pieces * r + p) + k] = wp.float32(0.0)
        faces[pieces * r + p] = wp.float32(0.0)
    least = wp.int32(piece[pieces * r])
    sine = wp.float64(0.0)
    cosine = wp.float64(0.0)
    for n in range(count):
        f = wp.int32(index[count * r + n])
        if f >= 0:
            phi = f * pitch + gradient
            u = f * pitch + body_velocity
            sine += wp.float64(features[phi + 2]) - wp.float64(features[phi + 6])
            cosine += wp.float64(features[phi]) + wp.float64(features[phi + 8])
            to = pieces * r + piece_of_face[f] - least
            faces[to] = faces[to] + 1.0
            for k in range(3):
                around[3 * to + k] = around[3 * to + k] + features[u + k]
    size = wp.sqrt(sine * sine + cosine * cosine)
    s = wp.float32(0.0)
    c = wp.float32(1.0)
    if canonical != 0 and size > wp.float64(0.0):
        s = wp.float32(sine / size)
        c = wp.float32(cosine / size)
    for k in range(9):
        turn[9 * r + k] = wp.float32(0.0)
    turn[9 * r] = c
    turn[9 * r + 2] = -s
    turn[9 * r + 4] = wp.float32(1.0)
    turn[9 * r + 6] = s
    turn[9 * r + 8] = c
    for k in range(entries):
        turns[entries * r + k] = part(turn, r, first[k]) * part(turn, r, second[k])
    for p in range(pieces):
        at = pieces * r + p
        own = piece[at]
        for k in range(3):
            around[3 * at + k] = around[3 * at + k] / wp.max(faces[at], 1.0)
        for e in range(width):
            total = wp.float32(0.0)
            if own >= wp.int64(0):
                total = bias[e]
                for h in range(past):
                    from_v = wp.int32(own) * 3 * past + 3 * h
                    x = velocity[from_v]
                    z = velocity[from_v + 2]
                    at_w = 3 * (e * past + h)
                    total += weight[at_w] * (c * x - s * z - scale[3]) / scale[0]
                    total += weight[at_w + 1] * (velocity[from_v + 1] - scale[4]) / scale[1]
                    total += weight[at_w + 2] * (s * x + c * z - scale[5]) / scale[2]
            tokens[width * at + e] = total


@wp.func
def part(turn: wp.array[wp.float32], r: int, k: wp.int64):
    """An entry of (G, 1, 0)."""
    value = wp.float32(0.0)
    if k < wp.int64(9):
        value = turn[9 * r + wp.int32(k)]
    elif k == wp.int64(9):
        value = wp.float32(1.0)
    return value


@wp.kernel(enable_backward=False)
def velocities_kernel(
    from_row: wp.int32,
    pieces: wp.int32,
    residual: wp.int32,
    # Model:
    piece: wp.array[wp.int64],
    scale: wp.array[wp.float32],
    # In:
    turn: wp.array[wp.float32],
    said: wp.array[wp.float32],
    around: wp.array[wp.float32],
    # Out:
    result: wp.array[wp.float32],
):
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    to = wp.int32(piece[i])
    if to < 0:
        return
    c = turn[9 * (i // pieces)]
    s = turn[9 * (i // pieces) + 6]
    x = said[3 * i] * scale[0] + scale[3]
    y = said[3 * i + 1] * scale[1] + scale[4]
    z = said[3 * i + 2] * scale[2] + scale[5]
    q = wp.vec3(c * x + s * z, y, c * z - s * x)
    if residual != 0:
        q += wp.vec3(around[3 * i], around[3 * i + 1], around[3 * i + 2])
    for k in range(3):
        result[3 * to + k] = q[k]


class Rows(NamedTuple):
    """Which faces and pieces of a packed batch the rows are."""

    face: torch.Tensor  # int64 [R,N], packed faces, -1 for padding
    piece: torch.Tensor  # int64 [R,C], packed pieces that follow each other, -1 for padding
    piece_of_face: torch.Tensor  # int32 [F]


class Model(NamedTuple):
    """What turns features and embeds velocities."""

    first: torch.Tensor  # int64 [K K'], one factor of each entry of the turn of a frame's features
    second: torch.Tensor  # int64 [K K'], the other one
    scale: torch.Tensor  # [6], deviations of velocities, then their means
    weight: torch.Tensor  # [E, 3 (H-1)]
    bias: torch.Tensor  # [E]
    canonical: bool  # whether rows are turned to heading zero


class Heading(NamedTuple):
    """What the launch finds of each row."""

    turn: torch.Tensor  # G [R,3,3]
    turns: torch.Tensor  # [R, K K']
    tokens: torch.Tensor  # [R,C,E]; zero for padding
    around: torch.Tensor  # [R,C,3] m/frame


def heading(
    features: torch.Tensor, velocity: torch.Tensor, rows: Rows, model: Model, gradient: int, body_velocity: int
) -> Heading:
    """The heading of each row and what depends on it.

    Args:
        features: Features of the packed faces in the newest frame, shape [F,K].
        velocity: Past velocities of the packed pieces [m/frame], shape [C,3*(H-1)].
        rows: The rows.
        model: The network's constants.
        gradient: Column at which the deformation gradients begin.
        body_velocity: The same of the velocities of the body.
    """
    count, pieces = rows.face.shape[1], rows.piece.shape[1]
    flat, pitch = rows_in_memory(features)
    number, width, entries = len(rows.face), len(model.bias), len(model.first)
    shapes = (number, 3, 3), (number, entries), (number, pieces, width), (number, pieces, 3), (number, pieces)
    found = [allocate(shape, torch.float32, features.device) for shape in shapes]
    past = velocity.shape[1] // 3
    sizes = [count, pieces, gradient, body_velocity, pitch, past, int(model.canonical), entries, width]
    given = [argument(values) for values in (*rows, *model[:5], flat, velocity)]
    with torch_stream(features.device) as device:
        written = [argument(values) for values in found]
        launch_rows(heading_kernel, number, [*sizes, *given], written, device, least=1)
    return Heading(*found[:4])


def velocities(
    said: torch.Tensor, found: Heading, rows: Rows, scale: torch.Tensor, result: torch.Tensor, *, residual: bool
) -> None:
    """Writes the velocities of pieces [m/frame] into `result` [C,3], from what the network says of them.

    Args:
        said: Normalised velocities, shape [R,C,3].
        found: What `heading` found of the rows.
        rows: The rows.
        scale: Deviations, then means, shape [6].
        result: Velocities of the packed pieces; those of the rows are written.
        residual: Whether velocities are relative to those of the body near the piece.
    """
    pieces = rows.piece.shape[1]
    given = [argument(values) for values in (rows.piece, scale, found.turn, said, found.around)]
    with torch_stream(said.device) as device:
        inputs = [pieces, int(residual), *given]
        launch_rows(velocities_kernel, rows.piece.numel(), inputs, [argument(result)], device, least=1024)
