"""L-BFGS on a factored matrix, for every group of a batch at once, without a word from the host.

The matrix P = c M + K, with K the stiffness at rest, is constant, and its factor is the first guess of the inverse
Hessian (Liu, Bouaziz and Kavan 2017, "Quasi-Newton Methods for Real-Time Simulation of Hyperelastic Materials"). The
last m pairs s = x' - x, y = g' - g correct it (Nocedal and Wright 2006, algorithm 7.4). An iteration is

    energy and gradient at the trial x + t d          (membrane.py, bending.py, vertices.py)
    `accept`    takes the trial if E' ≤ E + 10⁻⁴ t g·d, else halves t;  q = g through the newer half of algorithm 7.4
    P r = q                                            (linear/triangular.py)
    `direct`    the other half;  d = -r, t = 1, trial = x + d

A group whose trial was refused keeps its direction; its part of the linear solve is not used. A pair without positive
curvature s·y, or of a move that is mere rounding, is left out. A group whose step is below the
tolerance is done, and stays.

| symbol | code | what |
| --- | --- | --- |
| x, g, E | `point`, `gradient`, `energy` | the last accepted iterate, its gradient [N] and energy [J] |
| d, t | `direction`, `step` | direction [m] and share of it that is tried |
| s, y | `moves`, `changes` | rings of m pairs, [m,V,3] |
| 1 / s·y | `curvature` | of each pair, [B,m] |
| m | `memory` | most pairs |
"""

from __future__ import annotations

import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.linear.system import block_sum

wp.set_module_options(compiling.options())

DECREASE = wp.constant(wp.float64(1e-4))
"""Share of the decrease along the slope that a step must reach (Armijo)."""
ROUNDING = wp.constant(wp.float64(1e-13))
"""Increase, as a share of the energy, that is taken for rounding."""
LEAST = wp.constant(wp.float64(1e-9))
"""Root of the mean square of a move [m] below which its pair is rounding, and left out."""
SMALLEST = wp.constant(wp.float64(1e-3))
"""Share of a direction below which it is given up."""


@wp.struct
class Search:
    """State of the search of each group, [B], and its pairs; see the table above."""

    energy: wp.array[wp.float64]
    slope: wp.array[wp.float64]
    step: wp.array[wp.float64]
    pairs: wp.array[wp.int32]  # number of pairs, at most m
    newest: wp.array[wp.int32]  # slot of the newest pair
    fresh: wp.array[wp.int32]  # whether the last trial was accepted, so that a new direction is due
    done: wp.array[wp.int32]
    curvature: wp.array2d[wp.float64]
    weight: wp.array2d[wp.float64]  # α of algorithm 7.4
    point: wp.array[wp.vec3d]
    gradient: wp.array[wp.vec3d]
    direction: wp.array[wp.vec3d]
    moves: wp.array2d[wp.vec3d]
    changes: wp.array2d[wp.vec3d]


@wp.func
def total(values: wp.array[wp.float64], first: int, last: int, lane: int) -> wp.float64:
    """Sum of a range over the lanes of a block."""
    s = wp.float64(0.0)
    i = first + lane
    while i < last:
        s += values[i]
        i += wp.block_dim()
    return block_sum(s)


@wp.kernel(enable_backward=False)
def begin_kernel(
    # Model:
    search: Search,
    keep: int,
):
    """Forgets the energy, and the pairs too unless they are kept; the next trial is accepted as it is."""
    b = wp.tid()
    search.energy[b] = wp.float64(wp.inf)
    search.slope[b] = wp.float64(0.0)
    search.step[b] = wp.float64(0.0)
    search.fresh[b] = 0
    search.done[b] = 0
    if keep == 0:
        search.pairs[b] = 0


@wp.kernel(enable_backward=False)
def accept_kernel(
    # Model:
    vertex_start: wp.array[wp.int32],
    face_start: wp.array[wp.int32],
    hinge_start: wp.array[wp.int32],
    memory: int,
    search: Search,
    # In:
    face_energy: wp.array[wp.float64],
    hinge_energy: wp.array[wp.float64],
    vertex_energy: wp.array[wp.float64],
    trial: wp.array[wp.vec3d],
    trial_gradient: wp.array[wp.vec3d],
    # Out:
    load: wp.array[wp.vec3d],  # q
):
    """Accepts or refuses the trial of a group, one group per block."""
    b, lane = wp.tid()
    first = vertex_start[b]
    last = vertex_start[b + 1]
    before = search.energy[b]
    step = search.step[b]
    pairs = search.pairs[b]
    newest = search.newest[b]
    energy = total(face_energy, face_start[b], face_start[b + 1], lane)
    energy += total(hinge_energy, hinge_start[b], hinge_start[b + 1], lane)
    energy += total(vertex_energy, first, last, lane)
    started = before < wp.float64(wp.inf)
    bound = before
    if started:
        bound = before + DECREASE * step * search.slope[b] + ROUNDING * wp.abs(before)
    accepted = search.done[b] == 0 and energy <= bound
    if accepted:
        slot = (newest + 1) % memory
        curved = wp.float64(0.0)
        moved = wp.float64(0.0)
        if started:
            i = first + lane
            while i < last:
                s = trial[i] - search.point[i]
                y = trial_gradient[i] - search.gradient[i]
                search.moves[slot, i] = s
                search.changes[slot, i] = y
                curved += wp.dot(s, y)
                moved += wp.dot(s, s)
                i += wp.block_dim()
        curved = block_sum(curved)
        if block_sum(moved) < LEAST * LEAST * wp.float64(last - first):
            curved = wp.float64(0.0)
        i = first + lane
        while i < last:
            search.point[i] = trial[i]
            search.gradient[i] = trial_gradient[i]
            load[i] = trial_gradient[i]
            i += wp.block_dim()
        if curved > wp.float64(0.0):
            newest = slot
            pairs = wp.min(pairs + 1, memory)
            if lane == 0:
                search.curvature[b, slot] = wp.float64(1.0) / curved
        for k in range(pairs):
            at = (newest - k + memory) % memory
            along = wp.float64(0.0)
            i = first + lane
            while i < last:
                along += wp.dot(search.moves[at, i], load[i])
                i += wp.block_dim()
            rho = search.curvature[b, at]
            if k == 0 and curved > wp.float64(0.0):
                rho = wp.float64(1.0) / curved
            a = rho * block_sum(along)
            i = first + lane
            while i < last:
                load[i] = load[i] - a * search.changes[at, i]
                i += wp.block_dim()
            if lane == 0:
                search.weight[b, at] = a
        if lane == 0:
            search.energy[b] = energy
            search.pairs[b] = pairs
            search.newest[b] = newest
            search.fresh[b] = 1
    else:
        if lane == 0:
            search.fresh[b] = 0
            search.step[b] = wp.float64(0.5) * step


@wp.kernel(enable_backward=False)
def direct_kernel(
    # Model:
    vertex_start: wp.array[wp.int32],
    memory: int,
    tolerance: wp.float64,
    search: Search,
    # In:
    solved: wp.array[wp.vec3d],  # r, changed
    # Out:
    trial: wp.array[wp.vec3d],
):
    """The next trial of a group, one group per block."""
    b, lane = wp.tid()
    first = vertex_start[b]
    last = vertex_start[b + 1]
    zero = wp.float64(0.0)
    fresh = search.fresh[b]
    pairs = search.pairs[b]
    newest = search.newest[b]
    step = search.step[b]
    block_sum(zero)  # what is read above is written below
    if fresh > 0:
        for m in range(pairs):
            at = (newest - (pairs - 1 - m) + memory) % memory
            across = zero
            i = first + lane
            while i < last:
                across += wp.dot(search.changes[at, i], solved[i])
                i += wp.block_dim()
            by = search.weight[b, at] - search.curvature[b, at] * block_sum(across)
            i = first + lane
            while i < last:
                solved[i] = solved[i] + by * search.moves[at, i]
                i += wp.block_dim()
        slope = zero
        farthest = zero
        i = first + lane
        while i < last:
            d = -solved[i]
            search.direction[i] = d
            slope += wp.dot(search.gradient[i], d)
            farthest += wp.dot(d, d)
            i += wp.block_dim()
        slope = block_sum(slope)
        farthest = block_sum(farthest)
        if lane == 0:
            search.slope[b] = slope
            search.step[b] = wp.float64(1.0)
            if farthest < tolerance * tolerance * wp.float64(last - first):
                search.done[b] = 1
    elif step < SMALLEST:
        # Nothing along this direction is lower: the pairs mislead, or it is the minimum up to rounding.
        i = first + lane
        while i < last:
            search.direction[i] = wp.vec3d()
            i += wp.block_dim()
        if lane == 0:
            search.done[b] = wp.where(pairs == 0, 1, 0)
            search.pairs[b] = 0
            search.slope[b] = zero
            search.step[b] = wp.float64(1.0)
    block_sum(zero)
    t = search.step[b]
    if search.done[b] > 0:
        t = zero
    i = first + lane
    while i < last:
        trial[i] = search.point[i] + t * search.direction[i]
        i += wp.block_dim()
