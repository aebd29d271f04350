"""The first face of a body that a ray of any direction meets: in the trees of tree.py on a CPU, in Warp's on a GPU.

After Woop, Benthin and Wald 2013: the axes are such that the ray is longest along k, and the corners A, B, C, seen from
its origin, are sheared until it runs along k. It meets a triangle whose projection contains the origin:

    A' = (A_i - s_i A_k, A_j - s_j A_k),    s = r / r_k,    U = C' × B',  V = A' × C',  W = B' × A'  of one sign

Both faces that share an edge compute the same product for it, up to its sign, so no ray passes between them. Lanes of
boxes and triangles are tested in float32; how far a triangle that is met is away, in float64. Loops over lanes are
written as in tree_search.py.
"""

from __future__ import annotations

import warp as wp

from .model import Bodies, corners_of, has_tree
from .tree import vec8, vec8i
from .tree_search import NEVER, least, least_above, stack64

FLAT = wp.constant(1.0e-20)
"""In place of a zero in a direction: its reciprocal is finite, also times the place of a box that is not used."""
WIDER = wp.constant(1.000001)
"""Share by which the ends of a box are moved away, for rounding."""


@wp.struct
class Ray:
    """A ray, prepared for boxes and triangles."""

    origin: wp.vec3
    inverse: wp.vec3  # of its direction
    shear: wp.vec3  # s_i, s_j and 1
    axes: wp.vec3i  # i, j, k


@wp.func
def made_ray(origin: wp.vec3, way: wp.vec3):
    """A ray with a direction that is a unit vector."""
    ray = Ray()
    ray.origin = origin
    size = wp.vec3(wp.abs(way[0]), wp.abs(way[1]), wp.abs(way[2]))
    k = wp.where(size[0] > wp.max(size[1], size[2]), 0, wp.where(size[1] > size[2], 1, 2))
    i = (k + 1) % 3
    j = (k + 2) % 3
    ray.axes = wp.vec3i(i, j, k)
    ray.shear = wp.vec3(way[i] / way[k], way[j] / way[k], 1.0)
    for axis in range(3):
        ray.inverse[axis] = 1.0 / wp.where(size[axis] < FLAT, FLAT, way[axis])
    return ray


@wp.func
def boxes_along(boxes: wp.array2d[vec8], node: int, ray: Ray, limit: float):
    """Lanes of the children of a node whose boxes a ray meets before `limit` [m], NEVER elsewhere."""
    x = ray.origin[0]
    y = ray.origin[1]
    z = ray.origin[2]
    u = ray.inverse[0]
    v = ray.inverse[1]
    w = ray.inverse[2]
    x0 = boxes[node, wp.where(u > 0.0, 0, 3)]
    x1 = boxes[node, wp.where(u > 0.0, 3, 0)]
    y0 = boxes[node, wp.where(v > 0.0, 1, 4)]
    y1 = boxes[node, wp.where(v > 0.0, 4, 1)]
    z0 = boxes[node, wp.where(w > 0.0, 2, 5)]
    z1 = boxes[node, wp.where(w > 0.0, 5, 2)]
    lanes = vec8i()
    r = wp.int32(0)
    while r < 8:
        begin = (x0[r] - x) * u
        end = (x1[r] - x) * u
        t = (y0[r] - y) * v
        begin = wp.where(begin > t, begin, t)
        t = (y1[r] - y) * v
        end = wp.where(end < t, end, t)
        t = (z0[r] - z) * w
        begin = wp.where(begin > t, begin, t)
        t = (z1[r] - z) * w
        end = wp.where(end < t, end, t)
        begin = wp.where(begin > 0.0, begin, 0.0)
        end = wp.where(end < limit, end, limit)
        lanes[r] = wp.where(begin <= end * WIDER, r, NEVER)
        r += 1
    return lanes


@wp.func
def triangles_along(corners: wp.array2d[vec8], leaf: int, ray: Ray):
    """Lanes of the triangles of a leaf that the line of a ray meets, NEVER elsewhere."""
    i = ray.axes[0]
    j = ray.axes[1]
    k = ray.axes[2]
    oi = ray.origin[i]
    oj = ray.origin[j]
    ok = ray.origin[k]
    si = ray.shear[0]
    sj = ray.shear[1]
    ai = corners[leaf, i]
    aj = corners[leaf, j]
    ak = corners[leaf, k]
    bi = corners[leaf, i + 3]
    bj = corners[leaf, j + 3]
    bk = corners[leaf, k + 3]
    ci = corners[leaf, i + 6]
    cj = corners[leaf, j + 6]
    ck = corners[leaf, k + 6]
    lanes = vec8i()
    r = wp.int32(0)
    while r < 8:
        d = ak[r] - ok
        a0 = (ai[r] - oi) - si * d
        a1 = (aj[r] - oj) - sj * d
        d = bk[r] - ok
        b0 = (bi[r] - oi) - si * d
        b1 = (bj[r] - oj) - sj * d
        d = ck[r] - ok
        c0 = (ci[r] - oi) - si * d
        c1 = (cj[r] - oj) - sj * d
        u = c0 * b1 - c1 * b0
        v = a0 * c1 - a1 * c0
        w = b0 * a1 - b1 * a0
        low = wp.where(u < v, u, v)
        low = wp.where(low < w, low, w)
        high = wp.where(u > v, u, v)
        high = wp.where(high > w, high, w)
        high = wp.where(-low < high, -low, high)  # positive where two of them have opposite signs
        lanes[r] = wp.where(high > 0.0, NEVER, r)
        r += 1
    return lanes


@wp.func
def hit_by_tree(bodies: wp.array[Bodies], b: int, origin: wp.vec3, way: wp.vec3, limit: float):
    """`first_hit` in the trees of tree.py; of faces that are equally far, the one with the smallest number."""
    tree = bodies[0].tree
    ray = made_ray(origin, way)
    nearest = wp.float32(limit)
    face = wp.int32(-1)
    turned = wp.float32(0.0)
    nodes = stack64()
    nodes[0] = tree.nodes[b]
    top = wp.int32(1)
    while top > 0:
        top -= 1
        node = nodes[top]
        lanes = boxes_along(tree.boxes, node, ray, nearest)
        first = tree.children[node]
        lane = least(lanes)
        while lane < 8:
            if first < 0:
                leaf = ~first + lane
                met = triangles_along(tree.corners, leaf, ray)
                r = least(met)
                while r < 8:
                    other = tree.faces[leaf][r]
                    if other >= 0:
                        p, q, s = corners_of(bodies, b, other)
                        normal = wp.cross(q - p, s - p)
                        facing = wp.dot(normal, wp.vec3d(way))
                        far = wp.float32(wp.dot(normal, p - wp.vec3d(origin)) / facing)
                        if far >= 0.0 and (far < nearest or (far == nearest and other < face)):
                            nearest = far
                            face = other
                            turned = wp.float32(wp.sign(facing))
                    r = least_above(met, r)
            else:
                nodes[top] = first + lane
                top += 1
            lane = least_above(lanes, lane)
    return face, nearest, turned


@wp.func
def first_hit(bodies: wp.array[Bodies], b: int, origin: wp.vec3, way: wp.vec3, limit: float):
    """The first face of a body that a ray meets.

    Args:
        bodies: The bodies.
        b: The body.
        origin: Where the ray begins [m].
        way: Its direction, a unit vector.
        limit: Distance at which it ends [m].

    Returns:
        The face, counted within the body, -1 if there is none; its distance [m]; and 1 where the ray meets it from
        behind, which leaves the body, else -1.
    """
    face = wp.int32(-1)
    far = wp.float32(limit)
    turned = wp.float32(0.0)
    if has_tree(bodies):
        face, far, turned = hit_by_tree(bodies, b, origin, way, limit)
    else:
        hit = wp.mesh_query_ray(bodies[0].meshes[b], origin, way, limit)
        if hit.result:
            face = hit.face
            far = hit.t
            turned = wp.where(wp.dot(hit.normal, way) > 0.0, 1.0, -1.0)
    return face, far, turned
