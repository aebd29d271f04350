"""Inside or outside: winding numbers by counting where a ray leaves a body and enters it.

Manifold-aware transformers, section 4.2 (the sign of d_i); generalised winding numbers of Jacobson et al. 2013, solid
angles after van Oosterom and Strackee 1983.

The winding number of a closed surface is an integer: the signed number of times that any ray from the point crosses it,
+1 where the ray leaves and -1 where it enters. Limbs may overlap, and a ray costs a tenth of summing solid angles over
a tree of faces. A body with holes is closed by caps C, and what they add is taken away again:

    w(M) = crossings(M + C) - w(C),    w(C) = sum of Ω / 4π,    tan(Ω/2) = det(a,b,c) / (|a||b||c| + (a·b)|c| + ...)

| symbol | code | what |
| --- | --- | --- |
| M | mesh | the body's faces |
| C | caps | a fan over each boundary loop from its lowest vertex: any surface that closes M gives the same w(M) |
| Ω / 4π | winding_of | of a cap, seen from the point |

Rays run along an axis, so that a face is crossed where its projection contains the point. That is decided edge by edge,
in the same arithmetic from both faces that share an edge: no ray slips through between two faces or meets both. Which
ray is taken changes nothing, except within rounding of the surface.

A cap is skipped where it is too small and far to matter. The few bodies in pieces (`MOST_CAPS`) keep Warp's sums of
solid angles, since caps are searched one by one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
import warp as wp

MOST_CAPS = 512
"""Caps of a body up to which they are searched one by one."""
FAR = wp.constant(1.0e30)
ZERO = wp.constant(wp.float64(0.0))
NEGLIGIBLE = wp.constant(wp.float64(0.01))  # winding number of a loop's caps below which it is first bounded only
ROUNDING = wp.constant(wp.float64(1.0e-6))  # of a sum of solid angles
PER_TURN = wp.constant(wp.float64(1.0 / (4.0 * np.pi)))


class Caps(NamedTuple):
    """What closes a packed batch of bodies."""

    triangles: np.ndarray
    """Vertex indices (packed) of the caps, loop by loop, int32 [K, 3]; the first is the fan's centre."""
    loops: np.ndarray
    """Where the caps of each loop begin, and the end, int32 [L + 1]."""
    bodies: np.ndarray
    """Where the loops of each body begin, and the end, int32 [B + 1]."""


def caps_of(faces: np.ndarray, vertex_count: int, vertex_starts: list[int]) -> Caps:
    """Fans that close bodies; none for closed ones.

    Args:
        faces: Packed vertex indices, [G, 3]; of any orientation, edges may be shared by any number of faces.
        vertex_count: U.
        vertex_starts: Where the vertices of each body begin, and the end, [B + 1].
    """
    faces = faces.astype(np.int64)
    start, end = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    keys, edge = np.unique(low * vertex_count + high, return_inverse=True)
    net = np.bincount(edge, np.where(start < end, 1, -1), len(keys)).astype(np.int64)  # times from low to high
    net[keys // vertex_count == keys % vertex_count] = 0
    keys, net = np.repeat(keys, np.abs(net)), np.repeat(np.sign(net), np.abs(net))
    low, high = keys // vertex_count, keys % vertex_count
    start, end = np.where(net > 0, low, high), np.where(net > 0, high, low)
    graph = scipy.sparse.coo_matrix((np.ones(len(keys)), (start, end)), (vertex_count, vertex_count))
    _, loop_of_vertex = scipy.sparse.csgraph.connected_components(graph, directed=False)
    loop_of_edge = loop_of_vertex[start]
    centre = np.full(vertex_count, vertex_count)
    np.minimum.at(centre, loop_of_edge, start)
    triangles = np.stack([centre[loop_of_edge], end, start], axis=1)  # runs along the edge the other way
    triangles = triangles[(triangles[:, 0] != triangles[:, 1]) & (triangles[:, 0] != triangles[:, 2])]
    triangles = triangles[np.argsort(triangles[:, 0], kind="stable")]
    centres, first = np.unique(triangles[:, 0], return_index=True)
    loops = np.append(first, len(triangles))
    return Caps(
        triangles.astype(np.int32).reshape(-1, 3),
        loops.astype(np.int32),
        np.searchsorted(centres, vertex_starts).astype(np.int32),
    )


@wp.func
def turns_around(a: wp.vec3, b: wp.vec3, c: wp.vec3, axis: int):
    """How often the projection of a triangle along an axis goes round the origin: 1, -1 or 0."""
    u = (axis + 1) % 3
    v = (axis + 2) % 3
    turns = wp.int32(0)
    for k in range(3):
        start = wp.where(k == 0, a, wp.where(k == 1, b, c))
        end = wp.where(k == 0, b, wp.where(k == 1, c, a))
        rising = start[v] <= 0.0
        if rising != (end[v] <= 0.0):
            low = wp.where(rising, start, end)  # the same order from both faces of an edge
            high = wp.where(rising, end, start)
            if low[u] * high[v] > high[u] * low[v]:
                turns += wp.where(rising, 1, -1)
    return turns


@wp.func
def crossing(turns: int, volume: wp.float64, side: float):
    """How a ray crosses a triangle that it goes through forwards or backwards: +1 leaving by its front, -1, or 0.

    Args:
        turns: From `turns_around`.
        volume: det(a, b, c), positive behind the triangle.
        side: Direction of the ray along the axis.
    """
    if (volume >= ZERO) == ((turns > 0) == (side > 0.0)):
        return wp.where(side > 0.0, turns, -turns)
    return 0


@wp.func
def volume_of(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """det(a, b, c); no negative zero."""
    return wp.dot(a, wp.cross(b, c)) + ZERO


@wp.func
def crossings(mesh: wp.uint64, point: wp.vec3, axis: int, side: float):
    """Signed crossings of a ray with a mesh. Its boxes are those that a segment along the axis, to infinity, meets."""
    body = wp.mesh_get(mesh)
    lower = point
    upper = point
    if side > 0.0:
        upper[axis] = FAR
    else:
        lower[axis] = -FAR
    total = wp.int32(0)
    face = wp.int32(0)
    query = wp.bvh_query_aabb(wp.mesh_get_bvh(mesh), lower, upper)
    while wp.bvh_query_next(query, face):
        a = body.points[body.indices[3 * face]] - point
        b = body.points[body.indices[3 * face + 1]] - point
        c = body.points[body.indices[3 * face + 2]] - point
        turns = turns_around(a, b, c, axis)
        if turns != 0:
            total += crossing(turns, volume_of(wp.vec3d(a), wp.vec3d(b), wp.vec3d(c)), side)
    return total


@wp.func
def winding_of(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, volume: wp.float64):
    """Ω/4π of a triangle seen from the origin, positive from behind."""
    la = wp.length(a)
    lb = wp.length(b)
    lc = wp.length(c)
    below = la * lb * lc + wp.dot(a, b) * lc + wp.dot(b, c) * la + wp.dot(c, a) * lb
    return wp.float64(2.0) * PER_TURN * wp.atan2(volume, below)


@wp.func
def loop_winding(
    vertices: wp.array[wp.vec3],
    caps: wp.array[wp.vec3i],
    first: int,
    last: int,
    point: wp.vec3,
    axis: int,
    side: float,
    crossed: bool,
    seen: bool,
):
    """What the caps of a loop add to the crossings of the ray, if `crossed`, less their winding number, if `seen`.

    Both jump at a cap and their difference does not, as long as they agree on the point's side: hence one volume.
    """
    total = ZERO
    p = wp.vec3d(point)
    for k in range(first, last):
        cap = caps[k]
        a = wp.vec3d(vertices[cap[0]]) - p
        b = wp.vec3d(vertices[cap[1]]) - p
        c = wp.vec3d(vertices[cap[2]]) - p
        volume = volume_of(a, b, c)
        if crossed:
            turns = turns_around(vertices[cap[0]] - point, vertices[cap[1]] - point, vertices[cap[2]] - point, axis)
            if turns != 0:
                total += wp.float64(crossing(turns, volume, side))
        if seen:
            total -= winding_of(a, b, c, volume)
    return total


@wp.func
def is_inside(
    mesh: wp.uint64,
    vertices: wp.array[wp.vec3],
    caps: wp.array[wp.vec3i],
    loops: wp.array[wp.int32],
    loop_size: wp.array[wp.vec2],
    first_loop: int,
    last_loop: int,
    point: wp.vec3,
    axis: int,
    side: float,
):
    """Whether the winding number of a body exceeds one half.

    Args:
        mesh: The body.
        vertices: Packed, as the indices of the caps are.
        caps: Their corners.
        loops: Where the caps of each loop begin.
        loop_size: Radius of each loop around its centre [m], and area of its caps [m²].
        first_loop: Of the body.
        last_loop: The one after its last.
        point: Position [m].
        axis: Of the ray.
        side: Its direction along the axis, +1 or -1.
    """
    winding = wp.float64(crossings(mesh, point, axis, side))
    unsure = ROUNDING
    for loop in range(first_loop, last_loop):
        first = loops[loop]
        last = loops[loop + 1]
        size = loop_size[loop]
        offset = vertices[caps[first][0]] - point
        distance = wp.length(offset)
        beside = distance * distance - offset[axis] * offset[axis]
        crossed = beside <= 1.0001 * size[0] * size[0] + 1.0e-6 * distance * distance
        gap = wp.float64(distance - size[0])
        bound = wp.float64(size[1]) * PER_TURN
        seen = not (gap > ZERO and bound < NEGLIGIBLE * gap * gap)
        if not seen:
            unsure += bound / (gap * gap)
        if crossed or seen:
            winding += loop_winding(vertices, caps, first, last, point, axis, side, crossed, seen)
    if wp.abs(winding - wp.float64(0.5)) <= unsure and unsure > ROUNDING:
        for loop in range(first_loop, last_loop):  # those that were left out matter after all
            size = loop_size[loop]
            gap = wp.float64(wp.length(vertices[caps[loops[loop]][0]] - point) - size[0])
            if gap > ZERO and wp.float64(size[1]) * PER_TURN < NEGLIGIBLE * gap * gap:
                winding += loop_winding(vertices, caps, loops[loop], loops[loop + 1], point, axis, side, False, True)
    return winding > wp.float64(0.5)


@wp.kernel(enable_backward=False)
def loop_size_kernel(
    # Model:
    caps: wp.array[wp.vec3i],
    loops: wp.array[wp.int32],
    # In:
    vertices: wp.array[wp.vec3],
    # Out:
    loop_size: wp.array[wp.vec2],
):
    """Radius and area of the caps of each loop, a little too large."""
    i = wp.tid()
    radius = wp.float32(0.0)
    area = wp.float32(0.0)
    for k in range(loops[i], loops[i + 1]):
        cap = caps[k]
        a = vertices[cap[0]]
        b = vertices[cap[1]] - a
        c = vertices[cap[2]] - a
        radius = wp.max(radius, wp.max(wp.length(b), wp.length(c)))
        area += 0.5 * wp.length(wp.cross(b, c))
    loop_size[i] = 1.00001 * wp.vec2(radius, area)
