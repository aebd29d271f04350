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

A network of patches has P of them, F face width, G width of a face layer, K face layers; its encoder layers are as
above with P for N, and around them are

    embedding        2 N (34 H) F + 2 C 3 (H - 1) E
    face layers      (K + 1) 4 N F G + K 2 N F G      pooling and spreading, a few operations a number, are not counted
    patches          4 P F E + 2 C P F + 2 C F E      to their width and back, and the mean of each component
    heads            2 N F 12 + 2 C E 3

The backward pass is two products for each of the forward pass, one for each factor's gradient, but one only where a
factor needs no gradient: the embeddings' inputs and the geodesic weights.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch

from warpgarment.nn.patches.layout import PatchLayout

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


def forward_flops(config: NetworkConfig, faces: int, components: int, patches: int = 0) -> tuple[int, int]:
    """Operations of one sample's forward pass: those both of whose factors need a gradient, and the others."""
    if config.architecture == "patches":
        return _forward_flops_patches(config, faces, components, patches)
    heads = 2 * config.embedding * (12 * faces + 3 * components)
    inputs = faces * config.history * config.features + components * 3 * (config.history - 1)
    embedding = 2 * config.embedding * inputs
    layers, geodesic = _layer_flops(config, faces, components)
    return layers + heads, embedding + geodesic


def _layer_flops(config: NetworkConfig, nodes: int, components: int) -> tuple[int, int]:
    """Of all encoder layers on faces or patches, and the components: with two gradients, with one."""
    e, tokens = config.embedding, nodes + components
    manifold = config.manifold_heads * (e // config.heads)
    layer = 2 * tokens * e * (3 * e - 2 * manifold) + 4 * tokens**2 * (e - manifold)
    layer += 2 * tokens * e * e + 4 * tokens * e * config.feed_forward
    return config.layers * layer, config.layers * 2 * nodes**2 * manifold


def _forward_flops_patches(config: NetworkConfig, faces: int, components: int, patches: int) -> tuple[int, int]:
    e, width = config.embedding, config.face_embedding
    embedding = 2 * (width * faces * config.history * config.features + e * components * 3 * (config.history - 1))
    layers, geodesic = _layer_flops(config, patches, components)
    layers += (6 * config.face_layers + 4) * faces * width * config.face_feed_forward + 4 * patches * width * e
    layers += 2 * components * width * (patches + e)
    return layers + 2 * (width * 12 * faces + e * 3 * components), embedding + geodesic


def step_flops(config: NetworkConfig, samples: int, faces: int, components: int, patches: int = 0) -> int:
    """Operations of a training step, forward and backward, see above."""
    both, one = forward_flops(config, faces, components, patches)
    return samples * (3 * both + 2 * one)


def work(config: NetworkConfig, views: Iterable[tuple[int, int, int, Any]]) -> int:
    """Operations of a training step that shows the network each of these views once.

    Args:
        config: Of the network.
        views: Of each call of the network: number of rows, of faces and of components of a row, and the weights it is
            given, a `PatchLayout` for a network of patches.
    """
    total = 0
    for rows, faces, components, weights in views:
        patches = weights.start.shape[1] if isinstance(weights, PatchLayout) else 0
        total += step_flops(config, rows, faces, components, patches)
    return total


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
