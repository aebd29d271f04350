r"""Two triangles in space: the direction along which they are farthest apart, and the points that are nearest.

Triangles are convex. They are disjoint exactly if a direction separates them: the gap

    g(n) = min_i n·a_i - max_j n·b_j

is positive for some n. For disjoint triangles the largest gap of all unit vectors is their distance, and n leads from
the nearest point of B to that of A. The nearest points are a corner and a point of the other triangle (6 pairs), or
points of two edges (9 pairs). If those pairs give no direction with a positive gap, the triangles cross or touch.

Everything is relative to the first corner of A, so that float32 keeps a tenth of a micrometre where bodies are metres
from the origin. The nearest points are in float64: in float32, the direction between points 20 um apart is so inexact
that it does not separate faces of a few centimetres.

| symbol | code | what |
| --- | --- | --- |
| a_i, b_j | `p`, `q` | corners as rows of a matrix [m] |
| n | `normal` | unit vector from B to A |
| g(n) | `gap` | gap along n [m] |
| u, v | `weights_p`, `weights_q` | barycentric coordinates of the nearest points |
"""

from __future__ import annotations

import warp as wp

TOUCHING = wp.constant(2.0e-6)
"""Gap [m] up to which triangles count as crossing: several times the rounding of positions of a few metres."""


ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.struct
class Nearest:
    """The nearest points of two triangles, and the distance between them."""

    weights_p: wp.vec3d
    weights_q: wp.vec3d
    way: wp.vec3d  # from the point of B to the point of A [m]
    squared: wp.float64  # square of the distance [m^2]


@wp.func
def corners(points: wp.array[wp.vec3], face: wp.vec3i, origin: wp.vec3):
    """Corners of a face relative to an origin [m], one per row."""
    return wp.matrix_from_rows(points[face[0]] - origin, points[face[1]] - origin, points[face[2]] - origin)


@wp.func
def gap_along(p: wp.mat33, q: wp.mat33, normal: wp.vec3) -> float:
    """g(n) [m]."""
    return wp.min(p * normal) - wp.max(q * normal)


@wp.func
def weights_of_nearest(point: wp.vec3d, t: wp.mat33d):
    """Barycentric coordinates of the point of a triangle that is nearest to a point."""
    a = wp.vec3d(t[0, 0], t[0, 1], t[0, 2])
    b = wp.vec3d(t[1, 0], t[1, 1], t[1, 2])
    c = wp.vec3d(t[2, 0], t[2, 1], t[2, 2])
    ab, ac, bc = b - a, c - a, c - b
    pa, pb, pc = point - a, point - b, point - c
    d1, d2 = wp.dot(ab, pa), wp.dot(ac, pa)
    d3, d4 = wp.dot(ab, pb), wp.dot(ac, pb)
    d5, d6 = wp.dot(ab, pc), wp.dot(ac, pc)
    if d1 <= ZERO and d2 <= ZERO:
        return wp.vec3d(ONE, ZERO, ZERO)
    if d3 >= ZERO and d4 <= d3:
        return wp.vec3d(ZERO, ONE, ZERO)
    if d6 >= ZERO and d5 <= d6:
        return wp.vec3d(ZERO, ZERO, ONE)
    vc = d1 * d4 - d3 * d2
    if vc <= ZERO and d1 >= ZERO and d3 <= ZERO:
        s = d1 / (d1 - d3)
        return wp.vec3d(ONE - s, s, ZERO)
    vb = d5 * d2 - d1 * d6
    if vb <= ZERO and d2 >= ZERO and d6 <= ZERO:
        s = d2 / (d2 - d6)
        return wp.vec3d(ONE - s, ZERO, s)
    va = d3 * d6 - d5 * d4
    if va <= ZERO and wp.dot(bc, pb) >= ZERO and wp.dot(bc, pc) <= ZERO:
        s = wp.dot(bc, pb) / wp.dot(bc, bc)
        return wp.vec3d(ZERO, ONE - s, s)
    total = va + vb + vc
    return wp.vec3d(va / total, vb / total, vc / total)


@wp.func
def nearest_on_segments(a: wp.vec3d, u: wp.vec3d, b: wp.vec3d, v: wp.vec3d):
    """Parameters s, t in [0, 1] of the nearest points a + s u and b + t v of two segments."""
    w = a - b
    uu, vv, uv = wp.dot(u, u), wp.dot(v, v), wp.dot(u, v)
    uw, vw = wp.dot(u, w), wp.dot(v, w)
    s = wp.float64(0.0)
    area = uu * vv - uv * uv
    if area > wp.float64(1.0e-12) * uu * vv:
        s = wp.clamp((uv * vw - vv * uw) / area, ZERO, ONE)
    t = wp.float64(0.0)
    if vv > ZERO:
        t = wp.clamp((uv * s + vw) / vv, ZERO, ONE)
    if uu > ZERO:
        s = wp.clamp((uv * t - uw) / uu, ZERO, ONE)
    return s, t


@wp.func
def nearest_points(p_in: wp.mat33, q_in: wp.mat33) -> Nearest:
    """The nearest of the 6 pairs of a corner and a face, and the 9 pairs of edges, in float64."""
    p = wp.mat33d(p_in)
    q = wp.mat33d(q_in)
    best = Nearest()
    best.squared = wp.float64(wp.inf)
    for i in range(3):
        corner = p[i]
        weights = weights_of_nearest(corner, q)
        way = corner - wp.transpose(q) * weights
        if wp.dot(way, way) < best.squared:
            best.squared = wp.dot(way, way)
            best.way = way
            best.weights_q = weights
            best.weights_p = wp.vec3d(
                wp.where(i == 0, ONE, ZERO), wp.where(i == 1, ONE, ZERO), wp.where(i == 2, ONE, ZERO)
            )
    for i in range(3):
        corner = q[i]
        weights = weights_of_nearest(corner, p)
        way = wp.transpose(p) * weights - corner
        if wp.dot(way, way) < best.squared:
            best.squared = wp.dot(way, way)
            best.way = way
            best.weights_p = weights
            best.weights_q = wp.vec3d(
                wp.where(i == 0, ONE, ZERO), wp.where(i == 1, ONE, ZERO), wp.where(i == 2, ONE, ZERO)
            )
    for i in range(3):
        a = p[i]
        u = p[(i + 1) % 3] - a
        for j in range(3):
            b = q[j]
            v = q[(j + 1) % 3] - b
            s, t = nearest_on_segments(a, u, b, v)
            way = (a + s * u) - (b + t * v)
            if wp.dot(way, way) < best.squared:
                best.squared = wp.dot(way, way)
                best.way = way
                best.weights_p = wp.vec3d()
                best.weights_p[i] = ONE - s
                best.weights_p[(i + 1) % 3] = s
                best.weights_q = wp.vec3d()
                best.weights_q[j] = ONE - t
                best.weights_q[(j + 1) % 3] = t
    return best


@wp.func
def separating(p: wp.mat33, q: wp.mat33) -> wp.vec3:
    """The unit vector from B to A along which they are farthest apart; zero where they cross or touch."""
    found = nearest_points(p, q)
    normal = wp.vec3()
    if found.squared > wp.float64(TOUCHING * TOUCHING):
        way = wp.vec3(found.way / wp.sqrt(found.squared))
        if gap_along(p, q, way) > TOUCHING:
            normal = way
    return normal
