"""Contact of cloth with cloth as an energy: a spring for every pair of faces that is closer than a distance.

    W = ½ k max(0, h - n·r)² + μ p f(|t|),    r = Σ_i u_i a_i - Σ_j v_j b_j,    t = (I - n nᵀ) (r - r⁻)

The pairs, the directions n and the weights of the nearest points at the start of the step are those of
`warpgarment.kernels.cloth`. A pair that crosses at the start has no direction, and no energy. The second term is
friction (friction.py), with the pressure p = k max(0, h - n·r⁻) at the start of the step.

| symbol | code | what |
| --- | --- | --- |
| a, b | `points` at the corners of a face and of its partner | positions [m] |
| u, v | `weights_p`, `weights_q` | barycentric coordinates of the nearest points; zero for a pair that is clear |
| n | `normal` | unit vector from the partner to the face |
| h | `thickness` | distance to keep [m] |
| k | `stiffness` | stiffness [N/m] |
| r⁻ | of `before` | r at the start of the step [m] |
| μ | mean of `friction` of both faces | Coulomb coefficient |
| ε | `slip` | way [m] below which friction is not yet full |
"""

from __future__ import annotations

import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.cloth.contacts import Pairs, kept_pairs

from .friction import friction_energy, friction_gradient

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def pair_kernel(
    # Model:
    pairs: Pairs,
    thickness: wp.float64,
    stiffness: wp.float64,
    friction: wp.array[wp.float64],
    slip: wp.float64,
    # In:
    before: wp.array[wp.vec3d],
    normal: wp.array2d[wp.vec3],
    weights_p: wp.array2d[wp.vec3],
    weights_q: wp.array2d[wp.vec3],
    points: wp.array[wp.vec3d],
    # Out:
    energy: wp.array[wp.float64],  # of faces, added
    gradient: wp.array[wp.vec3d],  # of vertices, accumulated
):
    m = wp.tid()
    face = pairs.faces[m]
    total = wp.float64(0.0)
    for k in range(kept_pairs(pairs, m)):
        u = weights_p[m, k]
        if wp.dot(u, u) > 0.0:
            other = pairs.faces[pairs.partners[m, k]]
            v = weights_q[m, k]
            n = wp.vec3d(normal[m, k])
            way = wp.vec3d()
            first = wp.vec3d()
            for i in range(3):
                way += wp.float64(u[i]) * points[face[i]] - wp.float64(v[i]) * points[other[i]]
                first += wp.float64(u[i]) * before[face[i]] - wp.float64(v[i]) * before[other[i]]
            missing = wp.max(thickness - wp.dot(n, way), wp.float64(0.0))
            force = wp.max(thickness - wp.dot(n, first), wp.float64(0.0)) * stiffness
            force *= wp.float64(0.5) * (friction[m] + friction[pairs.partners[m, k]])
            if missing > wp.float64(0.0) or force > wp.float64(0.0):
                slid = way - first
                slid -= wp.dot(n, slid) * n
                total += wp.float64(0.5) * stiffness * missing * missing + friction_energy(slid, force, slip)
                pull = friction_gradient(slid, force, slip) - (stiffness * missing) * n
                for i in range(3):
                    wp.atomic_add(gradient, face[i], wp.float64(u[i]) * pull)
                    wp.atomic_add(gradient, other[i], -wp.float64(v[i]) * pull)
    energy[m] = energy[m] + total
