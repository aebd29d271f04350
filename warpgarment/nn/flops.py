"""Arithmetic of a training step, and what a device could do at best.

Counted are the matrix products that the method needs, two operations for each multiplication with its addition, in the
custom of "model FLOPs": nothing for layer norms, activations and softmax, and nothing twice where an implementation
computes something again in the backward pass. For a sample of N faces and C components, T = N + C tokens, H frames of
history, width E, feed-forward width W, L layers, of whose h heads m use geodesic weights (M = m E / h, their width):

    embedding        2 N (34 H) E + 2 C 3 (H - 1) E
    layer:
      q, k, v        2 T E (3 E - 2 M)          queries and keys of manifold heads are not computed
      q k^T, A v     4 T^2 (E - M)
      geodesic A v   2 N^2 M
      output         2 T E^2
      feed-forward   4 T E W
    heads            2 N E 12 + 2 C E 3

Each kind of network counts its own, in `Architecture.flops`; those of patches are in patches/architecture.py.

The backward pass is two products for each of the forward pass, one for each factor's gradient, but one only where a
factor needs no gradient: the embeddings' inputs and the geodesic weights.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch

from .architecture import architecture
from .config import NetworkConfig

PEAKS = (  # part of the device's name, dense bfloat16 with float32 sums [FLOP/s]; the makers' data sheets
    ("B200", 2250e12),
    ("H200 NVL", 835e12),
    ("H200", 989e12),
    ("H100 NVL", 835e12),
    ("H100 PCIe", 756e12),
    ("H100", 989e12),
    ("A100", 312e12),
    ("L40S", 362e12),
    ("L4", 121e12),
    ("RTX 4090", 165e12),
    ("RTX 3090", 71e12),
)


def layer_flops(config: NetworkConfig, nodes: int, components: int) -> tuple[int, int]:
    """Of all encoder layers on faces or patches, and the components: with two gradients, with one."""
    e, tokens = config.embedding, nodes + components
    manifold = config.manifold_heads * (e // config.heads)
    layer = 2 * tokens * e * (3 * e - 2 * manifold) + 4 * tokens**2 * (e - manifold)
    layer += 2 * tokens * e * e + 4 * tokens * e * config.feed_forward
    return config.layers * layer, config.layers * 2 * nodes**2 * manifold


def step_flops(config: NetworkConfig, samples: int, faces: int, components: int, rows: Any = None) -> int:
    """Operations of a training step, forward and backward, see above; `rows` are those the network is given."""
    both, one = architecture(config.architecture).flops(config, faces, components, rows)
    return samples * (3 * both + 2 * one)


def work(config: NetworkConfig, views: Iterable[tuple[int, int, int, Any]]) -> int:
    """Operations of a training step that shows the network each of these views once.

    Args:
        config: Of the network.
        views: Of each call of the network: number of rows, of faces and of components of a row, and what it is given of
            the layout of the faces, from `Architecture.rows`.
    """
    return sum(step_flops(config, *view) for view in views)


def matrix_peak(device: torch.device, precision: str) -> float | None:
    """Most operations per second that a device can do in bfloat16; None where that is not known, or in float32."""
    if device.type != "cuda" or precision != "bfloat16":
        return None
    return peak_of(torch.cuda.get_device_name(device))


def peak_of(name: str) -> float | None:
    """The same by the device's name; None for a slice of a device (MIG)."""
    words = f" {name} ".replace("-", " ")
    found = (peak for part, peak in PEAKS if f" {part} " in words)
    return None if "MIG" in name else next(found, None)
