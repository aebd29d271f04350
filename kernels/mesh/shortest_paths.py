"""Shortest paths from many nodes of a graph, 32 sources at a time: one scalar search, then vector sweeps.

Lengths are integers, multiples of a unit so small that the rounding does not matter. Sums are therefore exact: the
result depends neither on the order of additions nor on which sources share a block, and distances are symmetric.

1. Dijkstra's algorithm (1959) from one source of a block lists all nodes by their distance from it.
2. The sources of a block are neighbours, so this order nearly suits all of them. In this order, for all at once,

       d_v = min(d_v, min_u d_u + w_uv)        d_v [32], one entry per source

   (Bellman 1958). A second pass visits every node again; later passes visit only neighbours of nodes that changed.
   When no node changes, d is the fixed point: the lengths of the shortest paths.

On a garment's graph of some 125 edges a node, a node is visited 2.0 to 2.2 times.

| symbol | code | what |
| --- | --- | --- |
| w_uv | `pointer, column, length` | edge lengths, CSR, symmetric, int64, in units |
| d_v | `distance` | [N], 32 int64 each, in units; `FAR` where a source does not reach the node |
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import warp as wp
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from warpgarment.kernels import compiling

wp.set_module_options(compiling.options(enable_backward=False))

LANES = 32
LANDMARKS = 6  # the distances to these nodes serve as coordinates of all nodes
_LANES = wp.constant(LANES)
FAR = wp.constant(wp.int64(2**61))  # longer than any path; the sum of it and a path does not overflow
row = wp.types.vector(LANES, wp.int64)


@wp.func
def rise(hole: int, node: int, heap: wp.array[wp.int32], place: wp.array[wp.int32], near: wp.array[wp.int64]):
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
def remove_top(size: int, heap: wp.array[wp.int32], place: wp.array[wp.int32], near: wp.array[wp.int64]):
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
    limit: wp.int64,
    sources: wp.array[wp.int32],
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    length: wp.array[wp.int64],
    heap: wp.array[wp.int32],
    place: wp.array[wp.int32],
    near: wp.array[wp.int64],
    order: wp.array[wp.int32],
):
    """Lists nodes by distance from `first`, up to the limit around all sources; returns the number listed in all."""
    near[first] = wp.int64(0)
    heap[0] = first
    place[first] = 0
    size = wp.int32(1)
    count = wp.int32(listed)
    spread = FAR + wp.int64(0)  # distance of the furthest source from the first; unknown until all were met
    while size > 0:
        u = heap[0]
        d = near[u]
        if limit < FAR and spread >= FAR:
            spread = wp.int64(0)
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


@wp.kernel
def search(
    # Model:
    pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    length: wp.array[wp.int64],
    targets: wp.array[wp.int32],
    # In:
    sources: wp.array[wp.int32],
    lanes: int,
    limit: wp.int64,
    unit: wp.float64,
    # Work:
    heap: wp.array[wp.int32],
    place: wp.array[wp.int32],
    near: wp.array[wp.int64],
    order: wp.array[wp.int32],
    stale: wp.array[wp.int8],
    distance: wp.array[row],
    # Out:
    found: wp.array2d[wp.float32],
):
    """Distances from a block of sources to the targets; `inf` beyond the limit. Runs in one thread."""
    for v in range(near.shape[0]):
        near[v] = FAR
        place[v] = -1
        stale[v] = wp.int8(1)
        distance[v] = row(FAR)
    count = wp.int32(0)
    for l in range(_LANES):
        s = sources[l]
        if near[s] >= FAR:  # the first one of each component
            count = order_from(s, count, limit, sources, pointer, column, length, heap, place, near, order)
        own = distance[s]
        own[l] = wp.int64(0)
        distance[s] = own

    sweep = wp.int32(0)
    changed = wp.int32(1)
    while changed > 0:
        changed = wp.int32(0)
        for k in range(count):
            v = order[k]
            if stale[v] != wp.int8(0):
                stale[v] = wp.int8(0)
                old = distance[v]
                best = row(old)
                e = pointer[v]
                end = pointer[v + 1]
                while e < end:
                    best = wp.min(best, distance[column[e]] + row(length[e]))
                    e += 1
                if not (best == old):
                    distance[v] = best
                    changed = wp.int32(1)
                    if sweep > 0:
                        for e in range(pointer[v], pointer[v + 1]):
                            stale[column[e]] = wp.int8(1)
        if sweep == 0:
            changed = wp.int32(1)
            for k in range(count):
                stale[order[k]] = wp.int8(1)
        sweep += 1

    for t in range(targets.shape[0]):
        there = distance[targets[t]]
        for l in range(lanes):
            d = wp.float32(wp.inf)
            if there[l] <= limit and there[l] < FAR:
                d = wp.float32(wp.float64(there[l]) * unit)
            found[l, t] = d


def unit_of(graph: csr_matrix) -> float:
    """Unit of length for a graph: a power of two, so small that no path is longer than 2^60 units.

    Args:
        graph: Lengths of edges, [N,N], in any unit.

    Raises:
        ValueError: A length is negative or not finite.
    """
    longest = float(graph.data.max(initial=0.0))
    if not (longest < np.inf and graph.data.min(initial=0.0) >= 0.0):
        raise ValueError("lengths of edges must be finite and not negative")
    return float(np.ldexp(1.0, int(np.frexp(longest * graph.shape[0])[1]) - 60))


class Paths:
    """A graph prepared for searches on the CPU.

    Args:
        graph: Lengths of edges, [N,N], symmetric, not negative, in any unit.
        targets: Nodes to which distances are computed, integers [T].
        unit: Unit to whose multiples lengths are rounded; None takes `unit_of` of this graph. Parts of a graph must
            be given the unit of the whole graph.

    Raises:
        ValueError: A length is negative or not finite, and no unit is given.
    """

    def __init__(self, graph: csr_matrix, targets: np.ndarray, unit: float | None = None):
        self.unit = unit_of(graph) if unit is None else unit
        self.count = graph.shape[0]
        self._landmarks = _landmarks(graph)
        order = np.concatenate(list(neighbourhoods(self._landmarks, LANES)))  # so that neighbours lie close in memory
        self.place = np.empty(self.count, np.int32)  # new number of each node
        self.place[order] = np.arange(self.count, dtype=np.int32)
        graph = graph[order][:, order]
        self._model: list[wp.array] = [
            wp.array(graph.indptr, dtype=wp.int32, device="cpu"),
            wp.array(graph.indices, dtype=wp.int32, device="cpu"),
            wp.array(np.rint(graph.data / self.unit).astype(np.int64), dtype=wp.int64, device="cpu"),
            wp.array(self.place[targets], dtype=wp.int32, device="cpu"),
        ]
        self._target_count = len(targets)

    def distances(self, sources: np.ndarray, limit: float = np.inf, threads: int | None = None) -> np.ndarray:
        """Lengths of the shortest paths from sources to the targets.

        Args:
            sources: Nodes from which paths start, integers [S].
            limit: Longest path of interest, in the graph's unit of length.
            threads: Number of host threads; None takes one for each core. A thread needs some 330 bytes a node.

        Returns:
            float32 [S,T], in the graph's unit of length; `inf` where no path exists within the limit.
        """
        place, points = self.place[sources], self._landmarks[sources]
        lengths = np.empty((len(sources), self._target_count), np.float32)
        blocks = list(neighbourhoods(points, LANES))
        whole = wp.int64(int(min(limit / self.unit, 2.0**61)))
        of_thread = threading.local()

        def run(block: np.ndarray) -> None:
            if not hasattr(of_thread, "work"):
                kinds = wp.int32, wp.int32, wp.int64, wp.int32, wp.int8, row
                of_thread.work = [wp.empty(self.count, dtype=kind, device="cpu") for kind in kinds]
                of_thread.lengths = np.empty((LANES, self._target_count), np.float32)
            middle = np.argmin(((points[block] - points[block].mean(axis=0)) ** 2).sum(axis=1))
            block = np.roll(block, -middle)  # the order of nodes is that of the first source
            padded = np.concatenate([place[block], np.repeat(place[block[:1]], LANES - len(block))])
            wp.launch(
                search,
                dim=1,
                inputs=[
                    *self._model,
                    wp.array(padded, dtype=wp.int32, device="cpu"),
                    len(block),
                    whole,
                    self.unit,
                    *of_thread.work,
                ],
                outputs=[wp.array(of_thread.lengths, dtype=wp.float32, device="cpu", copy=False)],
                device="cpu",
            )
            lengths[block] = of_thread.lengths[: len(block)]

        for block in blocks[:1]:  # before the others, since it may have to compile the kernel
            run(block)
        with ThreadPoolExecutor(threads or usable_cores()) as pool:  # launches release the global interpreter lock
            list(pool.map(run, blocks[1:]))
        return lengths


def neighbourhoods(points: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """Divides points into blocks of neighbours, along the longest side of the bounding box.

    Args:
        points: Coordinates, [N,D].
        size: Number of points in a block; the last block may be smaller.

    Yields:
        Indices of the points of a block.
    """
    waiting = [np.arange(len(points))]
    while waiting:
        block = waiting.pop()
        if len(block) <= size:
            yield np.sort(block)
            continue
        axis = np.ptp(points[block], axis=0).argmax()
        order = block[np.argsort(points[block, axis], kind="stable")]
        middle = size * (-(-len(order) // size) // 2)
        waiting += [order[middle:], order[:middle]]


def _landmarks(graph: csr_matrix) -> np.ndarray:
    """Distances to some nodes far from each other, [N,LANDMARKS]: coordinates of nodes from the graph alone."""
    away = dijkstra(graph, indices=0)
    columns: list[np.ndarray] = []
    nearest = np.full(graph.shape[0], np.inf)
    for _ in range(LANDMARKS):
        away = dijkstra(graph, indices=int(away.argmax() if not columns else nearest.argmax()))
        nearest = np.minimum(nearest, away)
        columns.append(away)
    points = np.stack(columns, axis=1)
    finite = np.isfinite(points)
    return np.where(finite, points, 2.0 * points[finite].max())


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
