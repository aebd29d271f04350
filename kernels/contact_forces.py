"""Contact forces through a factor of B: the collision refinement on a CPU, for components of any size.

As in compliance.py the unknowns are the forces y, one per contact, and conjugate gradients solve

    (I + S) y = c,    S = Nᵀ B⁻¹ N,    D = B⁻¹ N y

but S is applied and not formed: B⁻¹ costs two sweeps over L (factor.py). A load on contacts reaches the ancestors of
their places in the elimination tree and nothing else, and displacements at contacts depend on nothing else, so that the
sweeps of the iteration pass over these `active` places only.

All eigenvalues of I + S are at least 1. Hence the error in the energy norm is at most |c - (I + S) y|, and this is what
the iteration is stopped by, at every step. A diagonal preconditioner would not pay: S_ii hardly varies.

| symbol | code | what |
| --- | --- | --- |
| B = L D Lᵀ | `factor.Factor` | |
| n_i | `normal` | [V,3]; zero where there is no contact |
| c_i | `gap` | [V], what is missing along the normal |
| y_i | `force` | [V], zero where there is no contact |
"""

from __future__ import annotations

import torch
import warp as wp

from . import cg
from ._operator import allocate
from ._torch import torch_stream
from .factor import Factor
from .triangular import eliminate_place, padded, substitute_place


@wp.func
def apply_inverse(
    base: int,
    first: int,
    actives: int,
    active: wp.array[wp.int32],
    pivot: wp.array[wp.float64],
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    value: wp.array[wp.float64],
    x: wp.array[wp.vec4d],
):
    """x becomes B⁻¹ x at the active places, for x that is zero elsewhere."""
    for m in range(actives):
        eliminate_place(base, first, active[first + m], pivot, pointer, column, value, x)
    for m in range(actives):
        substitute_place(base, first, active[first + actives - 1 - m], pointer, column, value, x)


@wp.kernel(enable_backward=False)
def contact_forces(
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
    normal: wp.array[wp.vec3d],
    gap: wp.array[wp.float64],
    tolerance: wp.array[wp.float64],
    relative: wp.float64,
    max_iterations: wp.int32,
    # Work:
    place: wp.array[wp.int32],
    active: wp.array[wp.int32],
    reached: wp.array[wp.int32],
    direction_of: wp.array[wp.vec4d],
    residual: wp.array[wp.float64],
    direction: wp.array[wp.float64],
    image: wp.array[wp.float64],
    solution: wp.array[wp.float64],
    x: wp.array[wp.vec4d],
    # Out:
    force: wp.array[wp.float64],
    increment: wp.array[wp.vec3d],
    report: wp.array[wp.int32],
    error: wp.array[wp.float64],
):
    """Forces and displacements of one component, a thread; those without a factor are left as they are."""
    component = wp.tid()
    b = base[component]
    if b >= 0:
        first = start[component]
        size = start[component + 1] - first
        zero = wp.float64(0.0)
        count = wp.int32(0)
        actives = wp.int32(0)
        rr = zero
        for k in range(size):
            reached[first + k] = 0
            x[first + k] = wp.vec4d()
        for k in range(size):
            i = rows[first + order[b + k]]
            n = normal[i]
            force[i] = zero
            increment[i] = wp.vec3d()
            if n[0] != zero or n[1] != zero or n[2] != zero:
                c = gap[i]
                place[first + count] = k
                direction_of[first + count] = padded(n)
                residual[first + count] = c
                direction[first + count] = c
                solution[first + count] = zero
                rr += c * c
                count += 1
                reached[first + k] = 1
            if reached[first + k] == 1:
                active[first + actives] = k
                actives += 1
                if pointer[b + k] < pointer[b + k + 1]:
                    reached[first + column[pointer[b + k]]] = 1  # the parent in the elimination tree

        goal = tolerance[component] * tolerance[component]
        total = zero
        iteration = wp.int32(0)
        running = rr > goal
        while running and iteration < max_iterations:
            for m in range(actives):
                x[first + active[first + m]] = wp.vec4d()
            for m in range(count):
                x[first + place[first + m]] = direction[first + m] * direction_of[first + m]
            apply_inverse(b, first, actives, active, pivot, pointer, column, value, x)
            pq = zero
            for m in range(count):
                p = direction[first + m]
                q = p + wp.dot(direction_of[first + m], x[first + place[first + m]])
                image[first + m] = q
                pq += p * q
            alpha = rr / pq
            rr_next = zero
            for m in range(count):
                solution[first + m] = solution[first + m] + alpha * direction[first + m]
                r = residual[first + m] - alpha * image[first + m]
                residual[first + m] = r
                rr_next += r * r
            beta = rr_next / rr
            for m in range(count):
                direction[first + m] = residual[first + m] + beta * direction[first + m]
            total += alpha * rr
            rr = rr_next
            iteration += 1
            running = rr > wp.max(goal, relative * relative * total)
        if not (rr >= zero):  # NaN in, NaN out
            for m in range(count):
                solution[first + m] = rr

        if count > 0:
            for m in range(actives):
                x[first + active[first + m]] = wp.vec4d()
            for m in range(count):
                y = solution[first + m]
                x[first + place[first + m]] = y * direction_of[first + m]
                force[rows[first + order[b + place[first + m]]]] = y
            for m in range(actives):
                eliminate_place(b, first, active[first + m], pivot, pointer, column, value, x)
            for m in range(size):
                k = size - 1 - m
                substitute_place(b, first, k, pointer, column, value, x)
                d = x[first + k]
                increment[rows[first + order[b + k]]] = wp.vec3d(d[0], d[1], d[2])
        report[component] = wp.where(running, -iteration, iteration)
        error[component] = wp.sqrt(rr)


def solve(
    system: cg.System,
    factor: Factor,
    normal: torch.Tensor,
    gap: torch.Tensor,
    tolerance: torch.Tensor,
    relative: float,
    max_iterations: int,
    increment: torch.Tensor,
    report: torch.Tensor,
    error: torch.Tensor,
) -> torch.Tensor:
    """Forces and displacements of the components that have a factor, which must be in the form for substitution.

    Args:
        system: Which vertices belong to a component.
        factor: Of B.
        normal: n, float64 [V,3].
        gap: c, float64 [V].
        tolerance: Where the iteration stops: |c - (I + S) y| [m], float64 [C].
        relative: The same as a share of the energy norm of y; the looser of the two holds.
        max_iterations: Limit per component.
        increment: D [m], float64 [V,3], written.
        report: Iterations, int32 [C], negative where the limit ended them, written.
        error: Bound of the error in the energy norm, float64 [C], written.

    Returns:
        Forces y, float64 [V].
    """
    vertices, device = len(normal), normal.device
    integers = allocate((3, vertices), torch.int32, device)
    scalars, vectors = (allocate((n, vertices, w), torch.float64, device) for n, w in ((4, 1), (2, 4)))
    force = torch.zeros(vertices, dtype=torch.float64, device=device)
    with torch_stream(device) as warp_device:
        wp.launch(
            contact_forces,
            dim=len(factor.base),
            inputs=[
                *(cg.view(t, wp.int32) for t in (system.start, system.rows, factor.base, factor.order)),
                cg.view(factor.pivot, wp.float64),
                cg.view(factor.pointer, wp.int32),
                cg.view(factor.column, wp.int32),
                cg.view(factor.value, wp.float64),
                cg.view(normal, wp.vec3d),
                cg.view(gap, wp.float64),
                cg.view(tolerance, wp.float64),
                float(relative),
                int(max_iterations),
                *(cg.view(t, wp.int32) for t in integers),
                cg.view(vectors[0], wp.vec4d),
                *(cg.view(t.view(-1), wp.float64) for t in scalars),
                cg.view(vectors[1], wp.vec4d),
                cg.view(force, wp.float64),
                cg.view(increment, wp.vec3d),
                cg.view(report, wp.int32),
                cg.view(error, wp.float64),
            ],
            device=warp_device,
        )
    return force
