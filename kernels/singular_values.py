"""Singular values of deformation gradients: reading them, replacing them, removing them.

Manifold-aware transformers, section 4.3.1 and Algorithm 1 ("replace singular values of Φ with Σ"). The network
predicts the singular values of a face's deformation gradient apart from the gradient itself, because they say how
much cloth stretches; here they are put back:

    Φ = U diag(σ) Vᵀ,    R(Φ, s) = U diag(|s|) Vᵀ,    U and V proper rotations, σ₁ >= σ₂ >= |σ₃|

    | paper | code            | what                                                                   |
    | ----- | --------------- | ---------------------------------------------------------------------- |
    | Φ     | phi             | deformation gradient of a face, 3x3                                    |
    | Σ     | singular_values | its singular values, descending, never negative                        |
    | σ     | sigma           | the same with the sign of det Φ on the smallest, as proper U, V demand |

Gradients. With P = Uᵀ dΦ V and T = Uᵀ dR V, the rotations of U and V follow from the off-diagonal of P, and for i < j

    T_ij + T_ji = (s_i − s_j)/(σ_i − σ_j) (P_ij + P_ji)
    T_ij − T_ji = (s_i + s_j)/(σ_i + σ_j) (P_ij − P_ji)
    T_ii = ds_i

R jumps where σ_i = σ_j but s_i != s_j, so the first quotient has no limit there (an undeformed face is such a place).
Both are held below `MAX_GAIN`: gradients are exact wherever R amplifies less than that, and bounded everywhere.

The decomposition runs in float64: Warp's float32 version is off by 2e-4 on garments, the float64 one by 1e-14.
"""

from __future__ import annotations

import torch
import warp as wp

from ._operator import row_operator
from ._torch import expect

MAX_GAIN = wp.constant(wp.float64(100.0))
"""Largest factor by which the gradient of replace_singular_values may amplify one mode of its argument."""


@wp.func
def singular_values_of(phi: wp.mat33):
    """Singular values, descending and not negative."""
    _u, sigma, _v = wp.svd3(wp.mat33d(phi))  # sorted by magnitude; the last carries the sign of the determinant
    return wp.vec3(wp.vec3d(sigma[0], sigma[1], wp.abs(sigma[2])))


@wp.func_grad(singular_values_of)
def adj_singular_values_of(phi: wp.mat33, adj_ret: wp.vec3):
    """dσ_i = u_iᵀ dΦ v_i: no quotient, so repeated values do no harm."""
    u, sigma, v = wp.svd3(wp.mat33d(phi))
    g = wp.vec3d(adj_ret)
    if sigma[2] < wp.float64(0.0):
        g = wp.vec3d(g[0], g[1], -g[2])
    wp.adjoint[phi] += wp.mat33(u * wp.diag(g) * wp.transpose(v))


@wp.func
def with_singular_values(phi: wp.mat33, values: wp.vec3):
    """U diag(|values|) Vᵀ with proper rotations U and V of phi."""
    u, _sigma, v = wp.svd3(wp.mat33d(phi))
    s = wp.vec3d(values)
    return wp.mat33(u * wp.diag(wp.vec3d(wp.abs(s[0]), wp.abs(s[1]), wp.abs(s[2]))) * wp.transpose(v))


@wp.func
def bounded_quotient(numerator: wp.float64, denominator: wp.float64):
    """numerator / denominator for denominator >= 0, cut off at ±MAX_GAIN; 0 / 0 is 0."""
    if numerator == wp.float64(0.0):
        return wp.float64(0.0)
    if wp.abs(numerator) >= MAX_GAIN * denominator:
        return MAX_GAIN * wp.sign(numerator)
    return numerator / denominator


@wp.func_grad(with_singular_values)
def adj_with_singular_values(phi: wp.mat33, values: wp.vec3, adj_ret: wp.mat33):
    """The map from P to T above is its own transpose, so it serves the adjoint as it stands."""
    u, sigma, v = wp.svd3(wp.mat33d(phi))
    g = wp.transpose(u) * wp.mat33d(adj_ret) * v
    s = wp.vec3d(values)
    m = wp.mat33d()
    for i in range(3):
        for j in range(i + 1, 3):
            together = bounded_quotient(wp.abs(s[i]) - wp.abs(s[j]), sigma[i] - sigma[j]) * (g[i, j] + g[j, i])
            against = bounded_quotient(wp.abs(s[i]) + wp.abs(s[j]), sigma[i] + sigma[j]) * (g[i, j] - g[j, i])
            m[i, j] = wp.float64(0.5) * (together + against)
            m[j, i] = wp.float64(0.5) * (together - against)
    wp.adjoint[phi] += wp.mat33(u * m * wp.transpose(v))
    wp.adjoint[values] += wp.vec3(wp.vec3d(wp.sign(s[0]) * g[0, 0], wp.sign(s[1]) * g[1, 1], wp.sign(s[2]) * g[2, 2]))


@wp.kernel
def singular_values_kernel(
    # In:
    phi: wp.array[wp.mat33],
    # Out:
    values: wp.array[wp.vec3],
):
    i = wp.tid()
    values[i] = singular_values_of(phi[i])


@wp.kernel
def replace_singular_values_kernel(
    # In:
    phi: wp.array[wp.mat33],
    values: wp.array[wp.vec3],
    # Out:
    replaced: wp.array[wp.mat33],
):
    i = wp.tid()
    replaced[i] = with_singular_values(phi[i], values[i])


_singular_values = row_operator(
    "singular_values",
    singular_values_kernel,
    {"phi": wp.mat33},
    {"values": (wp.vec3, (3,))},
    rows="phi",
    gradients=["phi"],
)
_replace_singular_values = row_operator(
    "replace_singular_values",
    replace_singular_values_kernel,
    {"phi": wp.mat33, "values": wp.vec3},
    {"replaced": (wp.mat33, (3, 3))},
    rows="phi",
    gradients=["phi", "values"],
)


def singular_values(phi: torch.Tensor) -> torch.Tensor:
    """Singular values of 3x3 matrices.

    Args:
        phi: Deformation gradients, float32 [F, 3, 3].

    Returns:
        Singular values, float32 [F, 3], descending, never negative. Differentiable in phi, with u_i v_iᵀ.
    """
    expect("phi", phi, (None, 3, 3))
    return _singular_values(phi)


def replace_singular_values(phi: torch.Tensor, s: torch.Tensor) -> torch.Tensor:
    """The matrices with other singular values: U diag(|s|) Vᵀ of phi = U diag(σ) Vᵀ.

    U and V are proper rotations, so the result has a positive determinant even where phi is inverted. A negative
    value means its magnitude, as a singular value has no sign.

    Args:
        phi: Deformation gradients, float32 [F, 3, 3].
        s: New singular values, float32 [F, 3]; s[:, 0] takes the place of the largest, and so on.

    Returns:
        float32 [F, 3, 3]. Differentiable in both; where singular values of phi meet, the gradient is bounded (see
        `MAX_GAIN`).
    """
    expect("phi", phi, (None, 3, 3))
    expect("s", s, (phi.shape[0], 3), device=phi.device)
    return _replace_singular_values(phi, s)


def rotation(phi: torch.Tensor) -> torch.Tensor:
    """The proper rotations nearest to 3x3 matrices: U Vᵀ, the polar factor.

    Args:
        phi: float32 [F, 3, 3].

    Returns:
        float32 [F, 3, 3], determinant +1. Differentiable.
    """
    expect("phi", phi, (None, 3, 3))
    return _replace_singular_values(phi, phi.new_ones(phi.shape[:2]))
