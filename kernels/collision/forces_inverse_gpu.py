"""Contact forces through compliance matrices on a GPU, a block of threads per component. Equations: compliance.py."""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, torch_stream
from warpgarment.kernels.linear.conjugate_gradients import after_step
from warpgarment.kernels.linear.system import System, block_dim, block_sum
from warpgarment.kernels.operator import allocate

from .compliance import Compliance

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def solve_contacts(
    # Model:
    start: wp.array[wp.int32],
    base: wp.array[wp.int64],
    room: wp.array[wp.int64],
    local: wp.array[wp.int32],
    compliance: wp.array[wp.float32],
    # In:
    contact_end: wp.array[wp.int32],
    contacts: wp.array[wp.int64],
    normal: wp.array[wp.vec3d],
    gap: wp.array[wp.float64],
    tolerance: wp.array[wp.float64],
    relative: wp.float64,
    max_iterations: wp.int32,
    # Work, the vectors indexed by contact:
    coupling: wp.array[wp.float32],
    residual: wp.array[wp.float64],
    direction: wp.array[wp.float64],
    image: wp.array[wp.float64],
    # Out:
    force: wp.array[wp.float64],
    report: wp.array[wp.int32],
    error: wp.array[wp.float64],
):
    """(I + S) y = c for one component, from zero, until |c - (I + S) y| is small enough."""
    component, lane = wp.tid()
    if base[component] >= wp.int64(0):
        first = wp.int32(0)
        if start[component] > 0:
            first = contact_end[start[component] - 1]
        count = wp.int32(0)
        if start[component + 1] > start[component]:
            count = contact_end[start[component + 1] - 1] - first
        pitch = wp.int64((start[component + 1] - start[component] + 15) / 16) * wp.int64(16)
        stride = wp.block_dim()
        zero = wp.float64(0.0)

        # S, symmetric: a lone lane walks along its rows, many lanes side by side along its columns.
        along = wp.int32(1)
        across = count
        if stride > 1:
            along = count
            across = 1
        k = lane
        while k < count:
            i = int(contacts[first + k])
            for m in range(count):
                j = int(contacts[first + m])
                z = compliance[base[component] + wp.int64(local[j]) * pitch + wp.int64(local[i])]
                slot = room[component] + wp.int64(k) * wp.int64(across) + wp.int64(m) * wp.int64(along)
                coupling[slot] = wp.float32(wp.dot(normal[i], normal[j])) * z
            k += stride

        rr = wp.float64(0.0)
        k = lane
        while k < count:
            i = int(contacts[first + k])
            c = gap[i]
            force[i] = zero
            residual[first + k] = c
            direction[first + k] = c
            rr += c * c
            k += stride
        rr = block_sum(rr)

        goal = tolerance[component] * tolerance[component]
        total = wp.float64(0.0)
        iteration = wp.int32(0)
        running = rr > goal
        while running and iteration < max_iterations:
            pq = wp.float64(0.0)
            k = lane
            while k < count:
                slot = room[component] + wp.int64(k) * wp.int64(across)
                s = direction[first + k]
                s1 = wp.float64(0.0)
                for m in range(count / 2):
                    s += wp.float64(coupling[slot]) * direction[first + 2 * m]
                    s1 += wp.float64(coupling[slot + wp.int64(along)]) * direction[first + 2 * m + 1]
                    slot += wp.int64(2 * along)
                if count % 2 == 1:
                    s += wp.float64(coupling[slot]) * direction[first + count - 1]
                s += s1
                image[first + k] = s
                pq += direction[first + k] * s
                k += stride
            pq = block_sum(pq)
            alpha = rr / pq

            rr_next = wp.float64(0.0)
            k = lane
            while k < count:
                i = int(contacts[first + k])
                force[i] = force[i] + alpha * direction[first + k]
                r = residual[first + k] - alpha * image[first + k]
                residual[first + k] = r
                rr_next += r * r
                k += stride
            rr_next = block_sum(rr_next)

            beta, total, running = after_step(rr, rr_next, alpha, total, goal, relative)
            k = lane
            while k < count:
                direction[first + k] = residual[first + k] + beta * direction[first + k]
                k += stride

            iteration += 1
            rr = block_sum(rr_next) / wp.float64(stride)  # the barrier between direction and the next product

        if not (rr >= zero):  # NaN in, NaN out
            k = lane
            while k < count:
                force[int(contacts[first + k])] = rr
                k += stride
        if lane == 0:
            report[component] = wp.where(running, -iteration, iteration)
            error[component] = wp.sqrt(rr)


@wp.kernel(enable_backward=False)
def displacement(
    # Model:
    start: wp.array[wp.int32],
    vertex_component: wp.array[wp.int32],
    base: wp.array[wp.int64],
    local: wp.array[wp.int32],
    compliance: wp.array[wp.float32],
    # In:
    contact_end: wp.array[wp.int32],
    contacts: wp.array[wp.int64],
    normal: wp.array[wp.vec3d],
    force: wp.array[wp.float64],
    # Out:
    increment: wp.array[wp.vec3d],
):
    """D = Z N y, a vertex per thread; zero without contacts, untouched without a compliance matrix."""
    i = wp.tid()
    component = vertex_component[i]
    if base[component] >= wp.int64(0):
        first = wp.int32(0)
        if start[component] > 0:
            first = contact_end[start[component] - 1]
        pitch = wp.int64((start[component + 1] - start[component] + 15) / 16) * wp.int64(16)
        d = wp.vec3d()
        for m in range(first, contact_end[start[component + 1] - 1]):
            j = int(contacts[m])
            z = compliance[base[component] + wp.int64(local[j]) * pitch + wp.int64(local[i])]
            d += wp.float64(z) * force[j] * normal[j]
        increment[i] = d


@wp.kernel(enable_backward=False)
def response(
    from_row: wp.int32,
    by_rows: wp.int32,
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    vertex_component: wp.array[wp.int32],
    base: wp.array[wp.int64],
    local: wp.array[wp.int32],
    compliance: wp.array[wp.float32],
    # In:
    normal: wp.array[wp.vec3d],
    load: wp.array[wp.vec3d],
    # Out:
    gap: wp.array[wp.float64],
):
    """n·(Z g) at the contacts, what the adjoint has in place of c."""
    i = from_row + wp.tid()
    component = vertex_component[i]
    n = normal[i]
    h = wp.float64(0.0)
    if base[component] >= wp.int64(0) and wp.dot(n, n) > h:
        pitch = wp.int64((start[component + 1] - start[component] + 15) / 16) * wp.int64(16)
        for m in range(start[component], start[component + 1]):
            j = rows[m]
            along = wp.int64(local[i])
            down = wp.int64(local[j])
            if by_rows != 0:  # Z is symmetric: a CPU reads a row, the threads of a GPU read next to each other
                along = wp.int64(local[j])
                down = wp.int64(local[i])
            z = compliance[base[component] + down * pitch + along]
            h += wp.float64(z) * wp.dot(n, load[j])
    gap[i] = h


def list_contacts(system: System, normal: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Contacts sorted by component, without waiting for the device.

    Returns:
        int32 [V], the number of contacts among the first vertices of `system.rows`; int64 [V+1], the contacts.
    """
    rows = system.rows.long()
    touching = (normal != 0).any(dim=1)[rows]
    end = touching.cumsum(0)
    contacts = torch.zeros(len(rows) + 1, dtype=torch.int64, device=rows.device)
    contacts.scatter_(0, torch.where(touching, end - 1, len(rows)), rows)
    return end.to(torch.int32), contacts


def solve(
    system: System,
    model: Compliance,
    listed: tuple[torch.Tensor, torch.Tensor],
    normal: torch.Tensor,
    gap: torch.Tensor,
    tolerance: torch.Tensor,
    relative: float,
    max_iterations: int,
    report: torch.Tensor,
    error: torch.Tensor,
) -> torch.Tensor:
    """Contact forces y, float64 [V], zero without contact; writes `report` and `error` of components with a matrix."""
    end, contacts = listed
    vertices, count = len(normal), len(model.base)
    coupling = allocate((model.scratch,), torch.float32, normal.device)
    work = allocate((3, vertices), torch.float64, normal.device)
    force = torch.zeros(vertices, dtype=torch.float64, device=normal.device)
    with torch_stream(normal.device) as device:
        wp.launch_tiled(
            solve_contacts,
            dim=[count],
            inputs=[
                as_argument(system.start, wp.int32),
                as_argument(model.base, wp.int64),
                as_argument(model.room, wp.int64),
                as_argument(model.local, wp.int32),
                as_argument(model.values, wp.float32),
                as_argument(end, wp.int32),
                as_argument(contacts, wp.int64),
                as_argument(normal, wp.vec3d),
                as_argument(gap, wp.float64),
                as_argument(tolerance, wp.float64),
                float(relative),
                int(max_iterations),
                as_argument(coupling, wp.float32),
                *(as_argument(vector, wp.float64) for vector in work),
                as_argument(force, wp.float64),
                as_argument(report, wp.int32),
                as_argument(error, wp.float64),
            ],
            block_dim=block_dim(normal.device, vertices, count),
            device=device,
        )
    return force


def displace(
    system: System,
    model: Compliance,
    vertex_component: torch.Tensor,
    listed: tuple[torch.Tensor, torch.Tensor],
    normal: torch.Tensor,
    force: torch.Tensor,
    increment: torch.Tensor,
) -> None:
    """Writes D = Z N y, float64 [V,3], for the components with a compliance matrix."""
    with torch_stream(normal.device) as device:
        wp.launch(
            displacement,
            dim=len(normal),
            inputs=[
                as_argument(system.start, wp.int32),
                as_argument(vertex_component, wp.int32),
                as_argument(model.base, wp.int64),
                as_argument(model.local, wp.int32),
                as_argument(model.values, wp.float32),
                as_argument(listed[0], wp.int32),
                as_argument(listed[1], wp.int64),
                as_argument(normal, wp.vec3d),
                as_argument(force, wp.float64),
                as_argument(increment, wp.vec3d),
            ],
            device=device,
        )


def respond(
    system: System, model: Compliance, vertex_component: torch.Tensor, normal: torch.Tensor, load: torch.Tensor
) -> torch.Tensor:
    """n·(Z g) at the contacts, float64 [V], for a load g, float64 [V,3]; zero elsewhere."""
    gap = allocate((len(normal),), torch.float64, normal.device)
    with torch_stream(normal.device) as device:
        launch_rows(
            response,
            len(normal),
            [
                int(device.is_cpu),
                as_argument(system.start, wp.int32),
                as_argument(system.rows, wp.int32),
                as_argument(vertex_component, wp.int32),
                as_argument(model.base, wp.int64),
                as_argument(model.local, wp.int32),
                as_argument(model.values, wp.float32),
                as_argument(normal, wp.vec3d),
                as_argument(load, wp.vec3d),
            ],
            [as_argument(gap, wp.float64)],
            device,
        )
    return gap
