"""Warns of outfits whose garments are given in another order than they lie over each other at the start (over.py)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import combinations

import torch

from warpgarment.geometry.over import is_wrong, sides_of
from warpgarment.kernels.sdf import BodyMeshes
from warpgarment.sim.scene import Scene


def warn_of_wrong_order(
    scene: Scene, vertices: torch.Tensor, body: torch.Tensor, layers: Sequence[Sequence[int]]
) -> None:
    """Warns by name of garments that lie beneath what they are said to be worn over.

    Args:
        scene: The garments that are simulated, and their bodies.
        vertices: Garments in the first frame [m], packed, shape [V,3].
        body: Bodies in the first frame [m], packed, shape [U,3].
        layers: Garments of each outfit, innermost first.

    Warns:
        RuntimeWarning: More than half of where two garments lie over each other.
    """
    pairs = [pair for outfit in layers for pair in combinations(outfit, 2)]
    if not pairs:
        return
    garments, packed = scene.garments, scene.packed
    offsets, device = packed.vertex_offsets, vertices.device
    counts = [offsets[outer + 1] - offsets[outer] for _, outer in pairs]
    points = torch.cat([vertices[offsets[outer] : offsets[outer + 1]] for _, outer in pairs])
    inner = torch.tensor([k for k, _ in pairs], dtype=torch.int32, device=device)
    inner = inner.repeat_interleave(torch.tensor(counts, device=device))
    sheets = BodyMeshes(vertices, packed.faces, offsets, packed.face_offsets)
    found = sides_of(points, inner, sheets, scene.bodies.at(body), scene.packed_bodies.body_of_garment[inner.long()])
    beneath, above = found.beneath.split(counts), found.above.split(counts)
    for number, (lower, upper) in enumerate(pairs):
        under, over = int(beneath[number].sum()), int(above[number].sum())
        if is_wrong(under, over, counts[number]):
            names = [garments[k].name or f"garment {k}" for k in (lower, upper)]
            warnings.warn(
                f"{names[1]} is given over {names[0]}, but lies beneath it at the start: {under:,} of the "
                f"{under + over:,} vertices where they are over each other ({under / (under + over):.0%}). Garments "
                f"stay in the order in which they start; give them innermost first, {names[1]} before {names[0]}",
                RuntimeWarning,
                stacklevel=5,
            )
