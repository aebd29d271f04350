"""Whether weights may have changed since something was made from them.

torch counts the changes of a tensor in its version, but an optimiser that updates all weights in one call
(`torch.optim.AdamW(fused=True)`) changes them without counting (torch 2.13). So its steps are counted here.
"""

from __future__ import annotations

import itertools
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


def _count(*_: Any) -> None:
    global _steps
    _steps = next(_counter)


register_optimizer_step_post_hook(_count)
