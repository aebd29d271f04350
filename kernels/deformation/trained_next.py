"""The deformation gradients of the next frame with their gradients, for training on a CPU: beside next_frame.py.

    target = R(Ψ Φ, max(Σ, smallest))        R replaces singular values (replaced.py), or keeps them

A garment with a number that is not finite keeps Φ with singular values of 1, and its Ψ and Σ get no gradient. The
adjoint decomposes eight faces at a time, with the formulas of replaced.py.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, rows_in_memory, torch_stream
from warpgarment.kernels.operator import allocate

from .next_frame import next_gradients
from .replaced_eight import LANES, LANES_OF_EIGHT

wp.set_module_options(compiling.options())

ADJOINT = (
    LANES_OF_EIGHT
    + """
    struct Gain {
        static inline v8 quotient(v8 numerator, v8 denominator) {  // `bounded_quotient` of replaced.py
            const v8 most = v8{} + 100.0, bound = numerator > 0.0 ? most : -most;
            const v8 found = __builtin_elementwise_abs(numerator) >= 100.0 * denominator ? bound
                                                                                         : numerator / denominator;
            return numerator == 0.0 ? v8{} : found;
        }
    };
    const int from = 8 * t, many = count - from < 8 ? count - from : 8;
    v8 f[9] = {}, g[9] = {}, a[9] = {}, s[3], free[3] = {}, kept = {};
    for (int k = 0; k < 9; k += 4) f[k] = g[k] = v8{} + 1.0;
    for (int k = 0; k < 3; k++) s[k] = v8{} + 1.0;
    for (int r = 0; r < many; r++) {
        for (int k = 0; k < 9; k++) {
            f[k][r] = (double)features.data[(long)(from + r) * pitch + k];
            a[k][r] = (double)gradient.data[9l * (from + r) + k];
        }
        if (broken.data[garment_of_face.data[from + r]]) continue;
        kept[r] = 1.0;
        for (int k = 0; k < 9; k++) g[k][r] = (double)psi.data[9l * (from + r) + k];
        for (int k = 0; k < 3; k++) {
            const float wanted = singular_values.data[3l * (from + r) + k];
            s[k][r] = (double)(wanted > smallest ? wanted : smallest);
            free[k][r] = wanted >= smallest ? 1.0 : 0.0;
        }
    }
    v8 m[9];  // the gradient of the product
    if (replace) {
        v8 u[3][3], v[3][3], old[3], p[3][3], w[3][3];  // columns
        for (int k = 0; k < 3; k++)
            for (int i = 0; i < 3; i++) u[k][i] = g[3 * i] * f[k] + g[3 * i + 1] * f[3 + k] + g[3 * i + 2] * f[6 + k];
        Lanes::svd(u, v, old);
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) w[i][j] = a[3 * i] * v[j][0] + a[3 * i + 1] * v[j][1] + a[3 * i + 2] * v[j][2];
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) p[i][j] = u[i][0] * w[0][j] + u[i][1] * w[1][j] + u[i][2] * w[2][j];
        v8 q[3][3] = {};
        for (int i = 0; i < 3; i++)
            for (int j = i + 1; j < 3; j++) {
                const v8 together = Gain::quotient(s[i] - s[j], old[i] - old[j]) * (p[i][j] + p[j][i]);
                const v8 against = Gain::quotient(s[i] + s[j], old[i] + old[j]) * (p[i][j] - p[j][i]);
                q[i][j] = 0.5 * (together + against);
                q[j][i] = 0.5 * (together - against);
            }
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) w[i][j] = q[i][0] * v[0][j] + q[i][1] * v[1][j] + q[i][2] * v[2][j];
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) m[3 * i + j] = u[0][i] * w[0][j] + u[1][i] * w[1][j] + u[2][i] * w[2][j];
        for (int k = 0; k < 3; k++)
            for (int r = 0; r < many; r++) of_values.data[3l * (from + r) + k] = (float)(free[k][r] * p[k][k][r]);
    } else {
        for (int k = 0; k < 9; k++) m[k] = a[k];
        for (int k = 0; k < 3 * many; k++) of_values.data[3l * from + k] = 0.0f;
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            v8 x = {}, y = {};
            for (int k = 0; k < 3; k++) {
                x += m[3 * i + k] * f[3 * j + k];
                y += g[3 * k + i] * m[3 * k + j];
            }
            x = kept != 0.0 ? x : v8{};
            for (int r = 0; r < many; r++) {
                of_psi.data[9l * (from + r) + 3 * i + j] = (float)x[r];
                of_phi.data[9l * (from + r) + 3 * i + j] = (float)y[r];
            }
        }
#endif
"""
)


@wp.func_native(ADJOINT)
def adjoint_of_eight(
    t: int,
    count: int,
    pitch: int,
    smallest: float,
    replace: int,
    garment_of_face: wp.array[wp.int32],
    features: wp.array[wp.float32],
    psi: wp.array[wp.float32],
    singular_values: wp.array[wp.float32],
    broken: wp.array[wp.int32],
    gradient: wp.array[wp.float32],
    of_phi: wp.array[wp.float32],
    of_psi: wp.array[wp.float32],
    of_values: wp.array[wp.float32],
): ...


@wp.kernel(enable_backward=False)
def next_adjoint_kernel(
    from_row: wp.int32,
    count: wp.int32,
    pitch: wp.int32,
    smallest: wp.float32,
    replace: wp.int32,
    # Model:
    garment_of_face: wp.array[wp.int32],
    # In:
    features: wp.array[wp.float32],
    psi: wp.array[wp.float32],
    singular_values: wp.array[wp.float32],
    broken: wp.array[wp.int32],
    gradient: wp.array[wp.float32],
    # Out:
    of_phi: wp.array[wp.float32],
    of_psi: wp.array[wp.float32],
    of_values: wp.array[wp.float32],
):
    adjoint_of_eight(
        from_row + wp.tid(),
        count,
        pitch,
        smallest,
        replace,
        garment_of_face,
        features,
        psi,
        singular_values,
        broken,
        gradient,
        of_phi,
        of_psi,
        of_values,
    )


def trained_next_gradients(
    features: torch.Tensor,
    psi: torch.Tensor,
    singular_values: torch.Tensor,
    velocity: torch.Tensor,
    component_of_face: torch.Tensor,
    garment_of_face: torch.Tensor,
    garments: int,
    *,
    replace: bool,
    smallest: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same as `next_gradients` on a CPU, differentiable in features, psi and singular values."""
    owners = component_of_face, garment_of_face, garments
    found: tuple[torch.Tensor, torch.Tensor] = _Next.apply(
        features, psi, singular_values, velocity.detach(), owners, replace, smallest
    )
    return found


class _Next(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        features: torch.Tensor,
        psi: torch.Tensor,
        values: torch.Tensor,
        velocity: torch.Tensor,
        owners: tuple[torch.Tensor, torch.Tensor, int],
        replace: bool,
        smallest: float,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        target, finite = next_gradients(features, psi, values, velocity, *owners, replace=replace, smallest=smallest)
        ctx.save_for_backward(features, psi, values, finite)
        ctx.garment, ctx.replace, ctx.smallest = owners[1], replace, smallest
        ctx.mark_non_differentiable(finite)
        return target, finite

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor, _finite: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        features, psi, values, finite = ctx.saved_tensors
        rows, device = len(psi), psi.device
        of_phi, of_psi = (allocate(shape, torch.float32, device) for shape in ((rows, 9), psi.shape))
        of_values = allocate(values.shape, torch.float32, device)
        flat, pitch = rows_in_memory(features)
        broken = (~finite).int()
        given = [part.contiguous().view(-1) for part in (psi, values)]
        read = [flat, *given, broken, gradient.contiguous().view(-1)]
        written = [as_argument(part.view(-1), wp.float32) for part in (of_phi, of_psi, of_values)]
        with torch_stream(device) as on:
            inputs = [rows, pitch, ctx.smallest, int(ctx.replace), as_argument(ctx.garment, wp.int32)]
            inputs += [as_argument(part, wp.int32 if part is broken else wp.float32) for part in read]
            launch_rows(next_adjoint_kernel, -(-rows // LANES), inputs, written, on, least=64)
        of_features = None
        if ctx.needs_input_grad[0]:
            of_features = features.new_zeros(features.shape)
            of_features[:, :9] = of_phi
        return of_features, of_psi, of_values, None, None, None, None
