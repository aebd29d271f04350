"""The head of faces with its gradients, for training: a norm and a narrow layer, in float32 on vectors.

With n(x) = (x - mean) / deviation over the numbers of a face:

    y = W n(x) + b        dx = n'(x)^T W^T dy,   dW = sum dy n(x)^T,   db = sum dy

The scale and shift of the layer norm belong to W and b, as in layer.py. A product that narrow is no work for tiles:
every number of y is a sum along a face.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.dense.products import BLOCK, argument, source
from warpgarment.kernels.launch import launch, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from . import plain

wp.set_module_options(compiling.options())

LEAST = 8  # blocks that are worth another range of a launch
PART = 1024  # faces whose part of the gradients of weights is one call


@wp.func_native(
    source("""
    for (int i = 32 * t; i < 32 * t + 32 && i < count; i++) {
        float* n = own.data + (long)i * width;
        scale.data[i] = Vector::norm(faces.data + (long)i * width, width, n);
        for (int o = 0; o < outputs; o++) {
            const float* w = weight.data + o * width;
            v16 sum = {};
            for (int j = 0; j < width; j += 16) sum = Vector::fma(Vector::load(n + j), Vector::load(w + j), sum);
            result.data[(long)i * outputs + o] = Vector::total(sum) + bias.data[o];
        }
    }
""")
)
def head_block(
    t: int,
    count: int,
    width: int,
    outputs: int,
    weight: wp.array[wp.float32],
    bias: wp.array[wp.float32],
    faces: wp.array[wp.float32],
    own: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    result: wp.array[wp.float32],
): ...


@wp.func_native(
    source("""
    for (int i = 32 * t; i < 32 * t + 32 && i < count; i++) {
        float* x = of_faces.data + (long)i * width;
        const float *n = own.data + (long)i * width, *g = gradient.data + (long)i * outputs;
        v16 sum = {}, along = {};
        for (int j = 0; j < width; j += 16) {
            v16 d = {};
            for (int o = 0; o < outputs; o++)
                d = Vector::fma(Vector::all(g[o]), Vector::load(weight.data + o * width + j), d);
            Vector::store(x + j, d);
            sum += d;
            along = Vector::fma(d, Vector::load(n + j), along);
        }
        const v16 mean = Vector::all(Vector::total(sum) / (float)width);
        const v16 part = Vector::all(Vector::total(along) / (float)width);
        const v16 over = Vector::all(scale.data[i]);
        for (int j = 0; j < width; j += 16)
            Vector::store(x + j, (Vector::load(x + j) - mean - Vector::load(n + j) * part) * over);
    }
""")
)
def back_block(
    t: int,
    count: int,
    width: int,
    outputs: int,
    weight: wp.array[wp.float32],
    own: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    of_faces: wp.array[wp.float32],
): ...


@wp.func_native(
    plain.source("""
    float* of_bias = sums.data + (long)outputs * width;
    const float* g = gradient.data + (long)begin * outputs;
    for (int i = 0; i < end - begin; i++)
        for (int o = 0; o < outputs; o++) of_bias[o] += g[(long)i * outputs + o];
    Plain::outer(g, outputs, outputs, own.data + (long)begin * width, width, end - begin, width, sums.data, width);
""")
)
def outer_faces(
    begin: int,
    end: int,
    width: int,
    outputs: int,
    own: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    sums: wp.array[wp.float32],
): ...


@wp.kernel(enable_backward=False)
def head_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    outputs: wp.int32,
    # Model:
    weight: wp.array[wp.float32],
    bias: wp.array[wp.float32],
    # In:
    faces: wp.array[wp.float32],
    # Out:
    own: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    result: wp.array[wp.float32],
):
    head_block(from_row + wp.tid(), count, width, outputs, weight, bias, faces, own, scale, result)


@wp.kernel(enable_backward=False)
def head_back_kernel(
    from_row: wp.int32,
    count: wp.int32,
    width: wp.int32,
    outputs: wp.int32,
    # Model:
    weight: wp.array[wp.float32],
    # In:
    own: wp.array[wp.float32],
    scale: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    # Out:
    of_faces: wp.array[wp.float32],
):
    back_block(from_row + wp.tid(), count, width, outputs, weight, own, scale, gradient, of_faces)


@wp.kernel(enable_backward=False)
def head_outer_kernel(
    begin: wp.int32,
    end: wp.int32,
    width: wp.int32,
    outputs: wp.int32,
    # In:
    own: wp.array[wp.float32],
    gradient: wp.array[wp.float32],
    # In and out:
    sums: wp.array[wp.float32],
):
    outer_faces(begin, end, width, outputs, own, gradient, sums)


class Weights(NamedTuple):
    """Weights with the norm folded in."""

    weight: torch.Tensor  # W [O,F]
    bias: torch.Tensor  # [O]


class Found(NamedTuple):
    """What the gradient needs of the head."""

    own: torch.Tensor  # n [N,F]
    scale: torch.Tensor  # [N], one over the deviation


def head(faces: torch.Tensor, weights: Weights) -> tuple[torch.Tensor, Found]:
    """The head of faces [N,F], F a multiple of 32; returns [N,O], and what `gradients` needs."""
    faces = faces.contiguous()
    (count, width), outputs = faces.shape, len(weights.bias)
    own, scale, result = (
        allocate(shape, torch.float32, faces.device) for shape in (faces.shape, (count,), (count, outputs))
    )
    given = [argument(values) for values in (*weights, faces)]
    written = [argument(values) for values in (own, scale, result)]
    with torch_stream(faces.device) as device:
        launch_rows(head_kernel, -(-count // BLOCK), [count, width, outputs, *given], written, device, least=LEAST)
    return result, Found(own, scale)


def gradients(gradient: torch.Tensor, found: Found, weights: Weights) -> torch.Tensor:
    """The gradient of faces [N,F] from that of the result, contiguous [N,O]."""
    (count, width), outputs = found.own.shape, gradient.shape[1]
    of_faces = allocate(found.own.shape, torch.float32, gradient.device)
    given = [argument(values) for values in (weights.weight, *found, gradient)]
    with torch_stream(gradient.device) as device:
        inputs = [count, width, outputs, *given]
        launch_rows(head_back_kernel, -(-count // BLOCK), inputs, [argument(of_faces)], device, least=LEAST)
    return of_faces


def outer(gradient: torch.Tensor, found: Found, sums: torch.Tensor) -> list[Callable[[], None]]:
    """Calls that add the gradients of W and then b to `sums` [O * F + O], of which no two may run at the same time."""
    (count, width), outputs = found.own.shape, gradient.shape[1]

    def some(begin: int, end: int) -> None:
        read = [argument(values) for values in (found.own, gradient, sums)]
        with torch_stream(gradient.device) as device:
            launch(head_outer_kernel, 1, [begin, end, width, outputs, *read], device)

    return [functools.partial(some, begin, min(begin + PART, count)) for begin in range(0, count, PART)]
