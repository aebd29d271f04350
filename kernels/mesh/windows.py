"""Straight segments over a surface: what sources on it see as strips of faces are unfolded into the plane.

A window is what a source sees through an edge of the strip that was unfolded so far. The source is the origin of its
plane, and two rays bound the window. The face behind the edge is laid beside it; its centroid, and its far corner if
paths may bend there, are seen if they lie between the rays. The window then goes on through one or both of the other
edges (Mitchell, Mount and Papadimitriou 1987). Windows are taken nearest first. A window ends

- at the border, after `DEPTH` faces, and where its edge is as far from the source as the `reach` of the source and of
  the faces crossed, though not before it has crossed `LEAST_DEPTH` faces;
- where another path, by way of a corner of its edge that the source sees, is shorter everywhere in it (Xin and Wang
  2009). Without this rule windows would wind about thin tubes without end.

Among slender faces the reach of one face holds very many others. A source whose windows have crossed `ENOUGH` faces
looks on only into those of `SECTORS` directions in which it sees nothing yet, through windows wider than `NARROW` and
up to `SHARE` of the reach; it stops after `MOST` faces, and keeps the first `KEPT` segments of each direction.

| symbol | code | what |
| --- | --- | --- |
| half-edge | `3 f + k` | from corner k of face f to corner k + 1 |
| twin | `twin` | int32 [3F], the half-edge of the neighbouring face, -1 at the border |
| apex | `apex` | float64 [3F,2], third corner of the face, with the half-edge on the first axis [m] |
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from .. import compiling
from .plane import SECTORS, at_ray, cross, distance_to_segment, norm, sector

wp.set_module_options(compiling.options(enable_backward=False, fuse_fp=False))  # the same bits on all processors

LEAST_DEPTH = 4
DEPTH = 400
ENOUGH = 320  # on garments of even triangles a source's windows cross some 120 faces, and 300 at most
MOST = 2000
KEPT = 2
NARROW = 0.015  # sine of the angle [1]
SHARE = 0.7
ROOM = 2**18  # number of segments that one launch can return

_LEAST_DEPTH, _DEPTH = wp.constant(LEAST_DEPTH), wp.constant(DEPTH)
_ENOUGH, _SECTORS, _KEPT = wp.constant(ENOUGH), wp.constant(SECTORS), wp.constant(KEPT)
_NARROW, _SHARE = wp.constant(wp.float64(NARROW)), wp.constant(wp.float64(SHARE))
_MORE = wp.constant(wp.float64(1.0 + 1e-9))  # a path is shorter only if it is so beyond rounding
origin = wp.types.vector(3, wp.int32)  # of a window: half-edge, number of the first window, faces crossed
extent = wp.types.vector(11, wp.float64)  # the edge's right and left end, the rays, their lengths, the reach [m]


class Surface(NamedTuple):
    """A triangle mesh of F faces as it is unfolded; see the table above."""

    twin: np.ndarray  # int32 [3F]
    apex: np.ndarray  # float64 [3F,2] [m]
    vertex: np.ndarray  # int32 [3F], first vertex of each half-edge
    node: np.ndarray  # int32 [3F], node of that vertex, -1 where no path bends
    crossed_reach: np.ndarray  # float64 [F] [m], reach of a window that crossed the face


@wp.func
def following(half: int) -> int:
    """The next half-edge of the same face."""
    return half - half % 3 + (half + 1) % 3


@wp.func
def joined(
    right: wp.vec2d,
    left: wp.vec2d,
    ray_right: wp.vec2d,
    ray_left: wp.vec2d,
    size_right: wp.float64,
    size_left: wp.float64,
    reach: wp.float64,
) -> extent:
    """What describes a window in the plane, in one vector."""
    r = wp.vec4d(ray_right[0], ray_right[1], ray_left[0], ray_left[1])
    e = wp.vec4d(right[0], right[1], left[0], left[1])
    return extent(e[0], e[1], e[2], e[3], r[0], r[1], r[2], r[3], size_right, size_left, reach)


@wp.func
def offer(
    # Model:
    twin: wp.array[wp.int32],
    vertex: wp.array[wp.int32],
    # In:
    half: int,
    start: int,
    depth: int,
    new: extent,
    shortest: wp.array[wp.float64],
    # In and out:
    count: int,
    size: int,
    window: wp.array[origin],
    plane: wp.array[extent],
    near: wp.array[wp.float64],
    heap: wp.array[wp.int32],
):
    """Puts a window that goes on at the end of the list and into the heap; returns whether it does."""
    if twin[half] < 0 or depth >= _DEPTH:
        return False
    key = wp.float64(0.0)
    if depth > 0:
        right = wp.vec2d(new[0], new[1])
        left = wp.vec2d(new[2], new[3])
        reach = new[10]
        from_right = at_ray(wp.vec2d(new[4], new[5]), right, left)
        from_left = at_ray(wp.vec2d(new[6], new[7]), right, left)
        squared_right = wp.dot(from_right, from_right)
        squared_left = wp.dot(from_left, from_left)
        if depth >= _LEAST_DEPTH:
            key = wp.min(squared_right, squared_left)
            if key >= reach * reach:  # else the edge is nearer than that
                if distance_to_segment(right, left) >= reach:
                    return False
        limit = shortest[vertex[half]]
        if squared_left > limit * limit:  # else the window is nearer than that corner
            if wp.sqrt(squared_left) > _MORE * (limit + norm(from_left - right)):
                return False
        limit = shortest[vertex[following(half)]]
        if squared_right > limit * limit:
            if wp.sqrt(squared_right) > _MORE * (limit + norm(left - from_right)):
                return False
    window[count] = origin(half, start, depth)
    plane[count] = new
    near[count] = key
    at = int(size)
    going = int(at)
    while going > 0:
        above = (at - 1) / 2
        going = 0
        if near[heap[above]] > key:
            heap[at] = heap[above]
            at = above
            going = at
    heap[at] = count
    return True


@wp.func
def remove_top(size: int, heap: wp.array[wp.int32], near: wp.array[wp.float64]):
    """Fills the top of a heap, which was taken, with its last entry, at index `size`."""
    last = heap[size]
    key = near[last]
    at = wp.int32(0)
    child = wp.int32(1)
    while child < size:
        if child + 1 < size:
            if near[heap[child + 1]] < near[heap[child]]:
                child += 1
        if near[heap[child]] < key:
            heap[at] = heap[child]
            at = child
            child = 2 * at + 1
        else:
            child = size
    heap[at] = last


@wp.func
def covered(start: int, ray_right: wp.vec2d, ray_left: wp.vec2d, source: int, looked: wp.array[wp.int32]):
    """Whether something was seen in every sector of a window."""
    at = sector(ray_right)
    last = sector(ray_left)
    while at != last and looked[start * _SECTORS + at] == source:
        at = (at + 1) % _SECTORS
    return looked[start * _SECTORS + at] == source


@wp.func
def thin_out(
    begin: int,
    end: int,
    looked: wp.array[wp.int32],
    way: wp.array[wp.int32],
    seen: wp.array[wp.int32],
    length: wp.array[wp.float64],
) -> int:
    """Keeps the first segments of each sector; returns the new end."""
    for k in range(begin, end):
        looked[way[k]] = -1 - _KEPT
    kept = int(begin)
    for k in range(begin, end):
        if looked[way[k]] < -1:
            looked[way[k]] = looked[way[k]] + 1
            seen[kept] = seen[k]
            length[kept] = length[k]
            kept += 1
    return kept


@wp.kernel
def unfold(
    # Model:
    twin: wp.array[wp.int32],
    apex_of: wp.array[wp.vec2d],
    vertex: wp.array[wp.int32],
    node_of: wp.array[wp.int32],
    crossed_reach: wp.array[wp.float64],
    # In:
    first: wp.array[wp.int32],
    first_half: wp.array[wp.int32],
    first_right: wp.array[wp.vec2d],
    first_left: wp.array[wp.vec2d],
    source_reach: wp.array[wp.float64],
    begin: int,
    most: int,
    # Work:
    window: wp.array[origin],
    plane: wp.array[extent],
    near: wp.array[wp.float64],
    heap: wp.array[wp.int32],
    shortest: wp.array[wp.float64],
    looked: wp.array[wp.int32],
    way: wp.array[wp.int32],
    # Out:
    end: wp.array[wp.int32],
    seen: wp.array[wp.int32],
    length: wp.array[wp.float64],
):
    """Segments from the sources `begin` onwards until the room is full, in one thread; `end` [S] is where each's end.

    `shortest` [V], lengths of segments to vertices, is infinite before and after.
    """
    found = wp.int32(0)
    source = wp.int32(begin)
    while source + 1 < first.shape[0] and found + 2 * most <= seen.shape[0]:
        begin_found = int(found)
        count = wp.int32(0)
        size = wp.int32(0)
        crossed = wp.int32(0)
        for w in range(first[source], first[source + 1]):
            h = first_half[w]
            right = first_right[w]
            left = first_left[w]
            sr = norm(right)
            sl = norm(left)
            shortest[vertex[h]] = sr
            shortest[vertex[following(h)]] = sl
            new = joined(right, left, right, left, sr, sl, source_reach[source])
            if offer(twin, vertex, h, w - first[source], 0, new, shortest, count, size, window, plane, near, heap):
                count += 1
                size += 1
        while size > 0 and (crossed < most or near[heap[0]] == wp.float64(0.0)):
            this = heap[0]
            size -= 1
            if size > 0:
                remove_top(size, heap, near)
            start = window[this][1]
            kept = plane[this]
            ray_right = wp.vec2d(kept[4], kept[5])
            ray_left = wp.vec2d(kept[6], kept[7])
            if crossed >= _ENOUGH:
                nearest = _SHARE * kept[10]
                if near[this] > nearest * nearest or cross(ray_right, ray_left) < _NARROW * kept[8] * kept[9]:
                    continue
                if covered(start, ray_right, ray_left, source, looked):
                    continue
            crossed += 1
            across = twin[window[this][0]]
            depth = window[this][2] + 1
            right = wp.vec2d(kept[0], kept[1])
            left = wp.vec2d(kept[2], kept[3])
            reach = wp.max(kept[10], crossed_reach[across / 3])
            # The twin runs from left to right with the new face on its far side.
            along = right - left
            along = along / wp.max(norm(along), wp.float64(1e-30))
            local = apex_of[across]
            apex = left + local[0] * along
            apex = apex + local[1] * wp.vec2d(-along[1], along[0])
            far_corner = following(following(across))
            size_right = kept[8]
            size_left = kept[9]

            centroid = (left + right + apex) / wp.float64(3.0)
            far = norm(centroid)
            slack = wp.float64(-1e-9) * far
            if cross(ray_right, centroid) >= slack * size_right and cross(centroid, ray_left) >= slack * size_left:
                way[found] = start * _SECTORS + sector(centroid)
                looked[way[found]] = source
                seen[found] = across / 3
                length[found] = far
                found += 1
            far = norm(apex)
            slack = wp.float64(-1e-9) * far
            beside_right = cross(ray_right, apex)
            beside_left = cross(apex, ray_left)
            if beside_right >= slack * size_right and beside_left >= slack * size_left:
                shortest[vertex[far_corner]] = wp.min(shortest[vertex[far_corner]], far)
                if node_of[far_corner] >= 0:
                    way[found] = start * _SECTORS + sector(apex)
                    looked[way[found]] = source
                    seen[found] = node_of[far_corner]
                    length[found] = far
                    found += 1

            tiny = wp.float64(1e-12) * far
            h = following(across)
            if beside_right > tiny * size_right:  # part of the window passes right of the apex
                ray = ray_left
                ray_size = size_left
                if beside_left > wp.float64(0.0):
                    ray = apex
                    ray_size = far
                new = joined(right, apex, ray_right, ray, size_right, ray_size, reach)
                if offer(twin, vertex, h, start, depth, new, shortest, count, size, window, plane, near, heap):
                    count += 1
                    size += 1
            if beside_left > tiny * size_left:
                ray = ray_right
                ray_size = size_right
                if beside_right > wp.float64(0.0):
                    ray = apex
                    ray_size = far
                new = joined(apex, left, ray, ray_left, ray_size, size_left, reach)
                if offer(twin, vertex, far_corner, start, depth, new, shortest, count, size, window, plane, near, heap):
                    count += 1
                    size += 1
        if crossed >= _ENOUGH:
            found = thin_out(begin_found, found, looked, way, seen, length)
        for k in range(count):
            h = window[k][0]
            shortest[vertex[h]] = wp.float64(wp.inf)
            shortest[vertex[following(h)]] = wp.float64(wp.inf)
            shortest[vertex[following(following(twin[h]))]] = wp.float64(wp.inf)
        for w in range(first[source], first[source + 1]):
            h = first_half[w]
            shortest[vertex[h]] = wp.float64(wp.inf)
            shortest[vertex[following(h)]] = wp.float64(wp.inf)
        end[source] = found
        source += 1


def segments(
    surface: Surface, source: np.ndarray, half: np.ndarray, right: np.ndarray, left: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The straight segments from sources through their first windows.

    Args:
        surface: The mesh.
        source: Source of each window, from 0 to S - 1, integers [W].
        half: Half-edge that the window looks through, of the face that lies on the source's side, integers [W].
        right: First vertex of that half-edge in a plane with the source at its origin [m], [W,2].
        left: Second vertex of the half-edge in that plane [m], [W,2].
        reach: Distance at which windows of each source end [m], [S].

    Returns:
        Sources, int32 [M], ascending; faces and nodes that they see, int32 [M]; lengths of the segments [m], float64
        [M]. What is seen past both sides of a vertex comes twice.
    """
    order = np.argsort(source, kind="stable")
    first = np.searchsorted(source[order], np.arange(len(reach) + 1))
    widest = int(np.diff(first).max(initial=0))
    most = max(MOST, widest * 2 ** (LEAST_DEPTH + 1))
    room = max(ROOM, 2 * most)

    def sent(array: np.ndarray, kind: Any) -> wp.array:
        return wp.array(np.ascontiguousarray(array), dtype=kind, device="cpu")

    def empty(count: int, kind: Any) -> wp.array:
        return wp.empty(count, dtype=kind, device="cpu")

    inputs = [
        sent(surface.twin, wp.int32),
        sent(surface.apex, wp.vec2d),
        sent(surface.vertex, wp.int32),
        sent(surface.node, wp.int32),
        sent(surface.crossed_reach, wp.float64),
        sent(first, wp.int32),
        sent(half[order], wp.int32),
        sent(right[order], wp.vec2d),
        sent(left[order], wp.vec2d),
        sent(reach, wp.float64),
    ]
    windows = widest + 2 * most  # every window that is taken offers two
    work = [
        empty(windows, origin),
        empty(windows, extent),
        empty(windows, wp.float64),
        empty(windows, wp.int32),
        sent(np.full(int(surface.vertex.max()) + 1, np.inf), wp.float64),
        sent(np.full(SECTORS * max(widest, 1), -1), wp.int32),
        empty(room, wp.int32),
    ]
    ends, seen, length = empty(len(reach), wp.int32), empty(room, wp.int32), empty(room, wp.float64)
    begin, found = 0, []
    while begin < len(reach):
        ends.fill_(-1)
        wp.launch(unfold, dim=1, inputs=[*inputs, begin, most, *work], outputs=[ends, seen, length], device="cpu")
        end = ends.numpy()[begin:]
        end = end[end >= 0]
        of_source = np.repeat(np.arange(begin, begin + len(end), dtype=np.int32), np.diff(end, prepend=0))
        found.append((of_source, seen.numpy()[: len(of_source)].copy(), length.numpy()[: len(of_source)].copy()))
        begin += len(end)
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))  # type: ignore[return-value]
