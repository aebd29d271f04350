"""Between the axes of a Newton model, whose X, Y or Z points up, and ours, where Y does."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch

Points = TypeVar("Points", np.ndarray, torch.Tensor)
# columns of the result, and their signs, for each axis that points up in the model
_TO = {0: ([1, 0, 2], [-1, 1, 1]), 1: ([0, 1, 2], [1, 1, 1]), 2: ([0, 2, 1], [1, 1, -1])}
_FROM = {0: ([1, 0, 2], [1, -1, 1]), 1: ([0, 1, 2], [1, 1, 1]), 2: ([0, 2, 1], [1, -1, 1])}


def to_y_up(points: Points, axis: int) -> Points:
    """Points [..., 3] of a model whose `axis` (0, 1, 2) points up, with Y up."""
    return _turned(points, *_TO[axis])


def from_y_up(points: Points, axis: int) -> Points:
    """The inverse of :func:`to_y_up`."""
    return _turned(points, *_FROM[axis])


def _turned(points: Points, columns: list[int], signs: list[int]) -> Points:
    turned = points[..., columns]
    if isinstance(turned, torch.Tensor):
        return turned * torch.tensor(signs, dtype=turned.dtype, device=turned.device)
    return turned * np.array(signs, dtype=turned.dtype)
