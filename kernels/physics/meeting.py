"""Cloth that meets cloth in an implicit step: pairs of faces that keep a distance, and a step that crosses nothing."""

from __future__ import annotations

import torch

from warpgarment.kernels.cloth.contacts import Contacts
from warpgarment.kernels.cloth.pairs import PARTNERS, FacePairs, Outfits
from warpgarment.kernels.cloth.steps import safe_steps

MARGIN = 0.006
"""How much farther than their guess vertices may go in a step [m]."""
SOON = 0.003
"""Distance beyond the one to keep at which a pair is watched during a step [m]."""


class Meeting:
    """Contact of the cloths of each outfit with each other and with themselves.

    Args:
        outfits: Faces of the batch, all of them members, and the outfit of each.
        points: Positions in the first frame [m], [V,3].
        distance: Distance to keep [m].
        outfit_of_vertex: Outfit of each vertex, int32 [V].
        count: Number of outfits.
        margin: How much farther than their guess vertices may go in a step [m].
        soon: Distance beyond the one to keep at which a pair is watched during a step [m].
        partners: Room for partners of a face, see `FacePairs`.

    Attributes:
        contacts: Pairs of the current step.
    """

    def __init__(
        self,
        outfits: Outfits,
        points: torch.Tensor,
        distance: float,
        outfit_of_vertex: torch.Tensor,
        count: int,
        *,
        margin: float = MARGIN,
        soon: float = SOON,
        partners: int = PARTNERS,
    ) -> None:
        pairs = FacePairs(outfits, points.float(), margin=margin, partners=partners)
        self._all = torch.ones(len(outfits.rank), dtype=torch.bool, device=points.device)
        self._count, self._pairs, self._outfit_of_vertex, self._margin = count, pairs, outfit_of_vertex, margin
        self.contacts = Contacts(pairs, len(points), thickness=distance + soon, rounds=1)

    def find(self, start: torch.Tensor, guess: torch.Tensor) -> None:
        """Finds the pairs of a step from its start and the guess of its end [m], [V,3]."""
        self._start, self._guess = start.float(), guess.float()
        self._pairs.find(self._start, self._guess, self._all)
        self.contacts.find(self._start, self._guess)

    def safe(self, end: torch.Tensor) -> torch.Tensor:
        """The end of the step [m], float64 [V,3], as near as nothing crosses that did not at its start."""
        low, high = (f(self._start, self._guess) for f in (torch.minimum, torch.maximum))
        bounded = end.float().clamp(low - 0.9 * self._margin, high + 0.9 * self._margin)
        steps = safe_steps(
            self.contacts, self._start, bounded, self._outfit_of_vertex, self._count, early_exit=not end.is_cuda
        )
        return torch.where((steps.positions == end.float()), end, steps.positions.double())
