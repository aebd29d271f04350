"""Searches of the trees of tree.py for what is in a box and above a face.

Loops over lanes are written as in tree_search.py.
"""

from __future__ import annotations

import warp as wp

from .tree import vec8, vec8i
from .tree_search import NEVER


@wp.func
def boxes_in_box(boxes: wp.array2d[vec8], node: int, low: wp.vec3, high: wp.vec3):
    """Lanes of the children of a node whose boxes meet a box, NEVER elsewhere."""
    l0 = boxes[node, 0]
    l1 = boxes[node, 1]
    l2 = boxes[node, 2]
    h0 = boxes[node, 3]
    h1 = boxes[node, 4]
    h2 = boxes[node, 5]
    lanes = vec8i()
    r = wp.int32(0)
    while r < 8:
        m = high[0] - l0[r]
        n = h0[r] - low[0]
        m = wp.where(m < n, m, n)
        n = high[1] - l1[r]
        m = wp.where(m < n, m, n)
        n = h1[r] - low[1]
        m = wp.where(m < n, m, n)
        n = high[2] - l2[r]
        m = wp.where(m < n, m, n)
        n = h2[r] - low[2]
        m = wp.where(m < n, m, n)
        lanes[r] = wp.where(m >= 0.0, r, NEVER)
        r += 1
    return lanes


@wp.func
def margin(px: float, py: float, pz: float, x: wp.vec3, n: wp.vec3, thick: float, low: wp.vec3, high: wp.vec3):
    """Positive where 0 < n·(p - x) < thick and p is in a box."""
    m = (px - x[0]) * n[0] + (py - x[1]) * n[1] + (pz - x[2]) * n[2]
    m = wp.where(m < thick - m, m, thick - m)
    inside = wp.where(px - low[0] < high[0] - px, px - low[0], high[0] - px)
    t = wp.where(py - low[1] < high[1] - py, py - low[1], high[1] - py)
    inside = wp.where(t < inside, t, inside)
    t = wp.where(pz - low[2] < high[2] - pz, pz - low[2], high[2] - pz)
    inside = wp.where(t < inside, t, inside)
    return wp.where(inside < 0.0, -1.0, m)


@wp.func
def triangles_above(
    corners: wp.array2d[vec8], leaf: int, x: wp.vec3, n: wp.vec3, thick: float, low: wp.vec3, high: wp.vec3
):
    """Lanes of the triangles of a leaf that look the way of n and have a corner as in `margin`, NEVER elsewhere."""
    ax = corners[leaf, 0]
    ay = corners[leaf, 1]
    az = corners[leaf, 2]
    bx = corners[leaf, 3]
    by = corners[leaf, 4]
    bz = corners[leaf, 5]
    cx = corners[leaf, 6]
    cy = corners[leaf, 7]
    cz = corners[leaf, 8]
    lanes = vec8i()
    r = wp.int32(0)
    while r < 8:
        ex = bx[r] - ax[r]
        ey = by[r] - ay[r]
        ez = bz[r] - az[r]
        fx = cx[r] - ax[r]
        fy = cy[r] - ay[r]
        fz = cz[r] - az[r]
        facing = (ey * fz - ez * fy) * n[0] + (ez * fx - ex * fz) * n[1] + (ex * fy - ey * fx) * n[2]
        m = margin(ax[r], ay[r], az[r], x, n, thick, low, high)
        t = margin(bx[r], by[r], bz[r], x, n, thick, low, high)
        m = wp.where(m > t, m, t)
        t = margin(cx[r], cy[r], cz[r], x, n, thick, low, high)
        m = wp.where(m > t, m, t)
        m = wp.where(m < facing, m, facing)
        lanes[r] = wp.where(m > 0.0, r, NEVER)
        r += 1
    return lanes
