"""Contact forces through a factor of B: the collision refinement on a CPU, for components of any size.

As in compliance.py the unknowns are the forces y, one per contact, and conjugate gradients solve

    (I + S) y = c,    S = Nᵀ B⁻¹ N,    D = B⁻¹ N y

but S is applied without being formed: a product with B⁻¹ takes two sweeps over L (linear/factor.py). A load on contacts
only reaches the ancestors of their places in the elimination tree, and displacements at contacts only depend on these.
So the sweeps of the iteration only pass over the panels of these places, which are called `active`.

All eigenvalues of I + S are at least 1. Hence the error in the energy norm is at most |c - (I + S) y|, which is the
stopping criterion of the iteration. A diagonal preconditioner would not help, since S_ii hardly varies.

| symbol | code | what |
| --- | --- | --- |
| B = L D Lᵀ | `factor.Factor` | |
| n_i | `normal` | [V,3]; zero at vertices without contact |
| c_i | `gap` | [V], distance [m] by which a vertex is too close, along the normal |
| y_i | `force` | [V], zero at vertices without contact |
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, torch_stream
from warpgarment.kernels.linear.conjugate_gradients import after_step
from warpgarment.kernels.linear.factor import Factor
from warpgarment.kernels.linear.system import System
from warpgarment.kernels.linear.triangular import eliminate, padded, substitute_back, substitution
from warpgarment.kernels.operator import allocate

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def contact_forces(
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
    normal: wp.array[wp.vec3d],
    gap: wp.array[wp.float64],
    tolerance: wp.array[wp.float64],
    relative: wp.float64,
    max_iterations: wp.int32,
    # Work:
    place: wp.array[wp.int32],
    active: wp.array[wp.int32],
    reached: wp.array[wp.int32],
    toward: wp.array[wp.vec4d],
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
    component = from_row + wp.tid()
    b = base[component]
    if b >= 0:
        begin = start[component]
        first = work[component]  # of all vectors, which hold a number per place or contact
        panels = (start[component + 1] - begin + 3) / 4
        zero = wp.float64(0.0)

        # The contacts, and the panels that they reach.
        count = wp.int32(0)
        actives = wp.int32(0)
        rr = zero
        for k in range(4 * panels):
            reached[first + k] = 0
            x[first + k] = wp.vec4d()
        for q in range(panels):
            for r in range(4):
                k = 4 * q + r
                if order[b + k] >= 0:
                    i = rows[begin + order[b + k]]
                    n = normal[i]
                    force[i] = zero
                    increment[i] = wp.vec3d()
                    if n[0] != zero or n[1] != zero or n[2] != zero:
                        c = gap[i]
                        place[first + count] = first + k
                        toward[first + count] = padded(n)
                        residual[first + count] = c
                        direction[first + count] = c
                        solution[first + count] = zero
                        rr += c * c
                        count += 1
                        reached[first + q] = 1
            if reached[first + q] == 1:
                active[first + actives] = q
                actives += 1
                for e in range(pointer[b / 4 + q], pointer[b / 4 + q + 1]):
                    reached[first + row[e] / 4] = 1

        goal = tolerance[component] * tolerance[component]
        total = zero
        iteration = wp.int32(0)
        running = rr > goal
        while running and iteration < max_iterations:
            for m in range(actives):
                for r in range(4):
                    x[first + 4 * active[first + m] + r] = wp.vec4d()
            for m in range(count):
                x[place[first + m]] = direction[first + m] * toward[first + m]
            for m in range(actives):
                q = active[first + m]
                eliminate(b / 4 + q, first + 4 * q, first, pivot, triangle, pointer, row, value, x)
            for m in range(actives):
                q = active[first + actives - 1 - m]
                substitute_back(b / 4 + q, first + 4 * q, first, triangle, pointer, row, value, x)
            pq = zero
            for m in range(count):
                p = direction[first + m]
                s = p + wp.dot(toward[first + m], x[place[first + m]])
                image[first + m] = s
                pq += p * s
            alpha = rr / pq
            rr_next = zero
            for m in range(count):
                solution[first + m] = solution[first + m] + alpha * direction[first + m]
                left = residual[first + m] - alpha * image[first + m]
                residual[first + m] = left
                rr_next += left * left
            beta, total, running = after_step(rr, rr_next, alpha, total, goal, relative)
            for m in range(count):
                direction[first + m] = residual[first + m] + beta * direction[first + m]
            rr = rr_next
            iteration += 1
        if not (rr >= zero):  # NaN in, NaN out
            for m in range(count):
                solution[first + m] = rr

        # D = B⁻¹ N y, at all places.
        if count > 0:
            for m in range(actives):
                for r in range(4):
                    x[first + 4 * active[first + m] + r] = wp.vec4d()
            for m in range(count):
                x[place[first + m]] = solution[first + m] * toward[first + m]
                force[rows[begin + order[b + place[first + m] - first]]] = solution[first + m]
            for m in range(actives):
                q = active[first + m]
                eliminate(b / 4 + q, first + 4 * q, first, pivot, triangle, pointer, row, value, x)
            for m in range(panels):
                q = panels - 1 - m
                substitute_back(b / 4 + q, first + 4 * q, first, triangle, pointer, row, value, x)
            for k in range(4 * panels):
                if order[b + k] >= 0:
                    d = x[first + k]
                    increment[rows[begin + order[b + k]]] = wp.vec3d(d[0], d[1], d[2])
        report[component] = wp.where(running, -iteration, iteration)
        error[component] = wp.sqrt(rr)


def solve(
    system: System,
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
    """Computes forces and displacements of the components that have a factor.

    Args:
        system: Division of the vertices into components.
        factor: Factor of B, in the form for substitution.
        normal: n, float64 [V,3].
        gap: c [m], float64 [V].
        tolerance: Value of |c - (I + S) y| [m] at which the iteration stops, float64 [C].
        relative: Value of the same as a share of the energy norm of y. The looser of the two counts.
        max_iterations: Limit of iterations per component.
        increment: Output: D [m], float64 [V,3].
        report: Output: number of iterations, int32 [C], negative if the limit ended them.
        error: Output: bound of the error in the energy norm [m], float64 [C].

    Returns:
        Forces y, float64 [V].
    """
    places, device = factor.places, normal.device
    integers = allocate((3, places), torch.int32, device)
    scalars, vectors = allocate((4, places), torch.float64, device), allocate((2, places, 4), torch.float64, device)
    force = torch.zeros(len(normal), dtype=torch.float64, device=device)
    with torch_stream(device) as warp_device:
        launch_rows(
            contact_forces,
            len(factor.base),
            inputs=[
                as_argument(system.start, wp.int32),
                as_argument(system.rows, wp.int32),
                *substitution(factor),
                as_argument(normal, wp.vec3d),
                as_argument(gap, wp.float64),
                as_argument(tolerance, wp.float64),
                float(relative),
                int(max_iterations),
                *(as_argument(t, wp.int32) for t in integers),
                as_argument(vectors[0], wp.vec4d),
                *(as_argument(t, wp.float64) for t in scalars),
                as_argument(vectors[1], wp.vec4d),
                as_argument(force, wp.float64),
                as_argument(increment, wp.vec3d),
                as_argument(report, wp.int32),
                as_argument(error, wp.float64),
            ],
            outputs=[],
            device=warp_device,
            least=1,
        )
    return force
