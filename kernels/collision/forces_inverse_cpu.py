"""Contact forces through compliance matrices on one CPU core, with vector instructions for sixteen contacts.

The equations are those of compliance.py. S and Z are read in panels of sixteen rows, in vectors of sixteen float32,
which Warp's CPU backend compiles to vector instructions (a product with S takes a tenth of the time of a scalar loop).
One launch, with a thread per component, lists the contacts, computes S, solves, and computes the displacements.

Z is that of compliance.py, with all rows, or has the rows of the contacts only, from compliance_rows.py.

The stopping criterion is that of forces_factor_cpu.py: |c - (I + S) y|, which bounds the error in the energy norm.

| symbol | code | what |
| --- | --- | --- |
| Z | `compliance` | rows padded to a multiple of sixteen, see `compliance.Compliance` |
| S | `panels` | [panel, contact] of sixteen, at `room` |
| n_i | `nx, ny, nz` | in panels of contacts, from `wide` on; zero in padding |
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, torch_stream
from warpgarment.kernels.linear.conjugate_gradients import after_step
from warpgarment.kernels.linear.factor import Factor
from warpgarment.kernels.linear.system import System
from warpgarment.kernels.operator import allocate

from .compliance import Compliance
from .compliance_rows import Lines, Rows

vec16 = wp.types.vector(length=16, dtype=wp.float32)
wp.set_module_options(
    compiling.options(max_unroll=1)
)  # unrolled loops over sixteen would compile longer and run no faster


@wp.kernel(enable_backward=False)
def wide_contacts(
    from_row: wp.int32,
    # Model:
    start: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    base: wp.array[wp.int64],
    room: wp.array[wp.int64],
    wide: wp.array[wp.int32],
    compliance: wp.array[wp.float32],
    compliance_panels: wp.array[vec16],
    line_base: wp.array[wp.int32],
    line_of: wp.array[wp.int32],  # row of Z of each vertex, from `line_base` on; empty: all rows are there
    # In:
    normal: wp.array[wp.vec3d],
    gap: wp.array[wp.float64],
    tolerance: wp.array[wp.float64],
    relative: wp.float64,
    max_iterations: wp.int32,
    # Work:
    panels: wp.array[vec16],
    place: wp.array[wp.int32],
    line: wp.array[wp.int32],
    nx: wp.array[vec16],
    ny: wp.array[vec16],
    nz: wp.array[vec16],
    image: wp.array[vec16],
    dx: wp.array[vec16],
    dy: wp.array[vec16],
    dz: wp.array[vec16],
    residual: wp.array[wp.float64],
    direction: wp.array[wp.float64],
    solution: wp.array[wp.float64],
    # Out:
    force: wp.array[wp.float64],
    increment: wp.array[wp.vec3d],
    report: wp.array[wp.int32],
    error: wp.array[wp.float64],
):
    """Forces and displacements of one component; those without a compliance matrix are left as they are."""
    thread, _ = wp.tid()  # see compiling.py
    component = from_row + thread
    if base[component] >= wp.int64(0):
        first = start[component]
        size = start[component + 1] - first
        pitch = wp.int64((size + 15) / 16) * wp.int64(16)
        scratch = int(room[component] / wp.int64(16))
        zero = wp.float64(0.0)

        # The contacts.
        front = wide[component]
        slot = 16 * front
        count = wp.int32(0)
        rr = zero
        x = vec16()
        y = vec16()
        z = vec16()
        for k in range(size):
            i = rows[first + k]
            n = normal[i]
            force[i] = zero
            increment[i] = wp.vec3d()
            if n[0] != zero or n[1] != zero or n[2] != zero:
                c = gap[i]
                place[slot + count] = k
                line[slot + count] = k
                if line_of.shape[0] > 0:
                    line[slot + count] = line_of[line_base[component] + k]
                residual[first + count] = c
                direction[first + count] = c
                solution[first + count] = zero
                rr += c * c
                r = count % 16
                if r == 0:
                    x = vec16()
                    y = vec16()
                    z = vec16()
                x[r] = wp.float32(n[0])
                y[r] = wp.float32(n[1])
                z[r] = wp.float32(n[2])
                nx[front + count / 16] = x
                ny[front + count / 16] = y
                nz[front + count / 16] = z
                count += 1
        used = (count + 15) / 16
        for m in range(count, 16 * used):
            place[slot + m] = 0

        # S, by panels. A row of Z is read once, since rows are far apart.
        for m in range(count):
            row = base[component] + wp.int64(line[slot + m]) * pitch
            other = front + m / 16
            r = m % 16
            across = nx[other][r]
            up = ny[other][r]
            along = nz[other][r]
            for panel in range(used):
                v = vec16()
                for q in range(16):
                    v[q] = compliance[row + wp.int64(place[slot + 16 * panel + q])]
                cosine = across * nx[front + panel] + up * ny[front + panel] + along * nz[front + panel]
                panels[scratch + panel * count + m] = wp.cw_mul(cosine, v)

        goal = tolerance[component] * tolerance[component]
        total = zero
        iteration = wp.int32(0)
        running = rr > goal
        while running and iteration < max_iterations:
            for panel in range(used):
                out = scratch + panel * count
                s0 = vec16()
                s1 = vec16()
                s2 = vec16()
                s3 = vec16()
                m = wp.int32(0)
                while m + 3 < count:
                    s0 += panels[out + m] * wp.float32(direction[first + m])
                    s1 += panels[out + m + 1] * wp.float32(direction[first + m + 1])
                    s2 += panels[out + m + 2] * wp.float32(direction[first + m + 2])
                    s3 += panels[out + m + 3] * wp.float32(direction[first + m + 3])
                    m += 4
                while m < count:
                    s0 += panels[out + m] * wp.float32(direction[first + m])
                    m += 1
                image[front + panel] = (s0 + s1) + (s2 + s3)
            pq = zero
            for m in range(count):
                p = direction[first + m]
                pq += p * (p + wp.float64(image[front + m / 16][m % 16]))
            alpha = rr / pq
            rr_next = zero
            for m in range(count):
                p = direction[first + m]
                solution[first + m] = solution[first + m] + alpha * p
                rest = residual[first + m] - alpha * (p + wp.float64(image[front + m / 16][m % 16]))
                residual[first + m] = rest
                rr_next += rest * rest
            beta, total, running = after_step(rr, rr_next, alpha, total, goal, relative)
            for m in range(count):
                direction[first + m] = residual[first + m] + beta * direction[first + m]
            rr = rr_next
            iteration += 1
        if not (rr >= zero):  # NaN in, NaN out
            for m in range(count):
                solution[first + m] = rr

        # D = Z N y, sixteen vertices at a time.
        for m in range(count):
            force[rows[first + place[slot + m]]] = solution[first + m]
        if count > 0:
            size_in_panels = (size + 15) / 16
            for panel in range(size_in_panels):
                dx[front + panel] = vec16()
                dy[front + panel] = vec16()
                dz[front + panel] = vec16()
            for m in range(count):
                at = int((base[component] + wp.int64(line[slot + m]) * pitch) / wp.int64(16))
                y_m = wp.float32(solution[first + m])
                across = nx[front + m / 16][m % 16]
                up = ny[front + m / 16][m % 16]
                along = nz[front + m / 16][m % 16]
                for panel in range(size_in_panels):
                    v = compliance_panels[at + panel] * y_m
                    dx[front + panel] = dx[front + panel] + across * v
                    dy[front + panel] = dy[front + panel] + up * v
                    dz[front + panel] = dz[front + panel] + along * v
            for panel in range(size_in_panels):
                for r in range(16):
                    if 16 * panel + r < size:
                        d = wp.vec3d(
                            wp.float64(dx[front + panel][r]),
                            wp.float64(dy[front + panel][r]),
                            wp.float64(dz[front + panel][r]),
                        )
                        increment[rows[first + 16 * panel + r]] = d
        report[component] = wp.where(running, -iteration, iteration)
        error[component] = wp.sqrt(rr)


def solve(
    system: System,
    model: Compliance,
    normal: torch.Tensor,
    gap: torch.Tensor,
    tolerance: torch.Tensor,
    relative: float,
    max_iterations: int,
    increment: torch.Tensor,
    report: torch.Tensor,
    error: torch.Tensor,
) -> torch.Tensor:
    """Forces y, float64 [V], of the components with a compliance matrix; arguments as in `forces_factor_cpu.solve`."""
    empty = torch.empty(0, dtype=torch.int32)
    found = _Inverse(model.base, model.room, model.wide, model.values, empty, empty, model.scratch, model.panels)
    return _solve(system, found, normal, gap, tolerance, relative, max_iterations, increment, report, error)


def solve_by_rows(
    system: System,
    factor: Factor,
    rows: Rows,
    lines: Lines,
    normal: torch.Tensor,
    gap: torch.Tensor,
    tolerance: torch.Tensor,
    relative: float,
    max_iterations: int,
    increment: torch.Tensor,
    report: torch.Tensor,
    error: torch.Tensor,
) -> torch.Tensor:
    """The same of the components whose contacts have rows, the result `lines` of `compliance_rows.lines_of`."""
    found = _Inverse(
        lines.base, lines.scratch, rows.wide, rows.values, factor.base, rows.slot, lines.entries, rows.panels
    )
    return _solve(system, found, normal, gap, tolerance, relative, max_iterations, increment, report, error)


class _Inverse(NamedTuple):
    base: torch.Tensor
    room: torch.Tensor
    wide: torch.Tensor
    values: torch.Tensor
    line_base: torch.Tensor
    line_of: torch.Tensor
    scratch: int
    panels: int


def _solve(
    system: System,
    found: _Inverse,
    normal: torch.Tensor,
    gap: torch.Tensor,
    tolerance: torch.Tensor,
    relative: float,
    max_iterations: int,
    increment: torch.Tensor,
    report: torch.Tensor,
    error: torch.Tensor,
) -> torch.Tensor:
    base, room, wide, values, line_base, line_of, scratch, panels = found
    vertices, device = len(normal), normal.device
    coupling = allocate((scratch,), torch.float32, device)
    place, line = allocate((2, 16 * panels), torch.int32, device)
    vectors = allocate((7, 16 * panels), torch.float32, device)
    scalars = allocate((3, vertices), torch.float64, device)
    force = torch.zeros(vertices, dtype=torch.float64, device=device)

    def of_16(tensor: torch.Tensor) -> object:
        return as_argument(tensor.view(-1, 16), vec16)

    with torch_stream(device) as warp_device:
        launch_rows(
            wide_contacts,
            len(base),
            inputs=[
                as_argument(system.start, wp.int32),
                as_argument(system.rows, wp.int32),
                as_argument(base, wp.int64),
                as_argument(room, wp.int64),
                as_argument(wide, wp.int32),
                as_argument(values, wp.float32),
                of_16(values),
                as_argument(line_base, wp.int32),
                as_argument(line_of, wp.int32),
                as_argument(normal, wp.vec3d),
                as_argument(gap, wp.float64),
                as_argument(tolerance, wp.float64),
                float(relative),
                int(max_iterations),
                of_16(coupling),
                as_argument(place, wp.int32),
                as_argument(line, wp.int32),
                *(of_16(vector) for vector in vectors),
                *(as_argument(vector, wp.float64) for vector in scalars),
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
