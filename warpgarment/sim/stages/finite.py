"""Garments that stop being finite keep their last positions, so that they cannot spoil the others of their batch."""

from __future__ import annotations

import torch

from warpgarment.objects.pack import PackedGarments


def keep_finite(
    packed: PackedGarments, new: torch.Tensor, old: torch.Tensor, finite: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """New positions of garments that are finite, old ones of the others.

    Args:
        packed: The batch.
        new: Positions [m], shape [V,3].
        old: Positions to keep where new ones are not finite [m], shape [V,3].
        finite: Which garments have been finite so far, bool [B].

    Returns:
        Positions [V,3], and which garments are finite now [B].
    """
    owner = packed.garment_of_vertex.long()
    wrong = torch.zeros(packed.count, dtype=torch.int32, device=new.device)
    wrong = wrong.index_add(0, owner, (~torch.isfinite(new).all(1)).int())
    finite = finite & (wrong == 0)
    return torch.where(finite[owner][:, None], new, old), finite
