"""Outfits of tubes over each other, and their faces as the kernels of cloth contact take them."""

from __future__ import annotations

import numpy as np
import torch

from support.scenes import tube
from warpgarment.kernels.cloth.pairs import Outfits
from warpgarment.objects.garment import Garment


def tubes(count: int, gap: float = 0.015, turn: float = 0.2, around: int = 9, along: int = 5) -> list[Garment]:
    """Open tubes over each other, each `gap` [m] wider than the one before and turned by `turn` against it."""
    made = []
    for k in range(count):
        vertices, faces = tube(around, along, bottom=-0.1, top=0.1 + 0.003 * k, radius=(0.1 + k * gap, 0.1 + k * gap))
        c, s = np.cos(turn * k), np.sin(turn * k)
        made.append(Garment(vertices @ np.float32([[c, 0, s], [0, 1, 0], [-s, 0, c]]), faces, name=f"tube{k}"))
    return made


def packed(*layers: list[Garment], itself: bool = True) -> tuple[np.ndarray, Outfits]:
    """Vertices [V,3] and faces of outfits, each a list of garments."""
    vertices, faces, garment, outfit, rank = [], [], [], [], []
    start = 0
    for number, worn in enumerate(layers):
        for place, item in enumerate(worn):
            vertices.append(item.vertices)
            faces.append(item.faces + start)
            garment.append(np.full(len(item.faces), len(rank)))
            outfit.append(np.full(len(item.faces), number))
            rank.append(place)
            start += len(item.vertices)
    integers = [torch.from_numpy(np.concatenate(part).astype(np.int32)) for part in (faces, garment, outfit)]
    return np.concatenate(vertices), Outfits(*integers, torch.tensor(rank, dtype=torch.int32), itself)


def shaken(vertices: np.ndarray, size: float, seed: int) -> np.ndarray:
    """Every vertex moved at random by up to `size` [m] along each axis, float32."""
    return (vertices + np.random.default_rng(seed).uniform(-size, size, vertices.shape)).astype(np.float32)
