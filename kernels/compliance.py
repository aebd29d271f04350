"""Contact forces on a garment whose compliance matrix is known: the small side of the collision refinement.

Supplement section 2 asks for (B ⊗ I₃ + N Nᵀ) D = N c, with one column of N, holding n_i, per contact. B is constant per
garment; with its inverse Z, the compliance, the unknowns shrink from three per vertex to one per contact,

    (I + S) y = c,    S_ij = n_i·n_j Z_ij,    D = Z N y

(push-through identity), where y_i = c_i - n_i·D_i is the force of contact i. Conjugate gradients with Jacobi solve it
in tens of steps where the system for D takes hundreds. Their error in the energy norm bounds that of D:
|δD|_B² = δyᵀ S δy ≤ δyᵀ (I + S) δy. Z is dense, so this is for components of moderate size; the rest go to cg.py.

| symbol | code | what |
| --- | --- | --- |
| Z | `compliance` | float32, one block per component, one after the other; equal components share a block |
| n_i | `normal` | [V,3]; zero where there is no contact |
| c_i | `gap` | [V], what is missing along the normal |
| y_i | `force` | [V], zero where there is no contact |
| S | `coupling` | float32 scratch, in the layout of Z |
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch
import warp as wp

from . import cg
from ._operator import allocate
from ._torch import torch_stream

LARGEST = 2048
"""Vertices of the largest component that gets a compliance matrix (16 MB)."""
BUDGET = 2**28
"""Entries of all compliance matrices of a batch together (1 GiB, and as much for scratch while solving)."""


class Compliance(NamedTuple):
    """Compliance matrices of a packed batch, on one device."""

    base: torch.Tensor
    """int64 [C], where the block of a component begins; -1 for a component without one."""
    room: torch.Tensor
    """int64 [C], where the scratch of a component begins; components never share it."""
    sizes: torch.Tensor
    """int64 [3] on the host: entries of the scratch, components with a block, components without."""
    local: torch.Tensor
    """int32 [V], index of a vertex within its component."""
    values: torch.Tensor
    """float32, the blocks, row by row."""

    @classmethod
    def build(cls, matrix: scipy.sparse.csr_matrix, system: cg.System, largest: int, budget: int) -> Compliance:
        """Inverts the diagonal blocks of B, [V,V], that are small enough, until the budget is used up."""
        device = system.value.device
        rows, start = system.rows.cpu().numpy(), system.start.cpu().numpy()
        local = np.empty(len(rows), np.int32)
        sizes = np.diff(start)
        local[rows] = np.arange(len(rows)) - np.repeat(start[:-1], sizes)
        matrix = matrix.tocsr()[rows]
        base, room = np.full(len(sizes), -1, np.int64), np.zeros(len(sizes), np.int64)
        blocks: list[torch.Tensor] = []
        known: dict[tuple, int] = {}
        used = needed = 0
        for c, size in enumerate(sizes):
            if size > largest or needed + size * size > budget:
                continue
            first, last = matrix.indptr[start[c]], matrix.indptr[start[c + 1]]
            columns, data = local[matrix.indices[first:last]], matrix.data[first:last]
            pointer = matrix.indptr[start[c] : start[c + 1] + 1] - first
            key = (pointer.tobytes(), columns.tobytes(), data.tobytes())
            if key not in known:
                dense = np.zeros((size, size))
                dense[np.repeat(np.arange(size), np.diff(pointer)), columns] = data
                lower = torch.linalg.cholesky(torch.from_numpy(dense).to(device))
                inverse = torch.cholesky_inverse(lower)
                blocks.append((0.5 * (inverse + inverse.T)).to(torch.float32).ravel())
                known[key], used = used, used + int(size) ** 2
            base[c], room[c], needed = known[key], needed, needed + int(size) ** 2
        values = torch.cat(blocks) if blocks else torch.empty(0, dtype=torch.float32, device=device)
        device_side = (torch.from_numpy(a).to(device) for a in (base, room))
        counts = torch.tensor([needed, (base >= 0).sum(), (base < 0).sum()])
        return cls(*device_side, counts, torch.from_numpy(local).to(device), values)


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
    """(I + S) y = c for one component, from zero; stops as `cg.conjugate_gradients` does."""
    component, lane = wp.tid()
    if base[component] >= wp.int64(0):
        first = wp.int32(0)
        if start[component] > 0:
            first = contact_end[start[component] - 1]
        count = wp.int32(0)
        if start[component + 1] > start[component]:
            count = contact_end[start[component + 1] - 1] - first
        size = wp.int64(start[component + 1] - start[component])
        stride = wp.block_dim()
        zero = wp.float64(0.0)
        one = wp.float64(1.0)

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
                z = compliance[base[component] + wp.int64(local[j]) * size + wp.int64(local[i])]
                slot = room[component] + wp.int64(k) * wp.int64(across) + wp.int64(m) * wp.int64(along)
                coupling[slot] = wp.float32(wp.dot(normal[i], normal[j])) * z
            k += stride

        rz = wp.float64(0.0)
        k = lane
        while k < count:
            i = int(contacts[first + k])
            c = gap[i]
            d = wp.float64(coupling[room[component] + wp.int64(k) * (wp.int64(count) + wp.int64(1))]) + one
            force[i] = zero
            residual[first + k] = c
            direction[first + k] = c / d
            rz += c * c / d
            k += stride
        rz = cg.block_sum(rz)

        goal = tolerance[component] * tolerance[component]
        total = wp.float64(0.0)
        window = wp.float64(0.0)
        previous = wp.float64(0.0)
        left = wp.float64(0.0)
        iteration = wp.int32(0)
        running = rz > zero
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
            pq = cg.block_sum(pq)
            alpha = zero
            if pq > zero:
                alpha = rz / pq

            rz_next = wp.float64(0.0)
            k = lane
            while k < count:
                i = int(contacts[first + k])
                d = wp.float64(coupling[room[component] + wp.int64(k) * (wp.int64(count) + wp.int64(1))]) + one
                force[i] = force[i] + alpha * direction[first + k]
                r = residual[first + k] - alpha * image[first + k]
                residual[first + k] = r
                rz_next += r * r / d
                k += stride
            rz_next = cg.block_sum(rz_next)

            beta = rz_next / rz
            k = lane
            while k < count:
                d = wp.float64(coupling[room[component] + wp.int64(k) * (wp.int64(count) + wp.int64(1))]) + one
                direction[first + k] = residual[first + k] / d + beta * direction[first + k]
                k += stride

            window += alpha * rz
            total += alpha * rz
            iteration += 1
            running = rz_next > zero and alpha > zero
            if iteration % cg._WINDOW == 0:
                rate = wp.float64(0.98)
                if previous > zero:
                    rate = wp.min(window / previous, rate)
                left = window * rate / (one - rate)
                running = running and left > wp.max(goal, relative * relative * total)
                previous = window
                window = zero
            rz = cg.block_sum(rz_next) / wp.float64(stride)

        if not (rz >= zero):  # NaN in, NaN out
            k = lane
            while k < count:
                force[int(contacts[first + k])] = rz
                k += stride
        if lane == 0:
            report[component] = wp.where(running, -iteration, iteration)
            error[component] = wp.sqrt(wp.max(left, window))


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
        size = wp.int64(start[component + 1] - start[component])
        d = wp.vec3d()
        for m in range(first, contact_end[start[component + 1] - 1]):
            j = int(contacts[m])
            z = compliance[base[component] + wp.int64(local[j]) * size + wp.int64(local[i])]
            d += wp.float64(z) * force[j] * normal[j]
        increment[i] = d


@wp.kernel(enable_backward=False)
def response(
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
    i = wp.tid()
    component = vertex_component[i]
    n = normal[i]
    h = wp.float64(0.0)
    if base[component] >= wp.int64(0) and wp.dot(n, n) > h:
        size = wp.int64(start[component + 1] - start[component])
        for m in range(start[component], start[component + 1]):
            j = rows[m]
            z = compliance[base[component] + wp.int64(local[j]) * size + wp.int64(local[i])]
            h += wp.float64(z) * wp.dot(n, load[j])
    gap[i] = h


def list_contacts(system: cg.System, normal: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
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
    system: cg.System,
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
    """Contact forces y, float64 [V], zero without contact. Writes iterations and error of the components it solves."""
    end, contacts = listed
    vertices, count = len(normal), len(model.base)
    coupling = allocate((int(model.sizes[0]),), torch.float32, normal.device)
    work = allocate((3, vertices), torch.float64, normal.device)
    force = torch.zeros(vertices, dtype=torch.float64, device=normal.device)
    with torch_stream(normal.device) as device:
        wp.launch_tiled(
            solve_contacts,
            dim=[count],
            inputs=[
                cg.view(system.start, wp.int32),
                cg.view(model.base, wp.int64),
                cg.view(model.room, wp.int64),
                cg.view(model.local, wp.int32),
                cg.view(model.values, wp.float32),
                cg.view(end, wp.int32),
                cg.view(contacts, wp.int64),
                cg.view(normal, wp.vec3d),
                cg.view(gap, wp.float64),
                cg.view(tolerance, wp.float64),
                float(relative),
                int(max_iterations),
                cg.view(coupling, wp.float32),
                *(cg.view(vector, wp.float64) for vector in work),
                cg.view(force, wp.float64),
                cg.view(report, wp.int32),
                cg.view(error, wp.float64),
            ],
            block_dim=cg.block_dim(normal.device, vertices, count),
            device=device,
        )
    return force


def displace(
    system: cg.System,
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
                cg.view(system.start, wp.int32),
                cg.view(vertex_component, wp.int32),
                cg.view(model.base, wp.int64),
                cg.view(model.local, wp.int32),
                cg.view(model.values, wp.float32),
                cg.view(listed[0], wp.int32),
                cg.view(listed[1], wp.int64),
                cg.view(normal, wp.vec3d),
                cg.view(force, wp.float64),
                cg.view(increment, wp.vec3d),
            ],
            device=device,
        )


def respond(
    system: cg.System, model: Compliance, vertex_component: torch.Tensor, normal: torch.Tensor, load: torch.Tensor
) -> torch.Tensor:
    """n·(Z g) at the contacts, float64 [V]; `load` is g, float64 [V,3]."""
    gap = allocate((len(normal),), torch.float64, normal.device)
    with torch_stream(normal.device) as device:
        wp.launch(
            response,
            dim=len(normal),
            inputs=[
                cg.view(system.start, wp.int32),
                cg.view(system.rows, wp.int32),
                cg.view(vertex_component, wp.int32),
                cg.view(model.base, wp.int64),
                cg.view(model.local, wp.int32),
                cg.view(model.values, wp.float32),
                cg.view(normal, wp.vec3d),
                cg.view(load, wp.vec3d),
                cg.view(gap, wp.float64),
            ],
            device=device,
        )
    return gap
