"""Weighted sums over faces and patches with gradients: pooling, spreading, and the mean over neighbours.

A sum out_i = sum_k w_ik x_(j_ik) is an `embedding_bag`, and so is its gradient, over the same entries in the order of
j. That order is found once for a layout; torch's own gradient sorts the entries in every call and adds them one by one.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch.autograd.function import once_differentiable
from torch.utils.weak import WeakIdKeyDictionary

from .layout import SHARES, PatchLayout


class Bags(NamedTuple):
    """Entries of sums over the rows of an array, those of a bag after each other."""

    entry: torch.Tensor  # int64 [M], rows
    start: torch.Tensor  # int64 [number of bags], the first entry of each
    weight: torch.Tensor  # [M]

    def of(self, rows: torch.Tensor) -> torch.Tensor:
        """The sums of rows [*,F], one for each bag."""
        weight = self.weight.to(rows.dtype)
        return F.embedding_bag(self.entry, rows, self.start, mode="sum", per_sample_weights=weight)


class Sums:
    """Sums and their transpose, which is their gradient.

    Args:
        forward: The sums.
        rows: Number of rows of the array over which they are.
    """

    def __init__(self, forward: Bags, rows: int) -> None:
        self.forward, self._rows = forward, rows

    @cached_property
    def back(self) -> Bags:
        """The transpose, found when a gradient is first asked for."""
        bags = self.forward
        lengths = torch.diff(bags.start, append=bags.start.new_tensor([len(bags.entry)]))
        owner = torch.repeat_interleave(torch.arange(len(lengths), device=lengths.device), lengths)
        order = torch.argsort(bags.entry, stable=True)
        many = torch.bincount(bags.entry, minlength=self._rows)
        return Bags(owner[order], many.cumsum(0) - many, bags.weight[order])

    def __call__(self, rows: torch.Tensor) -> torch.Tensor:
        """The sums of rows [*,F], one for each bag; differentiable in the rows."""
        result: torch.Tensor = _Sum.apply(rows, self)
        return result


class _Sum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: torch.Tensor, sums: Sums) -> torch.Tensor:
        ctx.sums = sums
        return sums.forward.of(rows)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        return ctx.sums.back.of(gradient.contiguous()), None


class LayoutSums(NamedTuple):
    """The sums of a layout for a batch of B rows, whose faces [B N] and patches [B P] lie end to end."""

    pool: Sums  # faces to patches
    spread: Sums  # patches to faces
    around: Sums | None  # mean over three neighbours; None for subsets of faces


_known: WeakIdKeyDictionary = WeakIdKeyDictionary()


def sums_of(layout: PatchLayout, batch: int) -> LayoutSums:
    """The sums of a layout, made once for each number of rows.

    Args:
        layout: The patches of B rows, or of one that serves all.
        batch: Number of rows.
    """
    mine = _known.setdefault(layout.patch, {})
    if batch not in mine:
        mine[batch] = _sums(layout, batch)
    sums: LayoutSums = mine[batch]
    return sums


def _sums(layout: PatchLayout, batch: int) -> LayoutSums:
    count, patches = layout.patch.shape[1], layout.start.shape[1]
    row = torch.arange(batch, device=layout.patch.device)[:, None, None]

    def bags(index: torch.Tensor, rows: int, weight: torch.Tensor) -> Bags:
        """Bags of equal length from indices [B or 1, *, K] into the rows of a garment."""
        moved = (index + rows * row).flatten()
        weight = weight.expand(batch, *index.shape[1:]).flatten()
        start = torch.arange(0, len(moved), index.shape[2], device=index.device)
        return Bags(moved, start, weight)

    start = (layout.start[..., None] + count * SHARES * row).flatten()
    pool = bags(layout.member[..., None], count, layout.member_weight[..., None])._replace(start=start)
    around = None
    if layout.neighbours is not None:
        third = torch.full_like(layout.share[..., :1], 1.0 / 3.0)
        around = Sums(bags(layout.neighbours, count, third.expand(layout.neighbours.shape)), batch * count)
    return LayoutSums(
        Sums(pool, batch * count),
        Sums(bags(layout.patch, patches, layout.share), batch * patches),
        around,
    )
