"""Energy and gradient at the vertices: inertia, contact with planes, friction, and what faces and hinges gather.

    W = ½ c m |x - y|² + ½ k a max(0, d - n·(x - u))² + μ p f(|t|),    t = (I - n nᵀ) (x - x⁻ - Δu)

The first term makes the minimum the end of an implicit step, for a scheme with y and c. The second one keeps the
distance d from the plane through u across n. The third is friction (friction.py) with the pressure p of the step
before.

| symbol | code | what |
| --- | --- | --- |
| y, c | `target`, `inertia` | where the vertex would be without forces [m]; one over the square of a time [1/s²] |
| m | `mass` | mass of the vertex [kg] |
| n, n·u | `normal`, `offset` | unit normal of the plane, zero for none; its place along the normal [m] |
| d | `distance` | distance to keep [m] |
| k a | `contact` | stiffness of contact [N/m] |
| x⁻, Δu | `anchor` is x⁻ + Δu | position at the start of the step, and the way the obstacle goes under it [m] |
| μ p | `friction` | largest friction force [N] |
| ε | `slip` | way [m] below which friction is not yet full |
"""

from __future__ import annotations

import warp as wp

from warpgarment.kernels import compiling

from .friction import friction_energy, friction_gradient

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def vertex_kernel(
    # Model:
    mass: wp.array[wp.float64],
    corner_start: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    contact: wp.array[wp.float64],
    held: wp.array[wp.int32],
    inertia: wp.float64,
    slip: wp.float64,
    # In:
    vertices: wp.array[wp.vec3d],
    target: wp.array[wp.vec3d],
    normal: wp.array[wp.vec3d],
    offset: wp.array[wp.float64],
    distance: wp.array[wp.float64],
    anchor: wp.array[wp.vec3d],
    friction: wp.array[wp.float64],
    corner_gradient: wp.array[wp.vec3d],
    more: wp.array[wp.vec3d],  # added, and cleared for the next evaluation
    # Out:
    energy: wp.array[wp.float64],
    gradient: wp.array[wp.vec3d],  # zero where a vertex is held
):
    i = wp.tid()
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    x = vertices[i]
    away = x - target[i]
    g = (inertia * mass[i]) * away
    w = half * inertia * mass[i] * wp.dot(away, away)
    n = normal[i]
    if wp.dot(n, n) > zero:
        gap = distance[i] - (wp.dot(n, x) - offset[i])
        if gap > zero:
            w += half * contact[i] * gap * gap
            g -= (contact[i] * gap) * n
        if friction[i] > zero:
            slid = x - anchor[i]
            slid -= wp.dot(n, slid) * n
            w += friction_energy(slid, friction[i], slip)
            g += friction_gradient(slid, friction[i], slip)
    g += more[i]
    more[i] = wp.vec3d()
    for e in range(corner_start[i], corner_start[i + 1]):
        g += corner_gradient[corners[e]]
    if held[i] > 0:
        g = wp.vec3d()
        w = zero
    energy[i] = w
    gradient[i] = g
