"""The search of shortest_paths.py for one block of sources: a scalar search for an order, then vector sweeps.

| symbol | code | what |
| --- | --- | --- |
| w_uv | `pointer, column, length` | edge lengths, CSR, symmetric, int32, in units, at most `FAR` |
| - | `near_pointer, near_column, near_length` | the edges that the order follows, CSR: some, in other units, or all |
| d_v | `distance` | [N * LANES], int32, in units; `FAR` where a source does not reach the node |
| - | `group` | [N], int32, group of each node, from the first source outwards; `FAR` for nodes that are not listed |

The innermost loops are in C++ (`wp.func_native`) on vectors of sixteen int32; on GPUs they do nothing.
"""

from __future__ import annotations

import warp as wp

from warpgarment.kernels import compiling

wp.set_module_options(compiling.options(enable_backward=False))

LANES = 64
GROUP = 64  # nodes that follow each other in the order, and are visited by their place in memory
FAR = wp.constant(2**30 - 1)  # longer than any path; twice as much does not overflow
REGION = wp.constant(2)  # how far the nodes reach that are settled first, in distances of the furthest source
_LANES, _GROUP = wp.constant(LANES), wp.constant(GROUP)


def _native(body: str) -> str:
    """The source of a function on rows of LANES int32, as vectors of sixteen."""
    head = f"""
#if !defined(__CUDA_ARCH__)
    typedef int lanes __attribute__((vector_size(64)));
    constexpr int L = {LANES}, P = {LANES // 16}, far_away = {2**30 - 1};
"""
    return head + body + "\n#else\n    return 0;\n#endif\n"


@wp.func_native(
    _native("""
    lanes* own = (lanes*)distance.data + (long)P * v;
    lanes best[P];
    for (int p = 0; p < P; p++) best[p] = own[p];
    const int of_v = group.data[v], end = pointer.data[v + 1];
    int nodes[64], ways[64];
    for (int e = pointer.data[v]; e < end;) {
        int many = 0;
        for (const int stop = end - e < 64 ? end : e + 64; e < stop; e++) {
            const int u = column.data[e], order = (group.data[u] - of_v) * sign;
            nodes[many] = u;
            ways[many] = length.data[e];
            many += order >= 0;
        }
        for (int i = 0; i < many; i++) {
            const lanes* other = (const lanes*)distance.data + (long)P * nodes[i];
            for (int p = 0; p < P; p++) best[p] = __builtin_elementwise_min(best[p], other[p] + ways[i]);
        }
    }
    lanes changed = {};
    for (int p = 0; p < P; p++) {
        changed |= best[p] ^ own[p];
        own[p] = best[p];
    }
    int any = 0;
    for (int r = 0; r < 16; r++) any |= changed[r];
    return any != 0;
""")
)
def relaxed(
    v: int,
    sign: int,
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    length: wp.array[wp.int32],
    group: wp.array[wp.int32],
    distance: wp.array[wp.int32],
) -> int:
    """Lowers distances of a node to those by way of neighbours; returns whether any changed.

    Neighbours are those in the same group and in later ones (sign 1), in earlier ones (-1), or all (0).
    """
    ...


@wp.func_native(
    _native("""
    for (long i = 0; i < (long)P * count; i++) ((lanes*)distance.data)[i] = lanes{} + far_away;
    return 0;
""")
)
def forget(count: int, distance: wp.array[wp.int32]) -> int:
    """Puts FAR into the rows of the first nodes."""
    ...


@wp.func_native(
    _native("""
    const long width = targets.shape[0];
    const float size = (float)unit;  // a power of two, so that no rounding is added to that of the number of steps
    for (long from = 0; from < width; from += 64) {
        const int many = width - from < 64 ? width - from : 64;
        float tile[L][64];
        for (int t = 0; t < many; t++) {
            const int* own = distance.data + (long)L * targets.data[from + t];
            for (int l = 0; l < L; l++) tile[l][t] = own[l] <= limit ? (float)own[l] * size : __builtin_inff();
        }
        for (int l = 0; l < rows.shape[0]; l++)
            __builtin_memcpy(found.data + width * rows.data[l] + from, tile[l], 4l * many);
    }
    return 0;
""")
)
def read_out(
    limit: int,
    unit: wp.float64,
    targets: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    distance: wp.array[wp.int32],
    found: wp.array2d[wp.float32],
) -> int:
    """Distances of the lanes at the targets, one row of the result for each lane."""
    ...


@wp.func
def rise(hole: int, node: int, heap: wp.array[wp.int32], place: wp.array[wp.int32], near: wp.array[wp.int32]):
    """Inserts a node into the heap at a hole, or above it."""
    at = hole
    key = near[node]
    going = at
    while going > 0:
        parent = (at - 1) / 2
        other = heap[parent]
        going = 0
        if near[other] > key:
            heap[at] = other
            place[other] = at
            at = parent
            going = at
    heap[at] = node
    place[node] = at


@wp.func
def remove_top(size: int, heap: wp.array[wp.int32], place: wp.array[wp.int32], near: wp.array[wp.int32]):
    """Fills the top of a heap, whose node was removed, with the last node, which lies at index `size`."""
    last = heap[size]
    key = near[last]
    at = wp.int32(0)
    child = wp.int32(1)
    while child < size:
        if child + 1 < size:
            if near[heap[child + 1]] < near[heap[child]]:
                child += 1
        other = heap[child]
        if near[other] < key:
            heap[at] = other
            place[other] = at
            at = child
            child = 2 * at + 1
        else:
            child = size
    heap[at] = last
    place[last] = at


@wp.func
def order_from(
    first: int,
    listed: int,
    limit: int,
    sources: wp.array[wp.int32],
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    length: wp.array[wp.int32],
    heap: wp.array[wp.int32],
    place: wp.array[wp.int32],
    near: wp.array[wp.int32],
    order: wp.array[wp.int32],
):
    """Lists nodes by distance from `first`, up to the limit around all sources; returns the number listed in all."""
    near[first] = 0
    heap[0] = first
    place[first] = 0
    size = wp.int32(1)
    count = wp.int32(listed)
    spread = wp.int32(FAR)  # distance of the furthest source from the first; unknown until all were met
    while size > 0:
        u = heap[0]
        d = near[u]
        if limit < FAR - 1 and spread >= FAR:
            spread = wp.int32(0)
            for l in range(_LANES):
                spread = wp.max(spread, near[sources[l]])
        if d - spread > limit:
            size = 0
        else:
            order[count] = u
            count += 1
            size -= 1
            if size > 0:
                remove_top(size, heap, place, near)
            e = pointer[u]
            end = pointer[u + 1]
            while e < end:
                v = column[e]
                through = d + length[e]
                if through < near[v]:
                    near[v] = through
                    hole = place[v]
                    if hole < 0:
                        hole = size
                        size += 1
                    rise(hole, v, heap, place, near)
                e += 1
    return count


@wp.func
def settle(
    begin: int,
    many: int,
    order: wp.array[wp.int32],
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    length: wp.array[wp.int32],
    group: wp.array[wp.int32],
    stale: wp.array[wp.int8],
    distance: wp.array[wp.int32],
):
    """Visits stale nodes among the first of the order, again and again, until there are none."""
    changed = int(begin)
    while changed > 0:
        changed = wp.int32(0)
        for k in range(many):
            v = order[k]
            if stale[v] != wp.int8(0):
                stale[v] = wp.int8(0)
                if relaxed(v, 0, pointer, column, length, group, distance) != 0:
                    changed = wp.int32(1)
                    for e in range(pointer[v], pointer[v + 1]):
                        stale[column[e]] = wp.int8(1)


@wp.kernel
def search(
    # Model:
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    length: wp.array[wp.int32],
    near_pointer: wp.array[wp.int32],
    near_column: wp.array[wp.int32],
    near_length: wp.array[wp.int32],
    targets: wp.array[wp.int32],
    # In:
    sources: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    limit: int,
    unit: wp.float64,
    # Work:
    heap: wp.array[wp.int32],
    place: wp.array[wp.int32],
    near: wp.array[wp.int32],
    order: wp.array[wp.int32],
    group: wp.array[wp.int32],
    stale: wp.array[wp.int8],
    distance: wp.array[wp.int32],
    # Out:
    found: wp.array2d[wp.float32],
):
    """Distances from a block of sources to the targets; `inf` beyond the limit. Runs in one thread."""
    for v in range(near.shape[0]):
        near[v] = FAR
        place[v] = -1
        group[v] = FAR
        stale[v] = wp.int8(0)
    forget(near.shape[0], distance)
    count = wp.int32(0)
    l = wp.int32(0)
    while l < _LANES:
        s = sources[l]
        if near[s] >= FAR:  # the first one of each component
            count = order_from(
                s, count, limit, sources, near_pointer, near_column, near_length, heap, place, near, order
            )
        distance[s * _LANES + l] = 0
        l += 1

    spread = wp.int32(0)
    l = wp.int32(0)
    while l < _LANES:
        spread = wp.max(spread, near[sources[l]])
        l += 1
    inner = wp.int32(0)
    while inner < count and near[order[inner]] <= REGION * spread:
        inner += 1
    inner = wp.min(count, (inner + _GROUP - 1) / _GROUP * _GROUP)
    for k in range(count):
        group[order[k]] = k / _GROUP
    groups = (count + _GROUP - 1) / _GROUP
    for g in range(groups):
        heap[g] = g * _GROUP
    for v in range(near.shape[0]):
        g = group[v]
        if g < FAR:
            order[heap[g]] = v
            heap[g] = heap[g] + 1

    for k in range(inner):
        stale[order[k]] = wp.int8(1)
    settle(1, inner, order, pointer, column, length, group, stale, distance)
    for k in range(count - inner):
        stale[order[inner + k]] = wp.int8(0)
        relaxed(order[inner + k], -1, pointer, column, length, group, distance)
    changed = wp.int32(0)
    for k in range(count):
        v = order[count - 1 - k]
        sign = wp.int32(1)
        if stale[v] != wp.int8(0):
            stale[v] = wp.int8(0)
            sign = wp.int32(0)
        if relaxed(v, sign, pointer, column, length, group, distance) != 0:
            changed = wp.int32(1)
            for e in range(pointer[v], pointer[v + 1]):
                stale[column[e]] = wp.int8(1)
    settle(changed, count, order, pointer, column, length, group, stale, distance)
    read_out(limit, unit, targets, rows, distance, found)
