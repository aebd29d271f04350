"""Searches of the trees of tree.py for the nearest face of a point; see tree_boxes.py for boxes, tree_rays.py for rays.

A node's lanes are looked at together. Their bounds are made integers, which order like the floating-point numbers they
are made of as long as these are not negative, with the number of the lane in the lowest three bits: the least of the
eight is the nearest child and its bound at once. A bound loses one part in a million by that, downwards.

Loops over lanes are written with `while`, since Warp would unroll a `for`, and its compiler makes vector instructions
of loops only. The pairs of `least` and `most` are such that they become vectors, too.
"""

from __future__ import annotations

import warp as wp

from .model import Bodies
from .tree import FAR, vec8, vec8i

NEVER = wp.constant(0x7FFFFFFF)
LANE = wp.constant(7)
"""The bits of a key that are a lane."""
stack64 = wp.types.vector(length=64, dtype=wp.int32)  # seven for each level, which is enough for eight levels


@wp.func
def least(k: vec8i):
    a = wp.min(k[0], k[4])
    b = wp.min(k[1], k[5])
    c = wp.min(k[2], k[6])
    d = wp.min(k[3], k[7])
    a = wp.min(a, c)
    b = wp.min(b, d)
    return wp.min(a, b)


@wp.func
def most(k: vec8i):
    a = wp.max(k[0], k[4])
    b = wp.max(k[1], k[5])
    c = wp.max(k[2], k[6])
    d = wp.max(k[3], k[7])
    a = wp.max(a, c)
    b = wp.max(b, d)
    return wp.max(a, b)


@wp.func
def least_above(keys: vec8i, last: int):
    """The least key that is larger than `last`, or NEVER."""
    m = vec8i()
    r = wp.int32(0)
    while r < 8:
        m[r] = wp.where(keys[r] > last, keys[r], NEVER)
        r += 1
    return least(m)


@wp.func
def most_below(keys: vec8i, first: int):
    """The largest key that is smaller than `first`, or -1."""
    m = vec8i()
    r = wp.int32(0)
    while r < 8:
        m[r] = wp.where(keys[r] < first, keys[r], -1)
        r += 1
    return most(m)


@wp.func
def lane_of(keys: vec8i, key: int):
    """The first lane with this key."""
    m = vec8i()
    r = wp.int32(0)
    while r < 8:
        m[r] = wp.where(keys[r] == key, r, 7)
        r += 1
    return least(m)


@wp.func
def distances_to_boxes(boxes: wp.array2d[vec8], node: int, px: float, py: float, pz: float):
    """Keys of the children of a node: squared distances of their boxes from a point."""
    lx = boxes[node, 0]
    ly = boxes[node, 1]
    lz = boxes[node, 2]
    hx = boxes[node, 3]
    hy = boxes[node, 4]
    hz = boxes[node, 5]
    keys = vec8i()
    r = wp.int32(0)
    while r < 8:
        x0 = lx[r] - px
        x1 = px - hx[r]
        y0 = ly[r] - py
        y1 = py - hy[r]
        z0 = lz[r] - pz
        z1 = pz - hz[r]
        x = wp.where(x0 > x1, x0, x1)
        y = wp.where(y0 > y1, y0, y1)
        z = wp.where(z0 > z1, z0, z1)
        x = wp.where(x > 0.0, x, 0.0)
        y = wp.where(y > 0.0, y, 0.0)
        z = wp.where(z > 0.0, z, 0.0)
        keys[r] = (wp.cast(x * x + y * y + z * z, wp.int32) & ~LANE) | r
        r += 1
    return keys


@wp.func
def distances_to_triangles(frames: wp.array2d[vec8], leaf: int, px: float, py: float, pz: float):
    """Squared distances of a point from the triangles of a leaf [m²], as bits.

    In the frame of a triangle this is z² + 0 inside, else z² and the least squared distance from the three edges.
    """
    ox = frames[leaf, 0]
    oy = frames[leaf, 1]
    oz = frames[leaf, 2]
    xx = frames[leaf, 3]
    xy = frames[leaf, 4]
    xz = frames[leaf, 5]
    yx = frames[leaf, 6]
    yy = frames[leaf, 7]
    yz = frames[leaf, 8]
    zx = frames[leaf, 9]
    zy = frames[leaf, 10]
    zz = frames[leaf, 11]
    length = frames[leaf, 12]
    along = frames[leaf, 13]
    across = frames[leaf, 14]
    per_ac = frames[leaf, 15]
    per_bc = frames[leaf, 16]
    bits = vec8i()
    r = wp.int32(0)
    while r < 8:
        qx = px - ox[r]
        qy = py - oy[r]
        qz = pz - oz[r]
        x = qx * xx[r] + qy * xy[r] + qz * xz[r]
        y = qx * yx[r] + qy * yy[r] + qz * yz[r]
        z = qx * zx[r] + qy * zy[r] + qz * zz[r]
        l = length[r]
        cx = along[r]
        cy = across[r]
        bx = cx - l
        u = x - l
        # From ab, ac, bc.
        t = wp.where(x > 0.0, x, 0.0)
        t = wp.where(t < l, t, l)
        nearest = (x - t) * (x - t) + y * y
        t = (x * cx + y * cy) * per_ac[r]
        t = wp.where(t > 0.0, t, 0.0)
        t = wp.where(t < 1.0, t, 1.0)
        dx = x - t * cx
        dy = y - t * cy
        d = dx * dx + dy * dy
        nearest = wp.where(nearest < d, nearest, d)
        t = (u * bx + y * cy) * per_bc[r]
        t = wp.where(t > 0.0, t, 0.0)
        t = wp.where(t < 1.0, t, 1.0)
        dx = u - t * bx
        dy = y - t * cy
        d = dx * dx + dy * dy
        nearest = wp.where(nearest < d, nearest, d)
        # Inside all three edges?
        s = cy * x - cx * y
        t = bx * y - cy * u
        s = wp.where(s < t, s, t)
        s = wp.where(s < y, s, y)
        nearest = wp.where(s > 0.0, 0.0, nearest)
        d = nearest + z * z
        bits[r] = wp.cast(wp.where(d < FAR * FAR, d, FAR * FAR), wp.int32)
        r += 1
    return bits


@wp.func
def nearest_by_tree(bodies: wp.array[Bodies], b: int, point: wp.vec3, reach: float) -> int:
    """The face of a body, counted within it, that is nearest to a point; -1 if none is nearer than `reach` [m].

    Nodes are kept on a stack, the nearest on top, and children of the last level are looked at in the order of their
    distance, up to the least distance that was found so far.
    """
    tree = bodies[0].tree
    px = point[0]
    py = point[1]
    pz = point[2]
    best = wp.cast(reach * reach, wp.int32)
    face = wp.int32(-1)
    nodes = stack64()
    bounds = stack64()
    top = wp.int32(0)
    node = tree.nodes[b]
    while node >= 0:
        keys = distances_to_boxes(tree.boxes, node, px, py, pz)
        first = tree.children[node]
        node = wp.int32(-1)
        near = least(keys)
        if first < 0:
            while near < best:
                leaf = ~first + (near & LANE)
                bits = distances_to_triangles(tree.frames, leaf, px, py, pz)
                found = least(bits)
                if found < best:
                    best = found
                    face = tree.faces[leaf][lane_of(bits, found)]
                near = least_above(keys, near)
        elif near < best:
            node = first + (near & LANE)
            key = most_below(keys, best)
            while key > near:
                nodes[top] = first + (key & LANE)
                bounds[top] = key & ~LANE
                top += 1
                key = most_below(keys, key)
        while node < 0 and top > 0:
            top -= 1
            if bounds[top] < best:
                node = nodes[top]
    return face
