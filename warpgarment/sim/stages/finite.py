"""Garments that are not finite keep their last finite positions, so that other garments of the batch stay finite."""

from __future__ import annotations

import torch

from warpgarment.kernels.deformation import next_frame
from warpgarment.objects.pack import PackedGarments


def keep_finite(
    packed: PackedGarments, new: torch.Tensor, old: torch.Tensor, finite: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """New positions of garments that are finite, old ones of the others.

    Args:
        packed: The batch.
        new: Positions [m], shape [V,3].
        old: Positions to keep where new ones are not finite [m], shape [V,3].
        finite: Whether each garment has been finite so far, bool [B].

    Returns:
        Positions [m], shape [V,3], and whether each garment is finite now, bool [B].
    """
    learning = torch.is_grad_enabled() and (new.requires_grad or old.requires_grad)
    if new.device.type == "cpu" and not learning:
        return next_frame.keep_finite(packed.vertex_start, new, old, finite)
    if new.device.type == "cpu" and bool(torch.isfinite(new.detach().sum())) and bool(finite.all()):
        return new, finite  # a sum with a number that is not finite is not finite
    owner = packed.owner
    wrong = torch.zeros(packed.count, dtype=torch.int32, device=new.device)
    wrong = wrong.index_add(0, owner, (~torch.isfinite(new).all(1)).int())
    finite = finite & (wrong == 0)
    return torch.where(finite[owner][:, None], new, old), finite
