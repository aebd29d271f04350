"""Kernels that move the bodies and pins of all worlds of a Newton model, in one launch each."""

from __future__ import annotations

import warp as wp


@wp.kernel(enable_backward=False)
def set_bodies_kernel(
    # In:
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    world: wp.array[int],  # world of each body vertex
    share: float,
    fps: float,
    origin: wp.array[wp.vec3],  # origin of each world's moving coordinates
    origin_velocity: wp.array[wp.vec3],
    # Out:
    points: wp.array[wp.vec3],
    velocities: wp.array[wp.vec3],
):
    """Body vertices between two frames of the motion, in the moving coordinates of their world."""
    i = wp.tid()
    w = world[i]
    points[i] = wp.lerp(before[i], after[i], share) - origin[w]
    velocities[i] = (after[i] - before[i]) * fps - origin_velocity[w]


@wp.kernel(enable_backward=False)
def set_pins_kernel(
    # In:
    pin: wp.array[int],  # particle
    corner: wp.array[wp.vec3i],  # body vertices to which the particle is tied
    barycentric: wp.array[wp.vec3],
    height: wp.array[float],
    points: wp.array[wp.vec3],
    velocities: wp.array[wp.vec3],
    # Out:
    position: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
):
    """Pinned particles, which keep their place on a body face and their height above it."""
    i = wp.tid()
    a = corner[i][0]
    b = corner[i][1]
    c = corner[i][2]
    w = barycentric[i]
    normal = wp.normalize(wp.cross(points[b] - points[a], points[c] - points[a]))
    position[pin[i]] = w[0] * points[a] + w[1] * points[b] + w[2] * points[c] + height[i] * normal
    velocity[pin[i]] = w[0] * velocities[a] + w[1] * velocities[b] + w[2] * velocities[c]
