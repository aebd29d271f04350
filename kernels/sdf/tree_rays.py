"""Rays along an axis through the trees of tree.py, with the decisions of inside.py, which are the same to the last bit.

Loops over lanes are written as in tree_search.py.
"""

from __future__ import annotations

import warp as wp

from .inside import crossing, volume_of
from .model import Bodies
from .tree import vec8, vec8i
from .tree_search import NEVER, least, least_above, stack64


@wp.func
def boxes_on_ray(boxes: wp.array2d[vec8], node: int, along: float, pu: float, pv: float, axis: int, side: float):
    """Lanes of the children of a node whose boxes a ray along an axis meets, NEVER elsewhere."""
    u = (axis + 1) % 3
    v = (axis + 2) % 3
    lu = boxes[node, u]
    hu = boxes[node, u + 3]
    lv = boxes[node, v]
    hv = boxes[node, v + 3]
    end = boxes[node, wp.where(side > 0.0, axis + 3, axis)]
    lanes = vec8i()
    r = wp.int32(0)
    while r < 8:
        # The least of all margins.
        m = pu - lu[r]
        n = hu[r] - pu
        m = wp.where(m < n, m, n)
        n = pv - lv[r]
        m = wp.where(m < n, m, n)
        n = hv[r] - pv
        m = wp.where(m < n, m, n)
        n = (end[r] - along) * side
        m = wp.where(m < n, m, n)
        lanes[r] = wp.where(m >= 0.0, r, NEVER)
        r += 1
    return lanes


@wp.func
def turn(su: float, sv: float, eu: float, ev: float):
    """How an edge of a projected triangle counts in `inside.turns_around`: 1, -1 or 0."""
    rising = sv <= 0.0
    changes = rising != (ev <= 0.0)
    lu = wp.where(rising, su, eu)
    lv = wp.where(rising, sv, ev)
    hu = wp.where(rising, eu, su)
    hv = wp.where(rising, ev, sv)
    counts = wp.where(lu * hv > hu * lv, wp.where(rising, 1, -1), 0)
    return wp.where(changes, counts, 0)


@wp.func
def turns_of_leaf(corners: wp.array2d[vec8], leaf: int, axis: int, pu: float, pv: float):
    """`inside.turns_around` of the triangles of a leaf, along a ray."""
    u = (axis + 1) % 3
    v = (axis + 2) % 3
    au = corners[leaf, u]
    av = corners[leaf, v]
    bu = corners[leaf, u + 3]
    bv = corners[leaf, v + 3]
    cu = corners[leaf, u + 6]
    cv = corners[leaf, v + 6]
    turns = vec8i()
    r = wp.int32(0)
    while r < 8:
        a0 = au[r] - pu
        a1 = av[r] - pv
        b0 = bu[r] - pu
        b1 = bv[r] - pv
        c0 = cu[r] - pu
        c1 = cv[r] - pv
        turns[r] = turn(a0, a1, b0, b1) + turn(b0, b1, c0, c1) + turn(c0, c1, a0, a1)
        r += 1
    return turns


@wp.func
def crossings_in_leaf(corners: wp.array2d[vec8], leaf: int, point: wp.vec3, axis: int, side: float):
    """`inside.crossings` of the triangles of a leaf."""
    turns = turns_of_leaf(corners, leaf, axis, point[(axis + 1) % 3], point[(axis + 2) % 3])
    lanes = vec8i()
    r = wp.int32(0)
    while r < 8:
        lanes[r] = wp.where(turns[r] != 0, r, NEVER)
        r += 1
    total = wp.int32(0)
    r = least(lanes)
    while r < 8:
        a = wp.vec3(corners[leaf, 0][r], corners[leaf, 1][r], corners[leaf, 2][r]) - point
        b = wp.vec3(corners[leaf, 3][r], corners[leaf, 4][r], corners[leaf, 5][r]) - point
        c = wp.vec3(corners[leaf, 6][r], corners[leaf, 7][r], corners[leaf, 8][r]) - point
        total += crossing(turns[r], volume_of(wp.vec3d(a), wp.vec3d(b), wp.vec3d(c)), side)
        r = least_above(lanes, r)
    return total


@wp.func
def crossings_by_tree(bodies: wp.array[Bodies], b: int, point: wp.vec3, axis: int, side: float) -> int:
    """Signed number of crossings of a ray with a body, as `inside.crossings`."""
    tree = bodies[0].tree
    pu = point[(axis + 1) % 3]
    pv = point[(axis + 2) % 3]
    along = point[axis]
    total = wp.int32(0)
    nodes = stack64()
    nodes[0] = tree.nodes[b]
    top = wp.int32(1)
    while top > 0:
        top -= 1
        node = nodes[top]
        lanes = boxes_on_ray(tree.boxes, node, along, pu, pv, axis, side)
        first = tree.children[node]
        lane = least(lanes)
        while lane < 8:
            if first < 0:
                total += crossings_in_leaf(tree.corners, ~first + lane, point, axis, side)
            else:
                nodes[top] = first + lane
                top += 1
            lane = least_above(lanes, lane)
    return total
