"""Membrane and bending energy of each group of a batch, with gradients for torch: a loss that needs no recording.

    loss = energies.cloth_energies(vertices, cloth).membrane.sum()

Energies, symbols and sources are those of membrane.py and bending.py, without damping.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import warp as wp

from warpgarment.kernels.launch import expect
from warpgarment.kernels.operator import allocate, launch
from warpgarment.kernels.registered import operator

from .bending import bending_kernel
from .cloth import PhysicsCloth
from .membrane import membrane_kernel


class ClothEnergies(NamedTuple):
    """Energies of each group of a batch [J], float64 [B]."""

    membrane: torch.Tensor
    bending: torch.Tensor


_FIELDS = ("faces", "inverse_rest", "stiffness", "hinges", "rest_angle", "bend", "vertex_start")


def cloth_energies(vertices: torch.Tensor, cloth: PhysicsCloth) -> ClothEnergies:
    """Membrane and bending energy of cloth at rest in these positions; differentiable in `vertices`.

    Args:
        vertices: Positions [m], float32 or float64 [V,3], on the device of the cloth.
        cloth: Rest state of the batch.

    Raises:
        TypeError: The positions are neither float32 nor float64.
        ValueError: They have another shape or device than the cloth.
    """
    expect("vertices", vertices, (len(cloth.mass), 3), _floating(vertices), cloth.mass.device)
    model = [getattr(cloth, name) for name in _FIELDS]
    membrane, bending, _, _ = torch.ops.warpgarment.cloth_energies(vertices.double(), model)
    return ClothEnergies(membrane, bending)


def _floating(vertices: torch.Tensor) -> torch.dtype:
    return torch.float64 if getattr(vertices, "dtype", None) == torch.float64 else torch.float32


@operator("warpgarment::cloth_energies", "(Tensor vertices, Tensor[] model) -> (Tensor, Tensor, Tensor, Tensor)")
def _cloth_energies(vertices: torch.Tensor, model: list[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    """Energies [B] and the gradients of their sums [V,3], of the membrane and of bending."""
    faces, inverse_rest, stiffness, hinges, rest_angle, bend, vertex_start = model
    device, vertices = vertices.device, vertices.contiguous()

    def new(*shape: int) -> torch.Tensor:
        return allocate(shape, torch.float64, device)

    energies, gradients = (new(len(faces)), new(len(hinges))), (new(3 * len(faces), 3), new(4 * len(hinges), 3))
    still = new(len(faces)).zero_(), new(len(hinges)).zero_()  # no damping
    strain = new(len(faces), 3).zero_()
    membrane = [(faces, wp.vec3i), (inverse_rest, wp.mat22d), (stiffness, wp.mat33d), (still[0], wp.float64)]
    membrane += [(vertices, wp.vec3d), (strain, wp.vec3d)]
    bending = [(hinges, wp.vec4i), (rest_angle, wp.float64), (bend, wp.float64), (still[1], wp.float64)]
    bending += [(vertices, wp.vec3d), (rest_angle, wp.float64)]
    for kernel, inputs, energy, gradient in zip(
        (membrane_kernel, bending_kernel), (membrane, bending), energies, gradients, strict=True
    ):
        launch(kernel, len(energy), inputs, [(energy, wp.float64), (gradient, wp.vec3d)], device)
    sums, sloped = [], []
    for energy, gradient, corners in zip(energies, gradients, (faces, hinges), strict=True):
        group = torch.bucketize(corners[:, 0].contiguous(), vertex_start[1:], right=True)
        sums.append(energy.new_zeros(len(vertex_start) - 1).index_add_(0, group, energy))
        sloped.append(torch.zeros_like(vertices).index_add_(0, corners.reshape(-1).long(), gradient))
    return sums[0], sums[1], sloped[0], sloped[1]


@_cloth_energies.register_fake
def _(vertices: torch.Tensor, model: list[torch.Tensor]) -> tuple[torch.Tensor, ...]:
    groups = vertices.new_empty(len(model[-1]) - 1)
    return groups, torch.empty_like(groups), torch.empty_like(vertices), torch.empty_like(vertices)


def _save(ctx: Any, inputs: tuple[torch.Tensor, list[torch.Tensor]], output: tuple[torch.Tensor, ...]) -> None:
    ctx.save_for_backward(inputs[1][-1], output[2], output[3])


def _pull_back(
    ctx: Any, membrane: torch.Tensor, bending: torch.Tensor, *rest: torch.Tensor
) -> tuple[torch.Tensor, list[None]]:
    """The gradient of a sum is split among the groups: each vertex belongs to one."""
    start, sloped, bent = ctx.saved_tensors
    counts = (start[1:] - start[:-1]).long()
    return (
        membrane.repeat_interleave(counts)[:, None] * sloped + bending.repeat_interleave(counts)[:, None] * bent,
        [None] * len(_FIELDS),
    )


_cloth_energies.register_autograd(_pull_back, setup_context=_save)
