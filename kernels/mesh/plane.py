"""Vectors, segments and directions in a plane, in float64, as functions for kernels."""

from __future__ import annotations

import warp as wp

SECTORS = 96
_SECTORS = wp.constant(SECTORS)


@wp.func
def cross(a: wp.vec2d, b: wp.vec2d) -> wp.float64:
    """Twice the area between two vectors, positive if b lies to the left of a."""
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def norm(a: wp.vec2d) -> wp.float64:
    """Length of a vector."""
    return wp.sqrt(a[0] * a[0] + a[1] * a[1])


@wp.func
def distance_to_segment(a: wp.vec2d, b: wp.vec2d) -> wp.float64:
    """Distance of the origin from a segment."""
    d = b - a
    squared = wp.max(d[0] * d[0] + d[1] * d[1], wp.float64(1e-300))
    t = wp.clamp(-(a[0] * d[0] + a[1] * d[1]) / squared, wp.float64(0.0), wp.float64(1.0))
    return norm(a + t * d)


@wp.func
def at_ray(ray: wp.vec2d, right: wp.vec2d, left: wp.vec2d) -> wp.vec2d:
    """The point of a segment in the direction of a ray; the nearer end where the ray passes it."""
    before = cross(right, ray)
    behind = cross(ray, left)
    if before <= wp.float64(0.0):
        return right
    if behind <= wp.float64(0.0):
        return left
    return right + before / (before + behind) * (left - right)


@wp.func
def sector(direction: wp.vec2d) -> int:
    """Number of the sector of the plane in which a direction lies, anticlockwise.

    Sectors are equal steps of x / (|x| + |y|), for which no angle has to be computed.
    """
    x = direction[0] / wp.max(wp.abs(direction[0]) + wp.abs(direction[1]), wp.float64(1e-300))
    turn = wp.float64(1.0) - x  # 0 to 2 in the upper half-plane
    if direction[1] < wp.float64(0.0):
        turn = wp.float64(3.0) + x
    return wp.min(int(turn * wp.float64(_SECTORS / 4)), _SECTORS - 1)
