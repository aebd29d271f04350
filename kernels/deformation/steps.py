"""The step of each face from what a network says of it, in one launch and without gradients.

Section 4.1; the composition of `warpgarment/nn/parametrisation.py`, where R_i is the rotation of the body near face i:

    Psi = G^T (std psi + mean) G  [R_i, if residual]        Sigma = std sigma + mean        G turned the network's input

Rows of the network are padded; `index` says which face an entry is, or -1 for padding.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, expect, launch_rows, rows_in_memory, torch_stream

from .svd import rotation_of

wp.set_module_options(compiling.options())

OUTPUTS = 12  # of a face: psi by rows, sigma


@wp.func
def entry(said: wp.array[wp.float32], scale: wp.array[wp.float32], at: wp.int32, k: wp.int32):
    return said[at + k] * scale[k] + scale[12 + k]


@wp.kernel(enable_backward=False)
def steps_kernel(
    from_row: wp.int32,
    count: wp.int32,
    pitch: wp.int32,
    newest: wp.int32,
    residual: wp.int32,
    # Model:
    scale: wp.array[wp.float32],
    index: wp.array[wp.int64],
    # In:
    turn: wp.array[wp.mat33],
    features: wp.array[wp.float32],
    said: wp.array[wp.float32],
    # Out:
    psi: wp.array[wp.mat33],
    sigma: wp.array[wp.vec3],
):
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    face = wp.int32(index[i])
    if face < 0:
        return
    at = 12 * i
    m = wp.mat33()
    for k in range(9):
        m[k // 3, k % 3] = entry(said, scale, at, k)
    g = turn[i // count]
    m = wp.transpose(g) * m * g
    if residual != 0:
        d = wp.mat33d()
        begin = face * pitch + newest
        for k in range(9):
            d[k // 3, k % 3] = wp.float64(features[begin + k])
        m = m * wp.mat33(rotation_of(d))
    psi[face] = m
    sigma[face] = wp.vec3(entry(said, scale, at, 9), entry(said, scale, at, 10), entry(said, scale, at, 11))


def steps(
    said: torch.Tensor,
    scale: torch.Tensor,
    turn: torch.Tensor,
    index: torch.Tensor,
    features: torch.Tensor,
    newest: int,
    out: tuple[torch.Tensor, torch.Tensor],
    *,
    residual: bool,
) -> None:
    """Writes the steps of faces.

    Args:
        said: Normalised psi and sigma, shape [R,N,12].
        scale: Deviations of the twelve numbers, then their means, shape [24].
        turn: Rotation of the input of each row, shape [R,3,3].
        index: Face of each entry, int64 [R,N]; -1 for padding.
        features: Features of the faces, shape [F,K].
        newest: Column at which the deformation of the body begins, in the newest frame.
        out: Psi [F,3,3] and sigma [F,3]; those of faces that `index` names are written.
        residual: Whether psi is relative to the rotation of the body.
    """
    rows, count = said.shape[:2]
    expect("said", said, (rows, count, OUTPUTS))
    expect("scale", scale, (2 * OUTPUTS,), device=said.device)
    expect("turn", turn, (rows, 3, 3), device=said.device)
    expect("index", index, (rows, count), torch.int64, device=said.device)
    expect("features", features, (None, None), device=said.device)
    expect("psi", out[0], (len(features), 3, 3), device=said.device)
    expect("sigma", out[1], (len(features), 3), device=said.device)
    flat, pitch = rows_in_memory(features)
    given = [
        as_argument(scale, wp.float32),
        as_argument(index.flatten(), wp.int64),
        as_argument(turn, wp.mat33),
        as_argument(flat, wp.float32),
        as_argument(said.flatten(), wp.float32),
    ]
    sizes = [count, pitch, newest, int(residual)]
    written = [as_argument(out[0], wp.mat33), as_argument(out[1], wp.vec3)]
    with torch_stream(said.device) as device:
        launch_rows(steps_kernel, rows * count, [*sizes, *given], written, device, least=1024)
