"""The networks whose speed is measured: trained ones, or untrained ones of a shape, which are as fast."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch

from warpgarment.errors import CheckpointError
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import build_network, preset
from warpgarment.nn.network import GarmentNetwork

SHAPES = ("small", "fast", "base")
DEFAULT = ("small", "fast")


class Named(NamedTuple):
    """A network and its label in rows."""

    label: str
    network: GarmentNetwork


def named(names: Sequence[str]) -> list[Named]:
    """Networks by name: a bundled one, or a file; `small`, `fast` or `base` is made untrained if it is not bundled.

    An untrained network of `small` or `fast` moves the cloth as the body moves; that of `base` moves it anywhere, so
    that its collisions take longer than a trained one's.
    """
    return [_named(name) for name in names]


def _named(name: str) -> Named:
    try:
        path = checkpoint.find(name)
    except CheckpointError:
        if name not in SHAPES:
            raise
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            return Named(f"{name}, untrained", build_network(preset(name)).eval())
    return Named(name, checkpoint.load(path))
