"""Whether weights may have changed since something was made from them.

torch counts the changes of a tensor in its version, but an optimiser that updates all weights in one call
(`torch.optim.AdamW(fused=True)`) changes them without counting (torch 2.13). So its steps are counted here. What is
written through `weight.data` or a NumPy array is not counted either: a checksum tells it, where there is time for one.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Iterable, Mapping
from operator import attrgetter, getitem, is_
from typing import Any

import torch
from torch.optim.optimizer import register_optimizer_step_post_hook

_counter = itertools.count(1)
_steps = 0


def optimiser_steps() -> int:
    """Number of steps of all optimisers of torch in this process, since this file was imported."""
    return _steps


def version(tensor: torch.Tensor) -> int:
    """The version of a tensor; 0 of one that was made in inference mode, which does not count its changes."""
    return 0 if tensor.is_inference() else tensor._version


class Sources:
    """Parameters and buffers of modules as they are now; they are asked for changes in every frame.

    Args:
        places: Where a module keeps each of them, and its name there.

    Attributes:
        counted: Whether torch counts the changes of all of them; those made in inference mode are not.
    """

    def __init__(self, places: Iterable[tuple[Mapping[str, torch.Tensor | None], str]]) -> None:
        listed = list(places)
        self._places, self._names = [place for place, _ in listed], [name for _, name in listed]
        self._values = list(map(getitem, self._places, self._names))
        self._tensors = [value for value in self._values if value is not None]
        self.counted = not any(tensor.is_inference() for tensor in self._tensors)
        self._state = self._now() if self.counted else None
        self._sums = self._checksums()

    def unchanged(self) -> bool:
        """Whether the modules still have the same tensors, with the same values; False if these are not `counted`."""
        same = all(map(is_, map(getitem, self._places, self._names), self._values))
        return same and self._state is not None and self._state == self._now()

    def written(self) -> bool:
        """Whether a tensor has other values, whether or not torch has counted that; takes some milliseconds."""
        return self._sums != self._checksums()

    def _checksums(self) -> list[int]:
        return [zlib.crc32(t.detach().reshape(-1).cpu().view(torch.uint8).numpy().data) for t in self._tensors]

    def _now(self) -> tuple[int, list[int], list[int]]:
        addresses = list(map(torch.Tensor.data_ptr, self._tensors))
        return _steps, addresses, list(map(attrgetter("_version"), self._tensors))


def _count(*_: Any) -> None:
    global _steps
    _steps = next(_counter)


register_optimizer_step_post_hook(_count)
