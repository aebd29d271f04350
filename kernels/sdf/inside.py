"""Inside or outside: winding numbers from counting where a ray leaves a body and where it enters.

Manifold-aware transformers, section 4.2 (the sign of d_i); generalised winding numbers of Jacobson et al. 2013, solid
angles after van Oosterom and Strackee 1983.

The winding number of a closed surface is an integer: the signed number of times that any ray from the point crosses it,
+1 where the ray leaves and -1 where it enters. Limbs may overlap, and a ray costs a tenth of summing solid angles over
a tree of faces. A body with holes is closed by caps C, whose own contribution is subtracted again:

    w(M) = crossings(M + C) - w(C),    w(C) = sum of Ω / 4π,    tan(Ω/2) = det(a,b,c) / (|a||b||c| + (a·b)|c| + ...)

| symbol | code | what |
| --- | --- | --- |
| M | mesh | the body's faces |
| C | caps | a fan over each boundary loop from its lowest vertex: any surface that closes M gives the same w(M) |
| Ω / 4π | winding_of | solid angle of a cap, seen from the point, as a share of the full one |

Rays run along an axis, so that a face is crossed where its projection contains the point. This is decided edge by edge,
with the same arithmetic for both faces that share an edge: no ray passes between two faces or meets both. The choice of
the ray changes nothing, except within rounding of the surface.

A cap that is too small and too far to matter is skipped. Caps are searched one by one; the few bodies with more than
`MOST_CAPS` of them, which are in pieces, use Warp's sums of solid angles instead.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warpgarment.kernels import compiling

from .model import Bodies

wp.set_module_options(compiling.options())

MOST_CAPS = 512
"""Largest number of caps of a body that are searched one by one."""
FAR = wp.constant(1.0e30)
ZERO = wp.constant(wp.float64(0.0))
NEGLIGIBLE = wp.constant(0.2)  # a loop whose winding number is below this is at first only bounded
ROUNDING = wp.constant(wp.float64(1.0e-6))  # rounding error of a sum of solid angles
PER_TURN = wp.constant(wp.float64(1.0 / (4.0 * np.pi)))


@wp.func
def turns_around(a: wp.vec3, b: wp.vec3, c: wp.vec3, axis: int):
    """Number of times that the projection of a triangle along an axis goes round the origin: 1, -1 or 0."""
    u = (axis + 1) % 3
    v = (axis + 2) % 3
    turns = wp.int32(0)
    for k in range(3):
        start = wp.where(k == 0, a, wp.where(k == 1, b, c))
        end = wp.where(k == 0, b, wp.where(k == 1, c, a))
        rising = start[v] <= 0.0
        if rising != (end[v] <= 0.0):
            low = wp.where(rising, start, end)  # the same order for both faces that share the edge
            high = wp.where(rising, end, start)
            if low[u] * high[v] > high[u] * low[v]:
                turns += wp.where(rising, 1, -1)
    return turns


@wp.func
def crossing(turns: int, volume: wp.float64, side: float):
    """How a ray crosses a triangle whose projection contains it: +1 when leaving by the front, -1 by the back, or 0.

    Args:
        turns: Result of `turns_around`.
        volume: det(a, b, c) [m³], positive behind the triangle.
        side: Direction of the ray along the axis, +1 or -1.
    """
    if (volume >= ZERO) == ((turns > 0) == (side > 0.0)):
        return wp.where(side > 0.0, turns, -turns)
    return 0


@wp.func
def volume_of(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """det(a, b, c), in which a negative zero becomes a positive one."""
    return wp.dot(a, wp.cross(b, c)) + ZERO


@wp.func
def crossings(mesh: wp.uint64, point: wp.vec3, axis: int, side: float):
    """Signed number of crossings of a ray with a mesh. Only faces whose boxes the ray meets are visited."""
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
    bodies: wp.array[Bodies], loop: int, point: wp.vec3, axis: int, side: float, crossed: bool, seen: bool
):
    """Crossings of the ray with the caps of a loop, if `crossed`, less the winding number of the caps, if `seen`.

    Both numbers jump at a cap, and their difference does not as long as both place the point on the same side of it:
    therefore both use one `volume`.
    """
    total = ZERO
    p = wp.vec3d(point)
    vertices = bodies[0].vertices
    for k in range(bodies[0].loops[loop], bodies[0].loops[loop + 1]):
        cap = bodies[0].caps[k]
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
def is_inside(bodies: wp.array[Bodies], b: int, crossed: int, point: wp.vec3, axis: int, side: float):
    """Whether the winding number of a body exceeds one half.

    Args:
        bodies: The bodies.
        b: The body.
        crossed: Crossings of a ray from the point along an axis with the body.
        point: Position [m].
        axis: Axis of the ray, 0, 1 or 2.
        side: Direction of the ray along the axis, +1 or -1.
    """
    winding = wp.float64(crossed)
    unsure = wp.float32(ROUNDING)
    first_loop = bodies[0].loop_offsets[b]
    last_loop = bodies[0].loop_offsets[b + 1]
    for loop in range(first_loop, last_loop):
        size = bodies[0].loop_size[loop]
        offset = bodies[0].vertices[bodies[0].caps[bodies[0].loops[loop]][0]] - point
        square = wp.dot(offset, offset)
        gap = wp.sqrt(square) - size[0]
        bound = size[1] * wp.float32(PER_TURN)
        seen = not (gap > 0.0 and bound < NEGLIGIBLE * gap * gap)
        if not seen:
            unsure += 1.00001 * bound / (gap * gap)
        on_ray = square - offset[axis] * offset[axis] <= 1.0001 * size[0] * size[0] + 1.0e-6 * square
        if on_ray or seen:
            winding += loop_winding(bodies, loop, point, axis, side, on_ray, seen)
    if wp.abs(winding - wp.float64(0.5)) <= wp.float64(unsure) and unsure > wp.float32(ROUNDING):
        for loop in range(first_loop, last_loop):  # the loops that were only bounded decide
            size = bodies[0].loop_size[loop]
            gap = wp.length(bodies[0].vertices[bodies[0].caps[bodies[0].loops[loop]][0]] - point) - size[0]
            if gap > 0.0 and size[1] * wp.float32(PER_TURN) < NEGLIGIBLE * gap * gap:
                winding += loop_winding(bodies, loop, point, axis, side, False, True)
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
    """Radius [m] and area [m²] of the caps of each loop, both slightly overestimated."""
    i, _ = wp.tid()  # see compiling.py
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
