r"""The step of each face and its losses, with gradients, for training: beside steps.py.

What the network says of face i, a (psi) and b (sigma), is compared with what leads to the recorded frame, Phi' and
Sigma'; with G the rotation of the network's input, S the signs of a mirror (or ones), R the rotation of the body near
the face (or the identity), and u one, or the deviation of each number:

    M = S o (std a + mean)       Psi = G^T M G R        Sigma = std b + mean
    N = S o (G T G^T)            T = Phi' Phi^-1 R^T    c = (N - mean) / std      d = (Sigma' - mean) / std
    losses: w sum u |a - c|      w sum u |b - d|

Gradients flow to a, b, G and Phi. With A, B the gradients of M and N (o is a product of entries):

    A = G (dPsi R^T) G^T         dG = M G (dPsi R^T)^T + M^T G (dPsi R^T) + B G T^T + B^T G T
    dPhi = -(Phi' Phi^-1)^T (G^T B G R) Phi^-T
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch_rows, rows_in_memory, torch_stream
from warpgarment.kernels.operator import allocate

wp.set_module_options(compiling.options())


@wp.func
def sign_of(k: wp.int32, mirrored: wp.uint8):
    """The sign by which a mirror in x multiplies entry k of a map."""
    across = (k // 3 == 0) != (k % 3 == 0)
    return wp.where(across and mirrored != wp.uint8(0), -1.0, 1.0)


@wp.func
def said_map(said: wp.array[wp.float32], at: wp.int32, scale: wp.array[wp.float32], mirrored: wp.uint8):
    m = wp.mat33()
    for k in range(9):
        m[k // 3, k % 3] = sign_of(k, mirrored) * (said[at + k] * scale[k] + scale[12 + k])
    return m


@wp.func
def between(phi_next: wp.mat33, phi: wp.mat33):
    """Phi' Phi^-1."""
    return wp.mat33(wp.mat33d(phi_next) * wp.inverse(wp.mat33d(phi)))


@wp.kernel(enable_backward=False)
def trained_steps_kernel(
    from_row: wp.int32,
    count: wp.int32,
    psi_pitch: wp.int32,
    values_pitch: wp.int32,
    # Model:
    scale: wp.array[wp.float32],
    unit: wp.array[wp.float32],
    index: wp.array[wp.int64],
    mirrored: wp.array[wp.uint8],
    weight: wp.array[wp.float32],
    near: wp.array[wp.mat33],
    phi_next: wp.array[wp.mat33],
    values_next: wp.array[wp.vec3],
    # In:
    phi: wp.array[wp.mat33],
    turn: wp.array[wp.mat33],
    said_psi: wp.array[wp.float32],
    said_values: wp.array[wp.float32],
    # Out:
    psi: wp.array[wp.mat33],
    values: wp.array[wp.vec3],
    terms: wp.array[wp.vec2],
):
    i = from_row + wp.tid()
    face = wp.int32(index[i])
    if face < 0:
        return
    row = i // count
    g = turn[row]
    flip = mirrored[row]
    r = near[face]
    at = psi_pitch * i
    psi[face] = wp.transpose(g) * said_map(said_psi, at, scale, flip) * g * r
    n = g * (between(phi_next[face], phi[face]) * wp.transpose(r)) * wp.transpose(g)
    of_psi = wp.float32(0.0)
    for k in range(9):
        wanted = (sign_of(k, flip) * n[k // 3, k % 3] - scale[12 + k]) / scale[k]
        of_psi += unit[k] * wp.abs(said_psi[at + k] - wanted)
    sigma = wp.vec3()
    of_values = wp.float32(0.0)
    for k in range(3):
        said = said_values[values_pitch * i + k]
        sigma[k] = said * scale[9 + k] + scale[21 + k]
        of_values += unit[9 + k] * wp.abs(said - (values_next[face][k] - scale[21 + k]) / scale[9 + k])
    values[face] = sigma
    terms[face] = weight[face] * wp.vec2(of_psi, of_values)


@wp.func
def slope(x: wp.float32):
    """The derivative of |x|, which is zero at zero."""
    return wp.where(x > 0.0, 1.0, wp.where(x < 0.0, -1.0, 0.0))


@wp.kernel(enable_backward=False)
def steps_adjoint_kernel(
    from_row: wp.int32,
    count: wp.int32,
    psi_pitch: wp.int32,
    values_pitch: wp.int32,
    # Model:
    scale: wp.array[wp.float32],
    unit: wp.array[wp.float32],
    index: wp.array[wp.int64],
    mirrored: wp.array[wp.uint8],
    weight: wp.array[wp.float32],
    near: wp.array[wp.mat33],
    phi_next: wp.array[wp.mat33],
    values_next: wp.array[wp.vec3],
    # In:
    phi: wp.array[wp.mat33],
    turn: wp.array[wp.mat33],
    said_psi: wp.array[wp.float32],
    said_values: wp.array[wp.float32],
    adj_psi: wp.array[wp.mat33],
    adj_values: wp.array[wp.vec3],
    adj_terms: wp.array[wp.float32],
    # Out:
    of_phi: wp.array[wp.mat33],
    of_turn: wp.array[wp.mat33],
    of_said_psi: wp.array[wp.float32],
    of_said_values: wp.array[wp.float32],
):
    i = from_row + wp.tid()
    face = wp.int32(index[i])
    if face < 0:
        of_turn[i] = wp.mat33()
        for k in range(9):
            of_said_psi[9 * i + k] = 0.0
        for k in range(3):
            of_said_values[3 * i + k] = 0.0
        return
    row = i // count
    g = turn[row]
    flip = mirrored[row]
    r = near[face]
    at = psi_pitch * i
    w = weight[face]
    m = said_map(said_psi, at, scale, flip)
    p = adj_psi[face] * wp.transpose(r)
    a = g * p * wp.transpose(g)
    d = between(phi_next[face], phi[face])
    t = d * wp.transpose(r)
    n = g * t * wp.transpose(g)
    b = wp.mat33()
    for k in range(9):
        sign = sign_of(k, flip)
        wanted = (sign * n[k // 3, k % 3] - scale[12 + k]) / scale[k]
        of_loss = adj_terms[0] * w * unit[k] * slope(said_psi[at + k] - wanted)
        b[k // 3, k % 3] = -sign * of_loss / scale[k]
        of_said_psi[9 * i + k] = of_loss + scale[k] * sign * a[k // 3, k % 3]
    of_turn[i] = m * g * wp.transpose(p) + wp.transpose(m) * g * p + b * g * wp.transpose(t) + wp.transpose(b) * g * t
    q = wp.mat33d(wp.transpose(g) * b * g * r)
    back = wp.transpose(wp.inverse(wp.mat33d(phi[face])))
    of_phi[face] = -wp.mat33(wp.transpose(wp.mat33d(d)) * q * back)
    for k in range(3):
        said = said_values[values_pitch * i + k]
        wanted = (values_next[face][k] - scale[21 + k]) / scale[9 + k]
        of_loss = adj_terms[1] * w * unit[9 + k] * slope(said - wanted)
        of_said_values[3 * i + k] = of_loss + scale[9 + k] * adj_values[face][k]


class Rows(NamedTuple):
    """Rows of faces that the network sees together."""

    face: torch.Tensor  # int64 [R,N], packed face of each entry; -1 for padding
    mirrored: torch.Tensor  # bool [R], which rows are mirrored in x
    turn: torch.Tensor  # [R,3,3], rotation to the network's frame
    psi: torch.Tensor  # [R,N,9], what the network says, normalised
    values: torch.Tensor  # [R,N,3]


class Wanted(NamedTuple):
    """Where the faces [F] should go, and how much each counts."""

    scale: torch.Tensor  # [24], deviations of the twelve numbers, then their means
    unit: torch.Tensor  # [12], by which differences of normalised numbers are multiplied
    weight: torch.Tensor  # [F]
    near: torch.Tensor  # [F,3,3], rotation of the body near a face; the identity if steps are not relative to it
    phi: torch.Tensor  # [F,3,3], recorded deformation gradients
    values: torch.Tensor  # [F,3], recorded singular values


def trained_steps(
    phi: torch.Tensor, rows: Sequence[Rows], wanted: Wanted
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Steps and losses, differentiable in phi, and in turn, psi and values of all rows.

    Args:
        phi: Deformation gradients of the newest frame, shape [F,3,3].
        rows: Rows in which each face is once.
        wanted: What is wanted of the faces.

    Returns:
        Psi [F,3,3], Sigma [F,3], and the losses of both [2].
    """
    views = [(each.face, each.mirrored) for each in rows]
    given = [tensor for each in rows for tensor in (each.turn, each.psi, each.values)]
    found: tuple[torch.Tensor, torch.Tensor, torch.Tensor] = _Steps.apply(wanted, views, phi, *given)
    return found


Views = list[tuple[torch.Tensor, torch.Tensor]]


def _arguments(wanted: Wanted, phi: torch.Tensor, view: tuple[torch.Tensor, ...], *rows: torch.Tensor) -> list[object]:
    """Arguments that both kernels have, from the second on."""
    (index, mirrored), (turn, *said) = view, rows
    (psi, psi_pitch), (values, values_pitch) = (rows_in_memory(part.flatten(0, 1)) for part in said)
    kinds = wp.float32, wp.float32, wp.int64, wp.uint8, wp.float32, wp.mat33, wp.mat33, wp.vec3
    model = wanted.scale, wanted.unit, index.view(-1), mirrored.view(torch.uint8), *wanted[2:]
    return [
        index.shape[1],
        psi_pitch,
        values_pitch,
        *(as_argument(part, kind) for part, kind in zip(model, kinds, strict=True)),
        as_argument(phi, wp.mat33),
        as_argument(turn, wp.mat33),
        as_argument(psi, wp.float32),
        as_argument(values, wp.float32),
    ]


_KINDS = wp.mat33, wp.vec3, wp.vec2


class _Steps(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, wanted: Wanted, views: Views, phi: torch.Tensor, *given: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        count, device = len(phi), phi.device
        phi, given = phi.contiguous(), tuple(t if n % 3 else t.contiguous() for n, t in enumerate(given))
        psi, values, terms = (allocate((count, *end), torch.float32, device) for end in ((3, 3), (3,), (2,)))
        written = [as_argument(part, kind) for part, kind in zip((psi, values, terms), _KINDS, strict=True)]
        with torch_stream(device) as on:
            for n, view in enumerate(views):
                inputs = _arguments(wanted, phi, view, *given[3 * n : 3 * n + 3])
                launch_rows(trained_steps_kernel, view[0].numel(), inputs, written, on)
        ctx.save_for_backward(phi, *given)
        ctx.made = wanted, views
        return psi, values, terms.sum(dim=0)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (wanted, views), (phi, *given) = ctx.made, ctx.saved_tensors
        gradients = tuple(part.contiguous() for part in gradients)
        of_phi, found = allocate(phi.shape, torch.float32, phi.device), list[torch.Tensor]()
        with torch_stream(phi.device) as on:
            adjoints = [
                as_argument(part, kind) for part, kind in zip(gradients, (*_KINDS[:2], wp.float32), strict=True)
            ]
            for n, view in enumerate(views):
                inputs = _arguments(wanted, phi, view, *given[3 * n : 3 * n + 3]) + adjoints
                made = [allocate((*view[0].shape, *end), torch.float32, phi.device) for end in ((3, 3), (9,), (3,))]
                kinds = wp.mat33, wp.float32, wp.float32
                flat = made[0].flatten(0, 1), made[1].view(-1), made[2].view(-1)
                written = [as_argument(part, kind) for part, kind in zip(flat, kinds, strict=True)]
                written.insert(0, as_argument(of_phi, wp.mat33))
                launch_rows(steps_adjoint_kernel, view[0].numel(), inputs, written, on)
                found += [made[0].sum(dim=1), *made[1:]]
        ctx.made = None
        return None, None, of_phi, *found
