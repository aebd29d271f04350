"""Weights of a first layer, turned to the heading of a garment and packed for products.py, in one launch.

    W [G (f - G^T m)] = (W G) (f - m G)        G [K,K] turns the K features of a frame, m is their mean

The same G turns all frames of the history, so the columns of W are turned in groups of K.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import launch, torch_stream
from warpgarment.kernels.operator import allocate

from .products import argument, padded, source

wp.set_module_options(compiling.options())

VECTOR = 16


@wp.func_native(
    source("""
    const int outputs16 = outputs / 16, row = t / outputs16, tile = t % outputs16;
    const int features = frames * channels, depth = (features + 31) / 32, wide = (channels + 15) / 16 * 16;
    const float* turn = turns.data + (long)row * channels * wide;
    alignas(64) float line[1024 + 32];
    float* to = result.data + ((long)row * outputs16 + tile) * depth * 512;
    for (int n = -1; n < 16; n++) {
        if (n < 0 && tile) continue;
        const float* from = n < 0 ? mean.data : weight.data + (long)(16 * tile + n) * features;
        for (int h = 0; h < frames; h++)
            for (int j = 0; j < wide; j += 16) {
                v16 sum = {};
                const float* at = from + (n < 0 ? 0 : h * channels);
                for (int i = 0; i < channels; i++)
                    sum = Vector::fma(Vector::all(at[i]), Vector::load(turn + i * wide + j), sum);
                Vector::store(line + h * channels + j, sum);
            }
        for (int k = features; k < 32 * depth; k++) line[k] = 0.0f;
        if (n < 0) {
            __builtin_memcpy(centre.data + (long)row * 32 * depth, line, 128l * depth);
            continue;
        }
        for (int k = 0; k < depth; k++)
            Matrix::column(to + 512 * k, n, Vector::load(line + 32 * k), Vector::load(line + 32 * k + 16));
    }
""")
)
def turned_tile(
    t: int,
    outputs: int,
    frames: int,
    channels: int,
    weight: wp.array[wp.float32],
    mean: wp.array[wp.float32],
    turns: wp.array[wp.float32],
    centre: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...


@wp.kernel(enable_backward=False)
def turned_kernel(
    outputs: wp.int32,
    frames: wp.int32,
    channels: wp.int32,
    # Model:
    weight: wp.array[wp.float32],
    mean: wp.array[wp.float32],
    # In:
    turns: wp.array[wp.float32],
    # Out:
    centre: wp.array[wp.float32],
    result: wp.array[wp.float32],
):
    tile, _ = wp.tid()  # see compiling.py
    turned_tile(tile, outputs, frames, channels, weight, mean, turns, centre, result)


MOST_INPUTS = 1024  # for which a thread has room


def turned(weight: torch.Tensor, mean: torch.Tensor, turns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Turned and packed weights of a first layer.

    Args:
        weight: Weights over the deviations of the features, shape [O,H,K]; O is a multiple of 32, H K at most
            `MOST_INPUTS`.
        mean: Mean of the features, shape [K].
        turns: Rotation of the features of a frame for each garment, shape [R,K,K'] or [R, K K'], columns padded with
            zeros to a multiple of `VECTOR`.

    Returns:
        What is to be subtracted from features in world space, shape [R,I'] with I' from `padded`; weights as from
        `products.pack`, shape [R, O I'].
    """
    outputs, frames, channels = weight.shape
    rows, inputs = len(turns), padded(frames * channels)
    centre = allocate((rows, inputs), torch.float32, weight.device)
    result = allocate((rows, outputs * inputs), torch.float32, weight.device)
    given = [argument(values) for values in (weight, mean, turns)]
    with torch_stream(weight.device) as device:
        written = [argument(centre), argument(result)]
        launch(turned_kernel, rows * outputs // VECTOR, [outputs, frames, channels, *given, *written], device)
    return centre, result
