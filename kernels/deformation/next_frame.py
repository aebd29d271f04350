"""The deformation gradients of a garment in the next frame: steps 2 and 3 of Algorithm 1, in two launches.

`keep_finite` then chooses, in another one, between new positions and old ones.

Manifold-aware transformers, Algorithm 1: "Φ ← Ψ Φ, replace singular values of Φ with Σ" (svd.py).

    | paper | code            | what                                                        |
    | ----- | --------------- | ----------------------------------------------------------- |
    | Ψ     | psi             | predicted relative deformation gradient                     |
    | Φ     | features        | of the newest frame, row-major in the first nine columns    |
    | Σ     | singular_values | predicted singular values of ΨΦ                             |
    | q     | velocity        | predicted change of the mean of each component [m]          |

A garment with any predicted number that is NaN or infinite keeps its Φ (with all singular values 1 if they are
replaced), so that it cannot spoil the solutions of the other garments in the batch.
"""

from __future__ import annotations

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, expect, launch, launch_rows, rows_in_memory, torch_stream
from warpgarment.kernels.operator import allocate

from .replaced_eight import LANES, replaced_eight_kernel
from .svd import svd

wp.set_module_options(compiling.options())
_ONE_BY_ONE = compiling.apart(f"{__name__}.one_by_one")


@wp.kernel(enable_backward=False)
def broken_garments_kernel(
    # Model:
    garment_of_face: wp.array[wp.int32],
    component_of_face: wp.array[wp.int32],
    # In:
    psi: wp.array[wp.mat33],
    singular_values: wp.array[wp.vec3],
    velocity: wp.array[wp.vec3],
    # Out:
    broken: wp.array[wp.int32],  # marked, not cleared
):
    i, _ = wp.tid()  # see compiling.py
    q = velocity[component_of_face[i]]
    if not (wp.isfinite(psi[i]) and wp.isfinite(singular_values[i]) and wp.isfinite(q)):
        broken[garment_of_face[i]] = 1


@wp.kernel(enable_backward=False)
def keep_finite_kernel(
    from_row: wp.int32,
    # Model:
    start: wp.array[wp.int32],
    # In:
    later: wp.array[wp.vec3],
    earlier: wp.array[wp.vec3],
    before: wp.array[wp.uint8],
    # Out:
    kept: wp.array[wp.vec3],
    finite: wp.array[wp.uint8],
):
    thread, _ = wp.tid()  # see compiling.py
    b = from_row + thread
    sound = before[b]
    for i in range(start[b], start[b + 1]):
        point = later[i]
        kept[i] = point
        if not wp.isfinite(point):
            sound = wp.uint8(0)
    finite[b] = sound
    if sound == wp.uint8(0):
        for i in range(start[b], start[b + 1]):
            kept[i] = earlier[i]


@wp.kernel(module=_ONE_BY_ONE, enable_backward=False)
def next_gradients_kernel(
    from_row: wp.int32,
    # Model:
    garment_of_face: wp.array[wp.int32],
    replace: wp.bool,
    smallest: wp.float32,
    # In:
    features: wp.array2d[wp.float32],
    psi: wp.array[wp.mat33],
    singular_values: wp.array[wp.vec3],
    broken: wp.array[wp.int32],
    # Out:
    target: wp.array[wp.mat33],
):
    thread, _ = wp.tid()  # see compiling.py
    i = from_row + thread
    phi = wp.mat33d()
    for row in range(3):
        for column in range(3):
            phi[row, column] = wp.float64(features[i, 3 * row + column])
    s = wp.vec3(1.0)
    if broken[garment_of_face[i]] == 0:
        phi = wp.mat33d(psi[i]) * phi
        for k in range(3):
            s[k] = wp.max(singular_values[i][k], smallest)
    if replace:
        u, _sigma, v = svd(phi)
        phi = u * wp.diag(wp.vec3d(s)) * wp.transpose(v)
    target[i] = wp.mat33(phi)


def next_gradients(
    features: torch.Tensor,
    psi: torch.Tensor,
    singular_values: torch.Tensor,
    velocity: torch.Tensor,
    component_of_face: torch.Tensor,
    garment_of_face: torch.Tensor,
    garments: int,
    *,
    replace: bool = True,
    smallest: float = 1e-3,
) -> tuple[torch.Tensor, torch.Tensor]:
    """ΨΦ with the predicted singular values, and which garments have a finite prediction; without gradients.

    Args:
        features: Features of the faces in the newest frame, in the columns of `features.LAYOUT`, float32 [F, 34].
        psi: Predicted relative deformation gradients Ψ, float32 [F, 3, 3].
        singular_values: Predicted singular values Σ in descending order, float32 [F, 3].
        velocity: Predicted change of the mean of each component q [m], float32 [C, 3].
        component_of_face: Component of each face, int32 [F], within [0, C).
        garment_of_face: Garment of each face, int32 [F], within [0, garments).
        garments: Number of garments B.
        replace: Whether the singular values of ΨΦ are replaced.
        smallest: Lower limit of the new singular values; a face squeezed further would fold onto itself.

    Returns:
        Deformation gradients, float32 [F, 3, 3], and whether all predicted numbers of a garment are finite, bool [B].

    Raises:
        TypeError: An argument has another dtype.
        ValueError: An argument has another shape or is on another device.
    """
    rows, device = len(psi), psi.device
    expect("psi", psi, (None, 3, 3))
    expect("features", features, (rows, None), device=device)
    expect("singular_values", singular_values, (rows, 3), device=device)
    expect("velocity", velocity, (None, 3), device=device)
    expect("component_of_face", component_of_face, (rows,), torch.int32, device)
    expect("garment_of_face", garment_of_face, (rows,), torch.int32, device)
    if features.shape[1] < 9:
        raise ValueError(f"features must hold the 9 numbers of a deformation gradient, got {features.shape[1]}")
    broken = torch.zeros(garments, dtype=torch.int32, device=device)
    target = allocate((rows, 3, 3), torch.float32, device)
    if rows:
        with torch_stream(device) as warp_device:
            gradients, values = as_argument(psi, wp.mat33), as_argument(singular_values, wp.vec3)
            owner, marked = as_argument(garment_of_face, wp.int32), as_argument(broken, wp.int32)
            components = as_argument(component_of_face, wp.int32)
            given = [owner, components, gradients, values, as_argument(velocity, wp.vec3)]
            launch(broken_garments_kernel, rows, [*given, marked], warp_device)
            if replace and warp_device.is_cpu:
                flat, pitch = rows_in_memory(features)
                tensors = [part.contiguous().view(-1) for part in (psi, singular_values)]
                numbers = [as_argument(part, wp.float32) for part in (flat, *tensors)]
                launch_rows(
                    replaced_eight_kernel,
                    -(-rows // LANES),
                    inputs=[rows, pitch, smallest, owner, *numbers, marked],
                    outputs=[as_argument(target.view(-1), wp.float32)],
                    device=warp_device,
                    least=64,
                )
                return target, broken == 0
            launch_rows(
                next_gradients_kernel,
                rows,
                inputs=[owner, replace, smallest, as_argument(features, wp.float32), gradients, values, marked],
                outputs=[as_argument(target, wp.mat33)],
                device=warp_device,
            )
    return target, broken == 0


def keep_finite(
    start: torch.Tensor, new: torch.Tensor, old: torch.Tensor, finite: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """New positions of garments all of whose new positions are finite, old ones of the others, on a CPU; without
    gradients.

    Args:
        start: First vertex of each garment, and the number of all, int32 [B+1].
        new: Positions [m], float32 [V,3].
        old: Positions to keep where new ones are not finite [m], float32 [V,3].
        finite: Which garments are still simulated, bool [B]; the others keep their old positions, too.

    Returns:
        Positions [m], float32 [V,3], and which garments are finite, bool [B].

    Raises:
        TypeError, ValueError: An argument has another dtype or shape, or is on another device.
    """
    count, device = len(start) - 1, new.device
    expect("new", new, (None, 3))
    expect("old", old, tuple(new.shape), device=device)
    expect("finite", finite, (count,), torch.bool, device)
    kept, still = allocate(new.shape, torch.float32, device), allocate((count,), torch.uint8, device)
    given = [
        as_argument(start, wp.int32),
        as_argument(new.detach(), wp.vec3),
        as_argument(old.detach(), wp.vec3),
        as_argument(finite.view(torch.uint8), wp.uint8),
    ]
    written = [as_argument(kept, wp.vec3), as_argument(still, wp.uint8)]
    with torch_stream(device) as warp_device:
        launch_rows(keep_finite_kernel, count, given, written, warp_device, least=16)
    return kept, still.view(torch.bool)
