"""Which faces meet which in the scenes of the Warp teacher."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.cloth.pairs import Outfits
from warpgarment.kernels.physics.meeting import Meeting
from warpgarment.training.teachers import ClothScene


def meeting_of(scenes: Sequence[ClothScene], faces: torch.Tensor, points: torch.Tensor, distance: float) -> Meeting:
    """Contact of the cloths of each scene with each other and with themselves.

    Args:
        scenes: The scenes.
        faces: Packed faces, int32 [F,3].
        points: Positions in the first frame [m], float64 [V,3].
        distance: Distance to keep [m].
    """
    cloths = [(number, c) for number, scene in enumerate(scenes) for c in scene.cloths]
    ranks = np.concatenate([np.arange(len(scene.cloths)) for scene in scenes])

    def integers(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.int32)).to(faces.device)

    sizes = [len(c.garment.faces) for _, c in cloths]
    numbers = [number for number, _ in cloths]
    outfit_of_vertex = integers(np.repeat(numbers, [len(c.garment.vertices) for _, c in cloths]))
    outfit = np.repeat(numbers, sizes)
    outfits = Outfits(faces, integers(np.repeat(np.arange(len(cloths)), sizes)), integers(outfit), integers(ranks))
    return Meeting(outfits, points, distance, outfit_of_vertex, len(scenes))
