"""Cloth that meets cloth in the Warp teacher: pairs of faces in each step, and a step that crosses nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.cloth.contacts import Contacts
from warpgarment.kernels.cloth.pairs import FacePairs, Outfits
from warpgarment.kernels.cloth.steps import safe_steps
from warpgarment.training.teachers import ClothScene

MARGIN = 0.006
"""How much farther than their guess vertices may go in a step [m]."""
SOON = 0.003
"""Distance beyond the one to keep at which a pair is watched during a step [m]."""


class Meeting:
    """Contact of the cloths of each scene with each other and with themselves.

    Args:
        scenes: The scenes.
        faces: Packed faces, int32 [F,3].
        points: Positions in the first frame [m], float64 [V,3].
        distance: Distance to keep [m].

    Attributes:
        contacts: Pairs of the current step.
    """

    def __init__(
        self, scenes: Sequence[ClothScene], faces: torch.Tensor, points: torch.Tensor, distance: float
    ) -> None:
        device = faces.device
        cloths = [(number, c) for number, scene in enumerate(scenes) for c in scene.cloths]
        ranks = np.concatenate([np.arange(len(scene.cloths)) for scene in scenes])

        def integers(values: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(values.astype(np.int32)).to(device)

        sizes = [len(c.garment.faces) for _, c in cloths]
        numbers = [number for number, _ in cloths]
        self._outfit_of_vertex = integers(np.repeat(numbers, [len(c.garment.vertices) for _, c in cloths]))
        outfit = np.repeat(numbers, sizes)
        outfits = Outfits(faces, integers(np.repeat(np.arange(len(cloths)), sizes)), integers(outfit), integers(ranks))
        pairs = FacePairs(outfits, points.float(), margin=MARGIN)
        self._all = torch.ones(len(cloths), dtype=torch.bool, device=device)
        self._count, self._pairs = len(scenes), pairs
        self.contacts = Contacts(pairs, len(points), thickness=distance + SOON, rounds=1)

    def find(self, start: torch.Tensor, guess: torch.Tensor) -> None:
        """Finds the pairs of a step from its start and the guess of its end [m], [V,3]."""
        self._start, self._guess = start.float(), guess.float()
        self._pairs.find(self._start, self._guess, self._all)
        self.contacts.find(self._start, self._guess)

    def safe(self, end: torch.Tensor) -> torch.Tensor:
        """The end of the step [m], float64 [V,3], as near as nothing crosses that did not at its start."""
        low, high = (f(self._start, self._guess) for f in (torch.minimum, torch.maximum))
        bounded = end.float().clamp(low - 0.9 * MARGIN, high + 0.9 * MARGIN)
        steps = safe_steps(
            self.contacts, self._start, bounded, self._outfit_of_vertex, self._count, early_exit=not end.is_cuda
        )
        return torch.where((steps.positions == end.float()), end, steps.positions.double())
