"""A x = b for every component that has a factor (factor.py), with three right-hand sides at once.

By substitution, a component per thread, as a CPU likes it:

    for k upwards:      x_k = b_k - Σ_{j<k} L_kj x_j,    for k downwards:  x_k = x_k / D_k - Σ_{j>k} L_jk x_j

or by two sparse products, x = Wᵀ D⁻¹ W b, a row per block of lanes, as a GPU likes it. Work vectors are in elimination
order, with a fourth number that is zero, since four doubles fit a vector register and three don't.

| symbol | code | what |
| --- | --- | --- |
| b, x | `rhs, solution` | [V,3], float64 |
| `start, rows` | as in cg.System | vertices sorted by component |
| the rest | as in factor.Factor | |
"""

from __future__ import annotations

import torch
import warp as wp

from . import cg
from ._operator import allocate
from ._torch import torch_stream
from .factor import Factor

LANES = 32
"""Lanes that share a row on a GPU."""


@wp.func
def padded(v: wp.vec3d) -> wp.vec4d:
    return wp.vec4d(v[0], v[1], v[2], wp.float64(0.0))


@wp.func
def eliminate_place(
    base: int,
    first: int,
    k: int,
    pivot: wp.array[wp.float64],
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    value: wp.array[wp.float64],
    x: wp.array[wp.vec4d],
):
    """One place of the sweep upwards, after which x is D⁻¹ L⁻¹ x."""
    xk = x[first + k]
    for e in range(pointer[base + k], pointer[base + k + 1]):
        j = first + column[e]
        x[j] = x[j] - value[e] * xk
    x[first + k] = pivot[base + k] * xk


@wp.func
def substitute_place(
    base: int,
    first: int,
    k: int,
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    value: wp.array[wp.float64],
    x: wp.array[wp.vec4d],
):
    """One place of the sweep downwards, after which x is L⁻ᵀ x."""
    s = x[first + k]
    for e in range(pointer[base + k], pointer[base + k + 1]):
        s -= value[e] * x[first + column[e]]
    x[first + k] = s


@wp.kernel(enable_backward=False)
def substitute(
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    base: wp.array[wp.int32],
    order: wp.array[wp.int32],
    pivot: wp.array[wp.float64],
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    value: wp.array[wp.float64],
    # In:
    rhs: wp.array[wp.vec3d],
    # Work:
    x: wp.array[wp.vec4d],
    # Out:
    solution: wp.array[wp.vec3d],
):
    """A component per thread; those without a factor are left as they are."""
    component = wp.tid()
    b = base[component]
    if b >= 0:
        first = start[component]
        size = start[component + 1] - first
        for k in range(size):
            x[first + k] = padded(rhs[rows[first + order[b + k]]])
        for k in range(size):
            eliminate_place(b, first, k, pivot, pointer, column, value, x)
        for m in range(size):
            k = size - 1 - m
            substitute_place(b, first, k, pointer, column, value, x)
            v = x[first + k]
            solution[rows[first + order[b + k]]] = wp.vec3d(v[0], v[1], v[2])


@wp.kernel(enable_backward=False)
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
    """x = D⁻¹ W b, in elimination order, a place per block."""
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
        s = wp.vec3d(cg.block_sum(s[0]), cg.block_sum(s[1]), cg.block_sum(s[2]))
        if lane == 0:
            x[place] = pivot[k] * (s + rhs[rows[first + order[k]]])


@wp.kernel(enable_backward=False)
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
    """Wᵀ x, a place per block; components without a factor are left as they are."""
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
        s = wp.vec3d(cg.block_sum(s[0]), cg.block_sum(s[1]), cg.block_sum(s[2]))
        if lane == 0:
            solution[rows[first + order[k]]] = s + x[place]


def solve(
    system: cg.System,
    factor: Factor,
    vertex_component: torch.Tensor,
    rhs: torch.Tensor,
    solution: torch.Tensor,
) -> None:
    """Writes x of the components that have a factor.

    Args:
        system: Which vertices belong to a component.
        factor: Their factors.
        vertex_component: int32 [V].
        rhs: b, float64 [V,3].
        solution: x, float64 [V,3]; rows of other components are not touched.
    """
    if len(rhs) == 0 or not int(factor.counts[0]):
        return
    common = [cg.view(system.start, wp.int32), cg.view(system.rows, wp.int32)]
    base, order = cg.view(factor.base, wp.int32), cg.view(factor.order, wp.int32)
    pivot = cg.view(factor.pivot, wp.float64)
    columns = [
        cg.view(factor.pointer, wp.int32),
        cg.view(factor.column, wp.int32),
        cg.view(factor.value, wp.float64),
    ]
    load, result = cg.view(rhs, wp.vec3d), cg.view(solution, wp.vec3d)
    with torch_stream(rhs.device) as device:
        if not int(factor.counts[2]):
            work = cg.view(allocate((len(rhs), 4), torch.float64, rhs.device), wp.vec4d)
            inputs = [*common, base, order, pivot, *columns, load, work, result]
            wp.launch(substitute, dim=len(factor.base), inputs=inputs, device=device)
            return
        rows = [
            cg.view(factor.row_pointer, wp.int32),
            cg.view(factor.row_column, wp.int32),
            cg.view(factor.row_value, wp.float64),
        ]
        common += [cg.view(vertex_component, wp.int32), base, order]
        work = cg.view(allocate(rhs.shape, torch.float64, rhs.device), wp.vec3d)
        block = LANES if rhs.is_cuda else cg.block_dim(rhs.device, len(rhs), 1)
        first, second = [*common, pivot, *rows, load, work], [*common, *columns, work, result]
        wp.launch_tiled(multiply_lower, dim=[len(rhs)], inputs=first, block_dim=block, device=device)
        wp.launch_tiled(multiply_upper, dim=[len(rhs)], inputs=second, block_dim=block, device=device)
