"""A x = b for every component that has a factor (factor.py), with three right-hand sides at once.

By substitution, with a component per thread and four places at a time, which suits a CPU:

    for k upwards:      x_k = b_k - Σ_{j<k} L_kj x_j,    for k downwards:  x_k = x_k / D_k - Σ_{j>k} L_jk x_j

or by two sparse products, x = Wᵀ D⁻¹ W b, with a row per block of lanes, which suits a GPU. Work vectors are in
elimination order and have a fourth number that is zero, since four doubles fill a vector register and three do not.

| symbol | code | what |
| --- | --- | --- |
| b, x | `rhs, solution` | right-hand side and solution, [V,3], float64 |
| | `start, rows` | as in system.System: vertices sorted by component |
| | all other arrays | as in factor.Factor |
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate

from .factor import Factor
from .system import System, block_dim, block_sum

wp.set_module_options(compiling.options())
_ON_GPU = compiling.apart(f"{__name__}.inverse")

LANES = 32
"""Number of lanes that share a row on a GPU."""


@wp.func
def padded(v: wp.vec3d) -> wp.vec4d:
    return wp.vec4d(v[0], v[1], v[2], wp.float64(0.0))


@wp.func
def eliminate(
    panel: int,
    place: int,
    first: int,
    pivot: wp.array[wp.vec4d],
    triangle: wp.array[wp.mat44d],
    pointer: wp.array[wp.int32],
    row: wp.array[wp.int32],
    value: wp.array[wp.vec4d],
    x: wp.array[wp.vec4d],
):
    """The sweep upwards at the four places of a panel; after all of them x is D⁻¹ L⁻¹ x."""
    t = triangle[panel]
    x0 = x[place]
    x1 = x[place + 1] - t[1, 0] * x0
    x2 = x[place + 2] - t[2, 0] * x0 - t[2, 1] * x1
    x3 = x[place + 3] - t[3, 0] * x0 - t[3, 1] * x1 - t[3, 2] * x2
    e = pointer[panel]
    last = pointer[panel + 1]
    while e < last:
        j = first + row[e]
        v = value[e]
        x[j] = (x[j] - v[0] * x0 - v[1] * x1) - (v[2] * x2 + v[3] * x3)
        e += 1
    d = pivot[panel]
    x[place] = d[0] * x0
    x[place + 1] = d[1] * x1
    x[place + 2] = d[2] * x2
    x[place + 3] = d[3] * x3


@wp.func
def substitute_back(
    panel: int,
    place: int,
    first: int,
    triangle: wp.array[wp.mat44d],
    pointer: wp.array[wp.int32],
    row: wp.array[wp.int32],
    value: wp.array[wp.vec4d],
    x: wp.array[wp.vec4d],
):
    """The sweep downwards at the four places of a panel; after all of them x is L⁻ᵀ x."""
    x0 = x[place]
    x1 = x[place + 1]
    x2 = x[place + 2]
    x3 = x[place + 3]
    e = pointer[panel]
    last = pointer[panel + 1]
    while e < last:
        s = x[first + row[e]]
        v = value[e]
        x0 -= v[0] * s
        x1 -= v[1] * s
        x2 -= v[2] * s
        x3 -= v[3] * s
        e += 1
    t = triangle[panel]
    x2 -= t[3, 2] * x3
    x1 -= t[2, 1] * x2 + t[3, 1] * x3
    x0 -= t[1, 0] * x1 + t[2, 0] * x2 + t[3, 0] * x3
    x[place] = x0
    x[place + 1] = x1
    x[place + 2] = x2
    x[place + 3] = x3


@wp.kernel(enable_backward=False)
def substitute(
    from_row: wp.int32,
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    base: wp.array[wp.int32],
    work: wp.array[wp.int32],
    order: wp.array[wp.int32],
    pivot: wp.array[wp.vec4d],
    triangle: wp.array[wp.mat44d],
    pointer: wp.array[wp.int32],
    row: wp.array[wp.int32],
    value: wp.array[wp.vec4d],
    # In:
    rhs: wp.array[wp.vec3d],
    # Work:
    x: wp.array[wp.vec4d],
    # Out:
    solution: wp.array[wp.vec3d],
):
    """One component per thread; rows of components without a factor are not changed."""
    thread, _ = wp.tid()  # see compiling.py
    component = from_row + thread
    b = base[component]
    if b >= 0:
        begin = start[component]
        first = work[component]
        panels = (start[component + 1] - begin + 3) / 4
        for k in range(4 * panels):
            v = order[b + k]
            x[first + k] = wp.vec4d()
            if v >= 0:
                x[first + k] = padded(rhs[rows[begin + v]])
        for q in range(panels):
            eliminate(b / 4 + q, first + 4 * q, first, pivot, triangle, pointer, row, value, x)
        for m in range(panels):
            q = panels - 1 - m
            substitute_back(b / 4 + q, first + 4 * q, first, triangle, pointer, row, value, x)
        for k in range(4 * panels):
            v = order[b + k]
            if v >= 0:
                d = x[first + k]
                solution[rows[begin + v]] = wp.vec3d(d[0], d[1], d[2])


@wp.kernel(module=_ON_GPU, enable_backward=False)
def multiply_lower(
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    vertex_component: wp.array[wp.int32],
    base: wp.array[wp.int32],
    order: wp.array[wp.int32],
    pivot: wp.array[wp.float64],
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    value: wp.array[wp.float64],
    # In:
    rhs: wp.array[wp.vec3d],
    # Out:
    x: wp.array[wp.vec3d],
):
    """x = D⁻¹ W b, in elimination order, one place per block."""
    place, lane = wp.tid()
    component = vertex_component[rows[place]]
    b = base[component]
    if b >= 0:
        first = start[component]
        k = b + place - first
        s = wp.vec3d()
        e = pointer[k] + lane
        while e < pointer[k + 1]:
            s += value[e] * rhs[rows[first + order[b + column[e]]]]
            e += wp.block_dim()
        s = wp.vec3d(block_sum(s[0]), block_sum(s[1]), block_sum(s[2]))
        if lane == 0:
            x[place] = pivot[k] * (s + rhs[rows[first + order[k]]])


@wp.kernel(module=_ON_GPU, enable_backward=False)
def multiply_upper(
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    vertex_component: wp.array[wp.int32],
    base: wp.array[wp.int32],
    order: wp.array[wp.int32],
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    value: wp.array[wp.float64],
    # In:
    x: wp.array[wp.vec3d],
    # Out:
    solution: wp.array[wp.vec3d],
):
    """Wᵀ x, one place per block; rows of components without a factor are not changed."""
    place, lane = wp.tid()
    component = vertex_component[rows[place]]
    b = base[component]
    if b >= 0:
        first = start[component]
        k = b + place - first
        s = wp.vec3d()
        e = pointer[k] + lane
        while e < pointer[k + 1]:
            s += value[e] * x[first + column[e]]
            e += wp.block_dim()
        s = wp.vec3d(block_sum(s[0]), block_sum(s[1]), block_sum(s[2]))
        if lane == 0:
            solution[rows[first + order[k]]] = s + x[place]


def solve(
    system: System,
    factor: Factor,
    vertex_component: torch.Tensor,
    rhs: torch.Tensor,
    solution: torch.Tensor,
) -> None:
    """Writes the solution x in the rows of those components that have a factor.

    Args:
        system: System that assigns the vertices to components.
        factor: Factors of the components.
        vertex_component: Component of each vertex, int32 [V].
        rhs: Right-hand side b, float64 [V,3].
        solution: Output x, float64 [V,3]; rows of components without a factor are not changed.
    """
    if len(rhs) == 0 or not factor.factored:
        return
    common = [as_argument(system.start, wp.int32), as_argument(system.rows, wp.int32)]
    load, result = as_argument(rhs, wp.vec3d), as_argument(solution, wp.vec3d)
    with torch_stream(rhs.device) as device:
        if not factor.explicit:
            scratch = allocate((factor.places, 4), torch.float64, rhs.device)
            inputs = [*common, *substitution(factor), load, as_argument(scratch, wp.vec4d), result]
            launch_rows(substitute, len(factor.base), inputs, [], device, least=1)
            return
        base, order = as_argument(factor.base, wp.int32), as_argument(factor.order, wp.int32)
        columns, rows = (
            [as_argument(pointer, wp.int32), as_argument(column, wp.int32), as_argument(value, wp.float64)]
            for pointer, column, value in (
                (factor.pointer, factor.column, factor.value),
                (factor.row_pointer, factor.row_column, factor.row_value),
            )
        )
        common += [as_argument(vertex_component, wp.int32), base, order]
        scratch = allocate(rhs.shape, torch.float64, rhs.device)
        work = as_argument(scratch, wp.vec3d)
        block = LANES if rhs.is_cuda else block_dim(rhs.device, len(rhs), 1)
        first = [*common, as_argument(factor.pivot, wp.float64), *rows, load, work]
        second = [*common, *columns, work, result]
        wp.launch_tiled(multiply_lower, dim=[len(rhs)], inputs=first, block_dim=block, device=device)
        wp.launch_tiled(multiply_upper, dim=[len(rhs)], inputs=second, block_dim=block, device=device)


def recorded(
    system: System, factor: Factor, vertex_component: torch.Tensor, rhs: torch.Tensor, solution: torch.Tensor
) -> Callable[[], None]:
    """`solve` on the same tensors again and again: a function that launches it, at a fraction of the host's time.

    The arguments are those of `solve`. The tensors, those of `system` and `factor` too, must outlive the function. It
    has to be called on the stream of `launch.torch_stream`, as recorded launches are.
    """
    if factor.explicit or len(rhs) == 0 or not factor.factored:
        return lambda: solve(system, factor, vertex_component, rhs, solution)
    scratch = allocate((factor.places, 4), torch.float64, rhs.device)
    common = [as_argument(system.start, wp.int32), as_argument(system.rows, wp.int32), *substitution(factor)]
    work = [as_argument(rhs, wp.vec3d), as_argument(scratch, wp.vec4d), as_argument(solution, wp.vec3d)]
    device = wp.device_from_torch(rhs.device)
    command = wp.launch(substitute, dim=len(factor.base), inputs=[0, *common, *work], device=device, record_cmd=True)

    def launch(kept: torch.Tensor = scratch) -> None:  # the launch itself keeps no memory alive
        command.launch()

    return launch


def substitution(factor: Factor) -> list[object]:
    """Launch arguments `base` to `value` of `substitute` from a factor in the form for substitution."""
    integers = [as_argument(t, wp.int32) for t in (factor.base, factor.first, factor.order)]
    return [
        *integers,
        as_argument(factor.pivot.view(-1, 4), wp.vec4d),
        as_argument(factor.triangle, wp.mat44d),
        as_argument(factor.pointer, wp.int32),
        as_argument(factor.column, wp.int32),
        as_argument(factor.value.view(-1, 4), wp.vec4d),
    ]
