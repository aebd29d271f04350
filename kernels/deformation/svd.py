"""Singular values of deformation gradients, and the rotations beside them.

Manifold-aware transformers, section 4.3.1 and Algorithm 1 ("replace singular values of Φ with Σ"). The network
predicts the singular values of a face's deformation gradient apart from the gradient itself, because they measure how
much cloth stretches; here they are put back:

    Φ = U diag(σ) Vᵀ,    R(Φ, s) = U diag(|s|) Vᵀ,    U and V proper rotations, σ₁ >= σ₂ >= |σ₃|

    | paper | code            | what                                                                   |
    | ----- | --------------- | ---------------------------------------------------------------------- |
    | Φ     | phi             | deformation gradient of a face, 3x3                                    |
    | Σ     | singular_values | its singular values, descending, never negative                        |
    | σ     | sigma           | Σ with the sign of det Φ on the smallest, since U and V are proper     |

The decomposition runs in float64 (Warp's float32 one is off by 2e-4 on garments), by one-sided Jacobi rotations
(Hestenes 1958): pairs of columns of A = Φ V are rotated until they are orthogonal; then σ are their lengths and U their
directions. The columns of stretched cloth are nearly orthogonal at the start, so two or three sweeps suffice; Warp's
`svd3` always makes a fixed number of sweeps.

For Φ = [e1, e2, n] Q_rest⁻¹ (gradients.py) no decomposition is needed. With r_k the rows of Q_rest⁻¹, r_2 is
orthogonal to the other rows and n to the edges: |n| |r_2| = 1 is one singular value (0 for a face without area), and
the other two are those of a map between planes, whose columns are m and k in an orthonormal basis with r_0 along its
first axis:

    (σ₁ ± σ₂)² = |m|² + |k|² ± 2 |m × k|,    (σ₁ − σ₂)² = (|m| − |k|)² + 2 (m·k)² / (|m||k| + |m × k|)
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import expect
from warpgarment.kernels.operator import row_operator

wp.set_module_options(compiling.options())


# Cosine between two columns, squared, below which they count as orthogonal
ORTHOGONAL = wp.constant(wp.float64(1.0e-26))
SWEEPS = wp.constant(16)  # a limit that is never reached
# Second singular value over the first below which its direction is rounding
FLAT = wp.constant(wp.float64(1.0e-14))
# Determinant over the cube of the length below which a matrix is no map of cloth or skin; its rotation is by `svd`
SQUASHED = wp.constant(wp.float64(1.0e-3))
ROUNDS = wp.constant(12)  # limit of Newton's iteration; a body's faces take three or four
TURNED = wp.constant(wp.float64(1.0e-16))  # squared change after which the next one is below rounding


@wp.func
def turn(x: wp.vec3d, y: wp.vec3d):
    """Cosine and sine of the rotation that makes two columns orthogonal; 1 and 0 if they already are."""
    one = wp.float64(1.0)
    xx = wp.dot(x, x)
    yy = wp.dot(y, y)
    xy = wp.dot(x, y)
    if not xy * xy > ORTHOGONAL * xx * yy:
        return one, wp.float64(0.0)
    zeta = (yy - xx) / (wp.float64(2.0) * xy)
    t = one / (wp.abs(zeta) + wp.sqrt(one + zeta * zeta))
    t = wp.where(zeta < wp.float64(0.0), -t, t)
    c = one / wp.sqrt(one + t * t)
    return c, c * t


@wp.func
def svd(m: wp.mat33d):
    """U, σ, V with U and V proper rotations, σ descending by magnitude, the sign of the determinant on the last."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    a = wp.vec3d(m[0, 0], m[1, 0], m[2, 0])
    b = wp.vec3d(m[0, 1], m[1, 1], m[2, 1])
    c = wp.vec3d(m[0, 2], m[1, 2], m[2, 2])
    va = wp.vec3d(one, zero, zero)
    vb = wp.vec3d(zero, one, zero)
    vc = wp.vec3d(zero, zero, one)
    sweep = wp.int32(0)
    while sweep < SWEEPS:
        sweep += 1
        cos_ab, sin_ab = turn(a, b)
        a, b = cos_ab * a - sin_ab * b, sin_ab * a + cos_ab * b
        va, vb = cos_ab * va - sin_ab * vb, sin_ab * va + cos_ab * vb
        cos_ac, sin_ac = turn(a, c)
        a, c = cos_ac * a - sin_ac * c, sin_ac * a + cos_ac * c
        va, vc = cos_ac * va - sin_ac * vc, sin_ac * va + cos_ac * vc
        cos_bc, sin_bc = turn(b, c)
        b, c = cos_bc * b - sin_bc * c, sin_bc * b + cos_bc * c
        vb, vc = cos_bc * vb - sin_bc * vc, sin_bc * vb + cos_bc * vc
        if sin_ab == zero and sin_ac == zero and sin_bc == zero:
            sweep = SWEEPS
    if wp.dot(b, b) > wp.dot(a, a):
        a, b = b, a
        va, vb = vb, va
    if wp.dot(c, c) > wp.dot(b, b):
        b, c = c, b
        vb, vc = vc, vb
    if wp.dot(b, b) > wp.dot(a, a):
        a, b = b, a
        va, vb = vb, va
    first = wp.length(a)
    second = wp.length(b)
    ua = wp.vec3d(one, zero, zero)
    if first != zero:
        ua = a / first
    if not second <= FLAT * first:
        ub = b / second
    else:  # any direction across
        size = wp.vec3d(wp.abs(ua[0]), wp.abs(ua[1]), wp.abs(ua[2]))
        across = wp.where(
            size[0] < wp.min(size[1], size[2]),
            wp.vec3d(one, zero, zero),
            wp.where(size[1] < size[2], wp.vec3d(zero, one, zero), wp.vec3d(zero, zero, one)),
        )
        ub = wp.normalize(wp.cross(ua, across))
    uc = wp.cross(ua, ub)
    last = wp.cross(va, vb)  # vc or its opposite
    third = wp.dot(uc, c) * wp.dot(last, vc)
    return wp.matrix_from_cols(ua, ub, uc), wp.vec3d(first, second, third), wp.matrix_from_cols(va, vb, last)


@wp.func
def rotation_of(m: wp.mat33d):
    """The nearest proper rotation, by Newton's iteration X <- (X + X⁻ᵀ)/2 (Higham 1986), in a fifth of the time.

    It converges quadratically from any matrix with a positive determinant,
    and fast from those that stretch little.
    """
    half = wp.float64(0.5)
    a = wp.vec3d(m[0, 0], m[1, 0], m[2, 0])
    b = wp.vec3d(m[0, 1], m[1, 1], m[2, 1])
    c = wp.vec3d(m[0, 2], m[1, 2], m[2, 2])
    size = wp.dot(a, a) + wp.dot(b, b) + wp.dot(c, c)
    volume = wp.dot(a, wp.cross(b, c))
    change = wp.float64(1.0)
    if volume > SQUASHED * size * wp.sqrt(size):
        rounds = wp.int32(0)
        while change > TURNED and rounds < ROUNDS:
            scale = half / wp.dot(a, wp.cross(b, c))
            x = half * a + scale * wp.cross(b, c)
            y = half * b + scale * wp.cross(c, a)
            z = half * c + scale * wp.cross(a, b)
            change = wp.length_sq(x - a) + wp.length_sq(y - b) + wp.length_sq(z - c)
            a = x
            b = y
            c = z
            rounds += 1
    turn = wp.matrix_from_cols(a, b, c)
    if not change <= TURNED:
        u, _sigma, v = svd(m)
        turn = u * wp.transpose(v)
    return turn


@wp.func
def frame_singular_values(q: wp.mat33, inverse_rest: wp.mat33):
    """Singular values, descending, of Φ = Q Q_rest⁻¹ with Q = [e1, e2, n]; the formulas are those of the module."""
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    f = wp.mat33d(q)
    g = wp.mat33d(inverse_rest)
    r0 = g[0]
    r1 = g[1]
    along = wp.length(r0)
    t = wp.normalize(r0)
    shear = wp.dot(r1, t)
    m = wp.vec3d(f[0, 0], f[1, 0], f[2, 0]) * along + wp.vec3d(f[0, 1], f[1, 1], f[2, 1]) * shear
    k = wp.vec3d(f[0, 1], f[1, 1], f[2, 1]) * wp.length(r1 - shear * t)
    lm = wp.length(m)
    lk = wp.length(k)
    area = wp.length(wp.cross(m, k))
    apart = (lm - lk) * (lm - lk)
    below = lm * lk + area
    if below > zero:
        apart += wp.float64(2.0) * wp.dot(m, k) * wp.dot(m, k) / below
    together = wp.sqrt(lm * lm + lk * lk + wp.float64(2.0) * area)
    high = half * (together + wp.sqrt(apart))
    low = zero
    if high > zero:
        low = area / high
    normal = wp.length(wp.vec3d(f[0, 2], f[1, 2], f[2, 2])) * wp.length(g[2])
    return wp.vec3(wp.vec3d(wp.max(high, normal), wp.max(low, wp.min(high, normal)), wp.min(low, normal)))


@wp.func_grad(frame_singular_values)
def adj_frame_singular_values(q: wp.mat33, inverse_rest: wp.mat33, adj_ret: wp.vec3):
    """The adjoint of the singular values of the product of both matrices."""
    u, sigma, v = svd(wp.mat33d(q * inverse_rest))
    g = wp.vec3d(adj_ret)
    if sigma[2] < wp.float64(0.0):
        g = wp.vec3d(g[0], g[1], -g[2])
    adj_phi = wp.mat33(u * wp.diag(g) * wp.transpose(v))
    wp.adjoint[q] += adj_phi * wp.transpose(inverse_rest)
    wp.adjoint[inverse_rest] += wp.transpose(q) * adj_phi


@wp.kernel(enable_backward=False)
def singular_values_kernel(
    # In:
    phi: wp.array[wp.mat33],
    # Out:
    values: wp.array[wp.vec3],
):
    i = wp.tid()
    _u, sigma, _v = svd(wp.mat33d(phi[i]))
    values[i] = wp.vec3(wp.vec3d(sigma[0], sigma[1], wp.abs(sigma[2])))


@wp.kernel(enable_backward=False)
def singular_values_gradient_kernel(
    # In:
    phi: wp.array[wp.mat33],
    grad_values: wp.array[wp.vec3],
    # Out:
    grad_phi: wp.array[wp.mat33],
):
    """dσ_i = u_iᵀ dΦ v_i contains no quotient, so repeated singular values do no harm."""
    i = wp.tid()
    u, sigma, v = svd(wp.mat33d(phi[i]))
    g = wp.vec3d(grad_values[i])
    if sigma[2] < wp.float64(0.0):
        g = wp.vec3d(g[0], g[1], -g[2])
    grad_phi[i] = wp.mat33(u * wp.diag(g) * wp.transpose(v))


_singular_values = row_operator(
    "singular_values",
    singular_values_kernel,
    {"phi": wp.mat33},
    {"values": (wp.vec3, (3,))},
    rows="phi",
    gradients=["phi"],
    backward=singular_values_gradient_kernel,
)


def singular_values(phi: torch.Tensor) -> torch.Tensor:
    """Singular values of 3x3 matrices.

    Args:
        phi: Deformation gradients, float32 [F, 3, 3].

    Returns:
        Singular values, float32 [F, 3], descending, never negative. Differentiable in phi; ∂σ_i/∂Φ = u_i v_iᵀ.
    """
    expect("phi", phi, (None, 3, 3))
    return _singular_values(phi)
