"""The rule for the nearest face of a body if several faces are equally near.

Manifold-aware transformers, section 4.2 (the nearest body face of d_i). For every fourth point around a person the
nearest point of the body lies on an edge or a vertex: over a convex edge, the faces on both sides are equally near.
Which of them a search meets first depends on its tree and on rounding, yet the motion of the named face is an input of
the network. The rule is therefore:

    the nearest point is inside a face     that face
    on an edge                             the smallest index of the faces that share the edge
    at a vertex                            the smallest index of the faces around the vertex

No tolerance is involved. The part of a face on which its nearest point lies follows from the signs of dot products in
float64, which are the same for all faces that share the part. However, a search in float32 cannot distinguish faces
whose nearest points are up to some 0.1 mm apart: the distance is flat around its minimum, where a difference of 1e-7 m
corresponds to such a length along the surface. Close to where two parts meet, the search may return the face that is
slightly further away. Therefore the faces around the part that was found are examined too, and if one of them is
nearer, the rule is applied there.

The rule does not cover points that are equally far from two places of the body that do not touch, for instance between
the legs. There the nearest point itself jumps, and within rounding (1e-7 m) of the jump either face is right. This does
no harm to a single query, and no rule could make it repeatable.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from .model import Bodies, corners_of

PARTS = wp.constant(6)  # parts that a face shares with others: corners 0, 1, 2, and edges 3, 4, 5 that begin there
INSIDE = wp.constant(6)
NO_PART = wp.constant(-1)
CLOSE = wp.constant(wp.float64(0.02))  # barycentric, 0.4 mm of a usual edge: closer to a part, its faces are examined
SLIVER = wp.constant(wp.float64(1.0e-12))  # (2 area / sum of squared edges)²; Warp's searches skip what is thinner


def rings_of(faces: np.ndarray) -> np.ndarray:
    """For each corner and each edge of each face, the next face that shares it; the faces of a part form a ring.

    Args:
        faces: Vertex indices of a body, integers [G, 3]; any number of faces may share an edge, in any orientation.

    Returns:
        int32 [G, 6], one column per part: 6 times the next face, plus the number that the part has in that face. The
        last face leads to the first; a single face leads to itself.
    """
    start = faces.astype(np.int64)
    end = start[:, [1, 2, 0]]
    count = int(start.max(initial=0)) + 1
    edges = (1 + np.minimum(start, end)) * count + np.maximum(start, end)  # keys that differ from those of vertices
    keys = np.concatenate([start, edges], axis=1).ravel()
    order = np.argsort(keys, kind="stable")
    is_last = np.append(np.diff(keys[order]) != 0, True)
    is_first = np.append(True, is_last[:-1])
    following = np.append(order[1:], 0)
    following[is_last] = order[is_first]
    rings = np.empty((len(faces), 6), np.int32)
    rings.ravel()[order] = following
    return rings


@wp.func
def along_edges(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, point: wp.vec3d):
    """Distance of a point beyond the start and beyond the end of each edge of a triangle, times the edge's length."""
    ab, bc, ca = b - a, c - b, a - c
    pa, pb, pc = point - a, point - b, point - c
    after = wp.vec3d(wp.dot(pa, ab), wp.dot(pb, bc), wp.dot(pc, ca))
    beyond = wp.vec3d(wp.dot(pb, ab), wp.dot(pc, bc), wp.dot(pa, ca))
    return after, beyond


@wp.func
def inward_of_edges(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, after: wp.vec3d, beyond: wp.vec3d):
    """n · (e × p) = |e|² (f · q) - (e · f) (e · q) for each edge e of a triangle.

    f is the edge after e; p and q lead to the point from the starts of e and f; n is the cross product of two edges.
    The number is positive on the inner side of the edge, and the three of them add up to n².
    """
    ab, bc, ca = b - a, c - b, a - c
    return wp.vec3d(
        wp.dot(ab, ab) * after[1] - wp.dot(ab, bc) * beyond[0],
        wp.dot(bc, bc) * after[2] - wp.dot(bc, ca) * beyond[1],
        wp.dot(ca, ca) * after[0] - wp.dot(ca, ab) * beyond[2],
    )


@wp.func
def nearest_part(bodies: wp.array[Bodies], b: int, face: int, point: wp.vec3d):
    """The part of a face that is nearest to a point, and the part whose faces may be nearer still.

    Returns:
        Nearest part, and the edge or corner close to the nearest point, which is the nearest part if there is none.
        Both are NO_PART if the face is a sliver.
    """
    p, q, r = corners_of(bodies, b, face)
    after, beyond = along_edges(p, q, r, point)
    inward = inward_of_edges(p, q, r, after, beyond)
    ab, bc, ca = q - p, r - q, p - r
    area = wp.dot(ab, ab) * wp.dot(bc, bc) - wp.dot(ab, bc) * wp.dot(ab, bc)
    size = wp.dot(ab, ab) + wp.dot(bc, bc) + wp.dot(ca, ca)
    if not area > SLIVER * size * size:
        return NO_PART, NO_PART
    part = wp.int32(INSIDE)
    around = wp.int32(INSIDE)
    zero = wp.float64(0.0)
    if wp.min(inward) > zero:
        for k in range(3):
            if inward[k] < CLOSE * area:
                around = 3 + k
        return part, around
    for k in range(3):
        if after[k] <= zero and beyond[(k + 2) % 3] >= zero:
            part = k
            around = k
        elif inward[k] <= zero and after[k] > zero and beyond[k] < zero:
            part = 3 + k
            around = 3 + k
            if after[k] < -CLOSE * beyond[k]:
                around = k
            elif -beyond[k] < CLOSE * after[k]:
                around = (k + 1) % 3
    return part, around


@wp.func
def nearest_on_part(bodies: wp.array[Bodies], b: int, face: int, part: int, point: wp.vec3d):
    """Barycentric coordinates of the nearest point on a given part of a face, and its squared distance [m²]."""
    p, q, r = corners_of(bodies, b, face)
    after, beyond = along_edges(p, q, r, point)
    inward = inward_of_edges(p, q, r, after, beyond)
    weights = wp.vec3d(inward[1], inward[2], inward[0]) / (inward[0] + inward[1] + inward[2])
    for k in range(3):
        if part == k:
            weights = wp.vec3d()
            weights[k] = wp.float64(1.0)
        elif part == 3 + k:
            t = after[k] / (after[k] - beyond[k])
            weights = wp.vec3d()
            weights[k] = wp.float64(1.0) - t
            weights[(k + 1) % 3] = t
    return weights, wp.length_sq(weights[0] * p + weights[1] * q + weights[2] * r - point)


@wp.func
def nearest_on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Barycentric coordinates of the point of a triangle that is nearest to p.

    They are those of the foot of the perpendicular if it is inside, or else of the nearest point of the edges. Of a
    triangle with edges of length e and an area A, the error is some 1e-16 e³/A, also where it is slender.
    """
    n = wp.cross(b - a, c - a)
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    outside = wp.int32(0)
    weights = wp.vec3d(one, zero, zero)
    least = wp.length_sq(p - a)
    for k in range(3):
        start = wp.where(k == 0, a, wp.where(k == 1, b, c))
        edge = wp.where(k == 0, b, wp.where(k == 1, c, a)) - start
        if wp.dot(wp.cross(n, edge), p - start) < zero:
            outside += 1
        t = wp.clamp(wp.dot(p - start, edge) / wp.max(wp.dot(edge, edge), wp.float64(1e-300)), zero, one)
        distance = wp.length_sq(p - start - t * edge)
        if distance < least:
            least = distance
            weights = wp.vec3d()
            weights[k] = one - t
            weights[(k + 1) % 3] = t
    if outside == 0 and wp.length_sq(n) > zero:
        q = p - n * (wp.dot(n, p - a) / wp.length_sq(n))
        of_b = wp.dot(n, wp.cross(c - q, a - q)) / wp.length_sq(n)
        of_c = wp.dot(n, wp.cross(a - q, b - q)) / wp.length_sq(n)
        weights = wp.vec3d(one - of_b - of_c, of_b, of_c)
    return weights


@wp.func
def closest_on_triangle(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """The point of a triangle that is nearest to p."""
    weights = nearest_on_triangle(p, a, b, c)
    return weights[0] * a + weights[1] * b + weights[2] * c


@wp.func
def named_face(bodies: wp.array[Bodies], b: int, face: int, point: wp.vec3):
    """The face that the rule of this module names, starting from a face that a search found.

    Args:
        bodies: The bodies.
        b: The body.
        face: Face that the search found, counted within the body.
        point: Position [m].
    """
    p = wp.vec3d(point)
    first_ring = bodies[0].ring_offsets[b]
    nearest = wp.int32(face)
    part, around = nearest_part(bodies, b, nearest, p)
    named = wp.int32(face)
    begin = wp.int32(-1)
    # The loop ends, because each round that changes the face comes nearer to the point.
    while around >= 0 and around < PARTS and begin != PARTS * nearest + around:
        begin = PARTS * nearest + around
        named = nearest
        at = bodies[0].rings[first_ring + nearest, around]
        while at != begin:
            other = at // PARTS
            shared = at - PARTS * other
            theirs, _around = nearest_part(bodies, b, other, p)
            if theirs != NO_PART:
                named = wp.min(named, other)
                if theirs != shared:
                    _w, distance = nearest_on_part(bodies, b, other, theirs, p)
                    _v, least = nearest_on_part(bodies, b, nearest, part, p)
                    if distance < least:
                        nearest = other
                        part = theirs
            at = bodies[0].rings[first_ring + other, shared]
        around = part
    if part == INSIDE:
        named = nearest
    return named
