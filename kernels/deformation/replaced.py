"""Singular values of deformation gradients replaced, or removed.

    R(Φ, s) = U diag(|s|) Vᵀ,    Φ = U diag(σ) Vᵀ as in svd.py

With P = Uᵀ dΦ V and T = Uᵀ dR V, the rotations of U and V follow from the off-diagonal of P, and for i < j

    T_ij + T_ji = (s_i − s_j)/(σ_i − σ_j) (P_ij + P_ji)
    T_ij − T_ji = (s_i + s_j)/(σ_i + σ_j) (P_ij − P_ji)
    T_ii = ds_i

R jumps where σ_i = σ_j but s_i != s_j, so the first quotient has no limit there (an undeformed face is such a case).
Both quotients are limited to `MAX_GAIN`: gradients are exact wherever R amplifies less than that, and always bounded.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, expect, launch_rows, torch_stream
from warpgarment.kernels.operator import allocate
from warpgarment.kernels.registered import operator

from .svd import rotation_of, svd

wp.set_module_options(compiling.options())

MAX_GAIN = wp.constant(wp.float64(100.0))
"""Largest factor by which the gradient of replace_singular_values may amplify one mode of its argument."""


@wp.func
def with_singular_values(phi: wp.mat33, values: wp.vec3):
    """U diag(|values|) Vᵀ with proper rotations U and V of phi."""
    u, _sigma, v = svd(wp.mat33d(phi))
    s = wp.vec3d(values)
    return wp.mat33(u * wp.diag(wp.vec3d(wp.abs(s[0]), wp.abs(s[1]), wp.abs(s[2]))) * wp.transpose(v))


@wp.func
def bounded_quotient(numerator: wp.float64, denominator: wp.float64):
    """numerator / denominator for denominator >= 0, limited to ±MAX_GAIN; 0 / 0 is 0."""
    if numerator == wp.float64(0.0):
        return wp.float64(0.0)
    if wp.abs(numerator) >= MAX_GAIN * denominator:
        return MAX_GAIN * wp.sign(numerator)
    return numerator / denominator


@wp.func
def pulled_back(phi: wp.mat33, values: wp.vec3, adj_ret: wp.mat33):
    """Gradients of `with_singular_values` with respect to phi and the values.

    The map from P to T in the module's docstring is its own transpose, so the adjoint uses it unchanged.
    """
    u, sigma, v = svd(wp.mat33d(phi))
    g = wp.transpose(u) * wp.mat33d(adj_ret) * v
    s = wp.vec3d(values)
    m = wp.mat33d()
    for i in range(3):
        for j in range(i + 1, 3):
            together = bounded_quotient(wp.abs(s[i]) - wp.abs(s[j]), sigma[i] - sigma[j]) * (g[i, j] + g[j, i])
            against = bounded_quotient(wp.abs(s[i]) + wp.abs(s[j]), sigma[i] + sigma[j]) * (g[i, j] - g[j, i])
            m[i, j] = wp.float64(0.5) * (together + against)
            m[j, i] = wp.float64(0.5) * (together - against)
    of_values = wp.vec3d(wp.sign(s[0]) * g[0, 0], wp.sign(s[1]) * g[1, 1], wp.sign(s[2]) * g[2, 2])
    return wp.mat33(u * m * wp.transpose(v)), wp.vec3(of_values)


@wp.kernel(enable_backward=False)
def replace_singular_values_kernel(
    from_row: wp.int32,
    # In:
    phi: wp.array[wp.mat33],
    values: wp.array[wp.vec3],
    # Out:
    replaced: wp.array[wp.mat33],
):
    i = from_row + wp.tid()
    replaced[i] = with_singular_values(phi[i], values[i])


@wp.kernel(enable_backward=False)
def replace_adjoint_kernel(
    from_row: wp.int32,
    # In:
    phi: wp.array[wp.mat33],
    values: wp.array[wp.vec3],
    adj_replaced: wp.array[wp.mat33],
    # Out:
    adj_phi: wp.array[wp.mat33],
    adj_values: wp.array[wp.vec3],
):
    """The adjoint with one decomposition; Warp's own would make the result anew first."""
    i = from_row + wp.tid()
    of_phi, of_values = pulled_back(phi[i], values[i], adj_replaced[i])
    adj_phi[i] = of_phi
    adj_values[i] = of_values


@wp.kernel(enable_backward=False)
def rotation_kernel(
    from_row: wp.int32,
    # In:
    phi: wp.array[wp.mat33],
    # Out:
    turn: wp.array[wp.mat33],
):
    i = from_row + wp.tid()
    turn[i] = wp.mat33(rotation_of(wp.mat33d(phi[i])))


@operator("warpgarment::replace_singular_values")
def _replace_singular_values(phi: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    replaced = allocate(phi.shape, torch.float32, phi.device)
    with torch_stream(phi.device) as device:
        given = [as_argument(phi, wp.mat33), as_argument(values, wp.vec3)]
        launch_rows(replace_singular_values_kernel, len(phi), given, [as_argument(replaced, wp.mat33)], device)
    return replaced


@_replace_singular_values.register_fake
def _(phi: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    return phi.new_empty(phi.shape)


@operator("warpgarment::replace_singular_values_backward")
def _replace_adjoint(
    phi: torch.Tensor, values: torch.Tensor, gradient: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    gradient = gradient.contiguous()
    of_phi = allocate(phi.shape, torch.float32, phi.device)
    of_values = allocate(values.shape, torch.float32, phi.device)
    with torch_stream(phi.device) as device:
        given = [as_argument(phi, wp.mat33), as_argument(values, wp.vec3), as_argument(gradient, wp.mat33)]
        found = [as_argument(of_phi, wp.mat33), as_argument(of_values, wp.vec3)]
        launch_rows(replace_adjoint_kernel, len(phi), given, found, device)
    return of_phi, of_values


@_replace_adjoint.register_fake
def _(phi: torch.Tensor, values: torch.Tensor, gradient: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return phi.new_empty(phi.shape), values.new_empty(values.shape)


def _save(ctx: Any, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
    found = _replace_adjoint(*ctx.saved_tensors, gradient)
    return tuple(part if wanted else None for part, wanted in zip(found, ctx.needs_input_grad, strict=True))


_replace_singular_values.register_autograd(_backward, setup_context=_save)


def replace_singular_values(phi: torch.Tensor, s: torch.Tensor) -> torch.Tensor:
    """Replaces the singular values of 3x3 matrices: U diag(|s|) Vᵀ for phi = U diag(σ) Vᵀ.

    U and V are proper rotations, so the result has a positive determinant even where phi is inverted. A negative
    value counts as its magnitude, since singular values have no sign.

    Args:
        phi: Deformation gradients, float32 [F, 3, 3].
        s: New singular values, float32 [F, 3]; s[:, 0] replaces the largest one, and so on.

    Returns:
        float32 [F, 3, 3]. Differentiable in both arguments; where singular values of phi coincide, the gradient is
        bounded (see `MAX_GAIN`).
    """
    expect("phi", phi, (None, 3, 3))
    expect("s", s, (phi.shape[0], 3), device=phi.device)
    replaced: torch.Tensor = _replace_singular_values(phi, s)
    return replaced


def rotation(phi: torch.Tensor) -> torch.Tensor:
    """The proper rotations nearest to 3x3 matrices: U Vᵀ, the polar factor.

    Args:
        phi: Matrices, for example deformation gradients, float32 [F, 3, 3].

    Returns:
        Rotations with determinant +1, float32 [F, 3, 3]. Differentiable in phi.
    """
    expect("phi", phi, (None, 3, 3))
    if phi.requires_grad and torch.is_grad_enabled():
        return replace_singular_values(phi, phi.new_ones(phi.shape[:2]))
    phi = phi.detach()
    turn = allocate(phi.shape, torch.float32, phi.device)
    with torch_stream(phi.device) as device:
        launch_rows(
            rotation_kernel, len(phi), [as_argument(phi, wp.mat33)], [as_argument(turn, wp.mat33)], device, least=1024
        )
    return turn
