"""Membrane energy: St. Venant-Kirchhoff with an orthotropic stiffness, per face, with its gradient.

    F = [x_1 - x_0, x_2 - x_0] D⁻¹,    E = ½ (FᵀF - I),    e = (E_11, E_22, 2 E_12)
    W = ½ A eᵀ C e + ½ (τ / h) A (e - e⁻)ᵀ C (e - e⁻)
    ∂W/∂[x_1 x_2] = A F S D⁻ᵀ,    S = [[s_1, s_3], [s_3, s_2]],    s = C e + (τ / h) C (e - e⁻),    ∂W/∂x_0 = -Σ

For an isotropic sheet with Lamé parameters λ and μ, C = [[λ + 2 μ, λ, 0], [λ, λ + 2 μ, 0], [0, 0, μ]]. The second
term is viscosity within one implicit step: its force is that of the strain rate (e - e⁻) / h.

| symbol | code | what |
| --- | --- | --- |
| x | `vertices` | positions [m] |
| D | `inverse_rest` holds D⁻¹ | edges of the rest triangle in the axes of its material, 2x2 [m] |
| A C | `stiffness` | rest area times stiffness, 3x3 [N m] |
| e⁻ | `strain_before` | strain at the start of the step |
| τ / h | `damping` | damping over the length of the step, without unit |
"""

from __future__ import annotations

import warp as wp

from warpgarment.kernels import compiling

wp.set_module_options(compiling.options())


@wp.func
def deformation(x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, inverse_rest: wp.mat22d):
    """The two columns of F."""
    a = x1 - x0
    b = x2 - x0
    return inverse_rest[0, 0] * a + inverse_rest[1, 0] * b, inverse_rest[0, 1] * a + inverse_rest[1, 1] * b


@wp.func
def green_strain(f1: wp.vec3d, f2: wp.vec3d) -> wp.vec3d:
    """(E_11, E_22, 2 E_12) of the columns of F."""
    half = wp.float64(0.5)
    one = wp.float64(1.0)
    return wp.vec3d(half * (wp.dot(f1, f1) - one), half * (wp.dot(f2, f2) - one), wp.dot(f1, f2))


@wp.kernel(enable_backward=False)
def membrane_kernel(
    # Model:
    faces: wp.array[wp.vec3i],
    inverse_rest: wp.array[wp.mat22d],
    stiffness: wp.array[wp.mat33d],
    damping: wp.array[wp.float64],
    # In:
    vertices: wp.array[wp.vec3d],
    strain_before: wp.array[wp.vec3d],
    # Out:
    energy: wp.array[wp.float64],
    gradient: wp.array[wp.vec3d],  # of the corners, [3 F]
):
    i = wp.tid()
    face = faces[i]
    inverse = inverse_rest[i]
    f1, f2 = deformation(vertices[face[0]], vertices[face[1]], vertices[face[2]], inverse)
    e = green_strain(f1, f2)
    rate = damping[i] * (e - strain_before[i])
    c = stiffness[i]
    elastic = c * e
    viscous = c * rate
    energy[i] = wp.float64(0.5) * (wp.dot(e, elastic) + wp.dot(e - strain_before[i], viscous))
    s = elastic + viscous
    p1 = s[0] * f1 + s[2] * f2
    p2 = s[2] * f1 + s[1] * f2
    g1 = inverse[0, 0] * p1 + inverse[0, 1] * p2
    g2 = inverse[1, 0] * p1 + inverse[1, 1] * p2
    gradient[3 * i] = -(g1 + g2)
    gradient[3 * i + 1] = g1
    gradient[3 * i + 2] = g2


@wp.kernel(enable_backward=False)
def strain_kernel(
    # Model:
    faces: wp.array[wp.vec3i],
    inverse_rest: wp.array[wp.mat22d],
    # In:
    vertices: wp.array[wp.vec3d],
    # Out:
    strain: wp.array[wp.vec3d],
):
    """e of the positions."""
    i = wp.tid()
    face = faces[i]
    f1, f2 = deformation(vertices[face[0]], vertices[face[1]], vertices[face[2]], inverse_rest[i])
    strain[i] = green_strain(f1, f2)
