"""Sequences of two tubes of cloth over each other on the swaying capsule, for tests of outfits."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from support import sequences
from warpgarment.objects.material import Material


def two_layers(wide: float = 1.15, wind: float = 2.0):
    """A change of a sequence's arrays: a tube `wide` times as wide over the first, in a wind of about `wind` [m/s]."""

    def change(content: dict) -> None:
        count = len(content["garment_rest_vertices"])
        for name in ("garment_rest_vertices", "garment_vertices"):
            inner = content[name]
            middle = inner.mean(axis=-2, keepdims=True)
            outer = middle + (inner - middle) * np.float32([wide, 0.9, wide])
            content[name] = np.concatenate([inner, outer], axis=-2).astype(np.float32)
        faces = content["garment_faces"]
        content["garment_faces"] = np.concatenate([faces, faces + count]).astype(np.int32)
        content["garment_starts"] = np.array([0, count, 2 * count], np.int32)
        if wind:
            frames = len(content["garment_vertices"])
            content["wind"] = np.tile(np.float32([wind, 0.0, 0.1]), (frames, 1))

    return change


def write(root: Path, name: str, split: str = "test", *, wide: float = 1.15, wind: float = 2.0, **settings) -> Path:
    """Writes a sequence of an inner dress and an outer jacket, by name; returns its folder."""
    garments = [
        {"name": "inner", "category": "dress", "material": Material(density=0.4).as_dict()},
        {"name": "outer", "category": "jacket", "material": Material(density=0.2).as_dict()},
    ]
    return sequences.write(root, name, split, spoil=two_layers(wide, wind), manifest={"garments": garments}, **settings)
