"""Rows of the compliance Z = B⁻¹ of large components, made when a vertex is in contact for the first time, on a CPU.

A component of thousands of vertices has some hundred contacts, at much the same vertices from frame to frame, and the
forces depend only on the rows of Z at these (compliance.py). A row is one solve with the factor of B, for eight
vertices at once: x = B⁻¹ e_i by the two sweeps of linear/triangular.py, in float64, with a vertex in each lane. The
sweep upwards passes over the panels that the eight reach in the elimination tree only.

Rows are kept until there is no room for those of a solve; then all of a component are dropped. A row is the same
whenever and with whichever others it is made, so results do not depend on what was kept.

| symbol | code | what |
| --- | --- | --- |
| Z_i | row `slot` of `values` | float32, padded to a multiple of sixteen |
| B = L D Lᵀ | `factor.Factor` | |
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, torch_stream
from warpgarment.kernels.linear.factor import Factor
from warpgarment.kernels.linear.system import System
from warpgarment.kernels.linear.triangular import substitution
from warpgarment.kernels.operator import allocate

wp.set_module_options(compiling.options())

BUDGET = 2**26
"""Largest number of entries of the rows of a batch (256 MiB)."""
GROUPS = 24
"""Number of groups of eight vertices that are solved in one launch."""
CPU = torch.device("cpu")
vec8d = wp.types.vector(length=8, dtype=wp.float64)


class Rows(NamedTuple):
    """Rows of compliance matrices of a packed batch, on the host. Equal components share them; what is kept changes."""

    block: torch.Tensor
    """int32 [C], number of the rows' block of each component; -1 for a component without rows."""
    room: torch.Tensor
    """int64 [N], first entry of each block in `values`."""
    capacity: torch.Tensor
    """int32 [N], number of rows for which there is room."""
    used: torch.Tensor
    """int32 [N], number of rows that are kept."""
    key: torch.Tensor
    """int64 [V], place of each vertex in `slot`; -1 in a component without rows."""
    slot: torch.Tensor
    """int32 [R], number of the row of each vertex in its block; -1 where it is not kept."""
    wide: torch.Tensor
    """int32 [C], first panel of each component, where its vertices are divided into padded panels of sixteen."""
    panels: int
    """Number of panels of all components."""
    values: torch.Tensor
    """float32, the blocks, row by row."""

    @classmethod
    def build(cls, system: System, factor: Factor, budget: int) -> Rows:
        """Room for the rows of the components that have a factor, as far as `budget` entries go; no rows yet."""
        base, start, rows = (t.cpu().numpy() for t in (factor.base, system.start, system.rows))
        sizes = np.diff(start)
        bases, first, block = np.unique(base, return_index=True, return_inverse=True)
        block = block.reshape(-1) - np.count_nonzero(bases < 0)
        first = first[bases >= 0]
        pitch = _pitch(sizes[first])
        capacity = np.minimum(sizes[first], budget // max(1, len(first)) // np.maximum(pitch, 1))
        key = np.empty(len(rows), np.int64)
        local = np.arange(len(rows)) - np.repeat(start[:-1], sizes)
        key[rows] = np.where(np.repeat(base, sizes) < 0, -1, np.repeat(base, sizes) + local)
        panels = np.append(0, np.cumsum(_pitch(sizes) // 16))
        ends = np.append(0, np.cumsum(capacity.astype(np.int64) * pitch))
        host = (
            block.astype(np.int32),
            ends[:-1],
            capacity.astype(np.int32),
            np.zeros(len(first), np.int32),
            key,
            np.full(len(factor.order), -1, np.int32),
            panels[:-1].astype(np.int32),
        )
        values = torch.from_numpy(np.empty(int(ends[-1]), np.float32))  # takes memory only where rows are written
        of_component, begins, most, used, keys, slot, wide = (torch.from_numpy(a) for a in host)
        return cls(of_component, begins, most, used, keys, slot, wide, panels=int(panels[-1]), values=values)


class Lines(NamedTuple):
    """Where the rows of the contacts of one solve are."""

    base: torch.Tensor
    """int64 [C], first entry of the block of each component in `Rows.values`; -1 for one that has too many contacts."""
    scratch: torch.Tensor
    """int64 [C], first entry of the scratch of each component, for the couplings of its contacts."""
    entries: int
    """Number of entries of that scratch."""


@wp.kernel(enable_backward=False)
def compliance_rows(
    from_row: wp.int32,
    # Model:
    pivot: wp.array[wp.vec4d],
    triangle: wp.array[wp.mat44d],
    pointer: wp.array[wp.int32],
    row: wp.array[wp.int32],
    value: wp.array[wp.vec4d],
    order: wp.array[wp.int32],
    # In:
    base: wp.array[wp.int32],  # where the component of each group begins in `order`
    count: wp.array[wp.int32],  # its number of panels
    places: wp.array2d[wp.int32],  # of eight vertices, within the component; -1 where there are fewer
    target: wp.array2d[wp.int64],  # first entry of each of the eight rows
    # Work:
    reached: wp.array2d[wp.int32],
    x: wp.array2d[vec8d],
    # Out:
    values: wp.array[wp.float32],
):
    """Eight rows, in a thread."""
    g = from_row + wp.tid()
    b = base[g]
    panels = count[g]
    for q in range(panels):
        reached[g, q] = 0
    for k in range(4 * panels):
        x[g, k] = vec8d()
    for lane in range(8):
        k = places[g, lane]
        if k >= 0:
            unit = x[g, k]
            unit[lane] = wp.float64(1.0)
            x[g, k] = unit
            reached[g, k / 4] = 1
    for q in range(panels):
        if reached[g, q] != 0:
            t = triangle[b / 4 + q]
            x0 = x[g, 4 * q]
            x1 = x[g, 4 * q + 1] - t[1, 0] * x0
            x2 = x[g, 4 * q + 2] - t[2, 0] * x0 - t[2, 1] * x1
            x3 = x[g, 4 * q + 3] - t[3, 0] * x0 - t[3, 1] * x1 - t[3, 2] * x2
            e = pointer[b / 4 + q]
            while e < pointer[b / 4 + q + 1]:
                v = value[e]
                j = row[e]
                x[g, j] = (x[g, j] - v[0] * x0 - v[1] * x1) - (v[2] * x2 + v[3] * x3)
                reached[g, j / 4] = 1
                e += 1
            d = pivot[b / 4 + q]
            x[g, 4 * q] = d[0] * x0
            x[g, 4 * q + 1] = d[1] * x1
            x[g, 4 * q + 2] = d[2] * x2
            x[g, 4 * q + 3] = d[3] * x3
    for m in range(panels):
        q = panels - 1 - m
        x0 = x[g, 4 * q]
        x1 = x[g, 4 * q + 1]
        x2 = x[g, 4 * q + 2]
        x3 = x[g, 4 * q + 3]
        e = pointer[b / 4 + q]
        while e < pointer[b / 4 + q + 1]:
            v = value[e]
            s = x[g, row[e]]
            x0 = x0 - v[0] * s
            x1 = x1 - v[1] * s
            x2 = x2 - v[2] * s
            x3 = x3 - v[3] * s
            e += 1
        t = triangle[b / 4 + q]
        x2 = x2 - t[3, 2] * x3
        x1 = x1 - t[2, 1] * x2 - t[3, 1] * x3
        x0 = x0 - t[1, 0] * x1 - t[2, 0] * x2 - t[3, 0] * x3
        x[g, 4 * q] = x0
        x[g, 4 * q + 1] = x1
        x[g, 4 * q + 2] = x2
        x[g, 4 * q + 3] = x3
    for lane in range(8):
        if places[g, lane] >= 0:
            for k in range(4 * panels):
                if order[b + k] >= 0:
                    values[target[g, lane] + wp.int64(order[b + k])] = wp.float32(x[g, k][lane])


def lines_of(system: System, factor: Factor, rows: Rows, vertex_component: torch.Tensor, normal: torch.Tensor) -> Lines:
    """Makes the rows of Z that the contacts of a solve need.

    Args:
        system: Division of the vertices into components.
        factor: Factor of B, in the form for substitution.
        rows: The rows that are kept, to which new ones are added in place.
        vertex_component: Component of each vertex, int32 [V].
        normal: n, float64 [V,3], zero at vertices without contact.
    """
    block, room, capacity, used, key, slot = (t.numpy() for t in rows[:6])
    start = system.start.numpy()
    n = normal.numpy()
    touching = np.flatnonzero((n[:, 0] != 0) | (n[:, 1] != 0) | (n[:, 2] != 0))
    owner, keys = vertex_component.numpy()[touching], key[touching]
    owner, keys = owner[keys >= 0], keys[keys >= 0]
    wanted, first = np.unique(keys, return_index=True)
    of_block = block[owner[first]]
    fits = np.append(np.bincount(of_block, minlength=len(room)) <= capacity, False)  # the last: no block
    wanted, of_block, first = (a[fits[of_block]] for a in (wanted, of_block, first))
    missing = slot[wanted] < 0
    full = used + np.bincount(of_block[missing], minlength=len(room)) > capacity
    for number in np.nonzero(full & fits[:-1])[0]:
        begin = factor.base.numpy()[np.nonzero(block == number)[0][0]]
        slot[begin : begin + 4 * ((np.diff(start)[block == number][0] + 3) // 4)] = -1
        used[number] = 0
    missing = slot[wanted] < 0
    if missing.any():
        _make(system, factor, rows, wanted[missing], owner[first[missing]], of_block[missing])
    contacts = np.bincount(owner, minlength=len(block))
    contacts[~fits[block]] = 0
    ends = np.append(0, np.cumsum(_pitch(contacts) * contacts.astype(np.int64)))
    base = np.where(fits[block], np.append(room, -1)[block], -1)
    return Lines(torch.from_numpy(base), torch.from_numpy(ends[:-1].copy()), int(ends[-1]))


def _make(
    system: System, factor: Factor, rows: Rows, keys: np.ndarray, owner: np.ndarray, of_block: np.ndarray
) -> None:
    """Makes rows: `keys` are places in `Rows.slot`, sorted, with a component and a block of each."""
    _, room, _, used, _, slot = (t.numpy() for t in rows[:6])
    base, sizes = factor.base.numpy(), np.diff(system.start.numpy())
    place_of = np.empty(len(slot), np.int64)
    elimination = factor.order.numpy()
    groups, targets, begins, counts = [], [], [], []
    for number in np.unique(of_block):
        mine = keys[of_block == number]
        component = owner[of_block == number][0]
        begin, size = int(base[component]), int(sizes[component])
        padded = 4 * ((size + 3) // 4)
        here = elimination[begin : begin + padded]
        place_of[begin + here[here >= 0]] = np.nonzero(here >= 0)[0]
        mine = mine[np.argsort(place_of[mine])]
        slot[mine] = used[number] + np.arange(len(mine))
        used[number] += len(mine)
        short = -len(mine) % 8
        groups.append(np.append(place_of[mine], np.full(short, -1)))
        targets.append(np.append(room[number] + slot[mine].astype(np.int64) * _pitch(size), np.zeros(short, np.int64)))
        begins += [begin] * (len(groups[-1]) // 8)
        counts += [padded // 4] * (len(groups[-1]) // 8)
    places = np.concatenate(groups).astype(np.int32).reshape(-1, 8)
    target, length = np.concatenate(targets).reshape(-1, 8), 4 * max(counts)
    work = allocate((min(GROUPS, len(places)), length, 8), torch.float64, CPU)
    reached = allocate((len(work), length // 4), torch.int32, CPU)
    _, _, order, *sweeps = substitution(factor)
    with torch_stream(CPU) as device:
        for at in range(0, len(places), GROUPS):
            part = slice(at, at + GROUPS)
            given = [
                torch.from_numpy(np.ascontiguousarray(values))
                for values in (
                    np.array(begins[part], np.int32),
                    np.array(counts[part], np.int32),
                    places[part],
                    target[part],
                )
            ]
            inputs = [*sweeps, order] + [
                as_argument(tensor, kind) for tensor, kind in zip(given, (wp.int32,) * 3 + (wp.int64,), strict=True)
            ]
            outputs = [as_argument(reached, wp.int32), as_argument(work, vec8d), as_argument(rows.values, wp.float32)]
            launch_rows(compliance_rows, len(given[0]), inputs, outputs, device, least=1)


def _pitch(size: int | np.ndarray) -> int | np.ndarray:
    """Number of entries of a padded row, a multiple of sixteen."""
    return (size + 15) // 16 * 16
