"""Number of operations of a training step, and the peak rate of devices.

Only the matrix products that the method needs are counted, with two operations for each multiplication and addition, as
is usual for "model FLOPs". Layer norms, activations and softmax are not counted, nor are values that an implementation
computes again in the backward pass. For a sample of N faces and C components, T = N + C tokens, H frames of history,
width E, feed-forward width W and L layers, in which m of h heads use geodesic weights (of width M = m E / h together):

    embedding        2 N (34 H) E + 2 C 3 (H - 1) E
    layer:
      q, k, v        2 T E (3 E - 2 M)          queries and keys of manifold heads are not computed
      q k^T, A v     4 T^2 (E - M)
      geodesic A v   2 N^2 M
      output         2 T E^2
      feed-forward   4 T E W
    heads            2 N E 12 + 2 C E 3

Each kind of network counts its own operations in `Architecture.flops`; see patches/architecture.py for patches.

The backward pass has two products for each product of the forward pass, one for the gradient of each factor, but only
one if a factor needs no gradient, as the inputs of the embeddings and the geodesic weights.
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
    """Operations of all encoder layers on faces or patches and components: of products with two gradients, with one."""
    e, tokens = config.embedding, nodes + components
    manifold = config.manifold_heads * (e // config.heads)
    layer = 2 * tokens * e * (3 * e - 2 * manifold) + 4 * tokens**2 * (e - manifold)
    layer += 2 * tokens * e * e + 4 * tokens * e * config.feed_forward
    return config.layers * layer, config.layers * 2 * nodes**2 * manifold


def step_flops(config: NetworkConfig, samples: int, faces: int, components: int, rows: Any = None) -> int:
    """Operations of a training step, forward and backward, see above; `rows` is the argument of the network."""
    both, one = architecture(config.architecture).flops(config, faces, components, rows)
    return samples * (3 * both + 2 * one)


def work(config: NetworkConfig, views: Iterable[tuple[int, int, int, Any]]) -> int:
    """Operations of a training step in which the network runs once on each view.

    Args:
        config: Settings of the network.
        views: For each call of the network, the number of rows, the numbers of faces and of components of a row, and
            the result of `Architecture.rows`.
    """
    return sum(step_flops(config, *view) for view in views)


def matrix_peak(device: torch.device, precision: str) -> float | None:
    """Peak rate of a device in bfloat16 [FLOP/s]; None if it is not known, and for float32."""
    if device.type != "cuda" or precision != "bfloat16":
        return None
    return peak_of(torch.cuda.get_device_name(device))


def peak_of(name: str) -> float | None:
    """Peak rate in bfloat16 [FLOP/s] of a device of this name; None if unknown, and for a slice of a device (MIG)."""
    words = f" {name} ".replace("-", " ")
    found = (peak for part, peak in PEAKS if f" {part} " in words)
    return None if "MIG" in name else next(found, None)
