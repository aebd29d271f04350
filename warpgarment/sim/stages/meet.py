"""Step 6 of a frame: keeps garments that are worn over each other, and each garment with itself, from crossing.

The start of the step is the last frame, carried with the body by one smooth motion for all layers of an outfit
(`kernels/features/carry_together.py`); its end is the frame after contact with the body. Faces that come too close are
pushed apart (`kernels/cloth/contacts.py`), and vertices go as far as nothing crosses (`kernels/cloth/steps.py`). What
crosses in the result is counted, and so is how far vertices stayed behind.

What was free stays free: if the start crosses where the last frame did not, the outfit is carried by a smoother motion,
at last by an affine one, which cannot make anything cross; and the steps hold an outfit at its start if they find no
safe way. The exception is a face with more partners than there is room for, whose frame is reported as not counted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.cloth.contacts import Contacts
from warpgarment.kernels.cloth.crossings import Crossings, crossings
from warpgarment.kernels.cloth.newly import newly_crossing
from warpgarment.kernels.cloth.pairs import FacePairs, Outfits
from warpgarment.kernels.cloth.steps import safe_steps
from warpgarment.kernels.features.carry_together import carried_together
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim.timing import Timings

THICKNESS = 0.002
"""Distance that garments keep from each other [m]."""
ROUNDS = 6
"""Rounds of pushes in a frame."""
REACHES = (0.2, 0.4, 0.8, 1.0e6)
"""Reaches [m] of the motions that carry an outfit, of which the first is taken by which nothing begins to cross."""
CELL = 0.08
"""Side of the cells [m] of which each gives one face whose motion carries the garments."""
FIGURES = 4
"""Columns of the figures of a frame: crossing pairs with other garments, with itself, lag [m], pairs not looked at."""


class Meet:
    """Contact of cloth with cloth.

    Args:
        packed: The batch.
        layers: Garments of each outfit, innermost first, as numbers in the batch; none twice.
        first_vertices: Positions in the first frame [m], shape [V,3].
        timings: Times of the stages, to which this one adds its own as "layers".

    Attributes:
        on: Whether there is any outfit. Otherwise the stage does nothing.
        early_exit: Whether the host looks if a smoother motion or another round is needed. On a GPU all are done.
    """

    def __init__(
        self,
        packed: PackedGarments,
        layers: Sequence[Sequence[int]],
        first_vertices: torch.Tensor,
        timings: Timings,
    ) -> None:
        self._packed, self._timings, self._count, self.on = packed, timings, len(layers), bool(layers)
        device = packed.faces.device
        self.early_exit = device.type == "cpu"
        self._unmeasured = torch.full((packed.count, FIGURES), torch.nan, device=device)
        if not self.on:
            return
        outfit, rank = np.full(packed.count, -1, np.int32), np.full(packed.count, -1, np.int32)
        for number, garments in enumerate(layers):
            outfit[list(garments)] = number
            rank[list(garments)] = np.arange(len(garments))
        owner = packed.garment_of_face.cpu().numpy()
        members = np.flatnonzero(outfit[owner] >= 0)
        self._outfit = torch.from_numpy(outfit).to(device)
        self._outfit_of_vertex = self._outfit[packed.garment_of_vertex.long()].contiguous()
        chosen = torch.from_numpy(members).to(device)
        garment = packed.garment_of_face[chosen].contiguous()
        self._pairs = FacePairs(
            Outfits(
                packed.faces[chosen].contiguous(),
                garment,
                self._outfit[garment.long()].contiguous(),
                torch.from_numpy(rank).to(device),
            ),
            first_vertices,
        )
        self._contacts = Contacts(self._pairs, len(first_vertices), thickness=THICKNESS, rounds=ROUNDS)
        centroids = first_vertices.cpu().numpy()[packed.faces.cpu().numpy()[members]].mean(axis=1)
        samples, offsets = _samples(centroids, outfit[owner[members]], len(layers))
        self._samples = torch.from_numpy(members[samples].astype(np.int32)).to(device)
        self._sample_offsets = torch.from_numpy(offsets).to(device)
        self._no_normal = torch.zeros((0, 0, 3), device=device)

    def __call__(
        self, before: torch.Tensor, after: torch.Tensor, features: torch.Tensor, finite: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Positions at t+1 [m], shape [V,3], and figures [B,4], NaN where there is no outfit; without gradients.

        Args:
            before: Garments at t [m], shape [V,3].
            after: Garments at t+1 after contact with the body [m], shape [V,3].
            features: Features at t, shape [F,34].
            finite: Which garments are simulated, bool [B].
        """
        if not self.on:
            return after, self._unmeasured
        with self._timings("layers"), torch.no_grad():
            start = self._start(before, after, features, finite)
            wanted = self._contacts.pushed(start, after)
            steps = safe_steps(
                self._contacts, start, wanted, self._outfit_of_vertex, self._count, early_exit=self.early_exit
            )
            moving = finite[self._packed.garment_of_vertex.long()][:, None]
            positions = torch.where(moving, steps.positions, after)
            behind = (wanted - positions).norm(dim=1)
            lag = behind.new_zeros(self._packed.count).scatter_reduce(
                0, self._packed.garment_of_vertex.long(), behind, "amax"
            )
            return positions, self._figures(positions, self._contacts.normal, lag)

    def _start(
        self, before: torch.Tensor, after: torch.Tensor, features: torch.Tensor, finite: torch.Tensor
    ) -> torch.Tensor:
        """The last frame, carried with the body [m], shape [V,3]; pairs and their directions are found for it.

        An outfit that would begin to cross is carried by the next smoother motion.
        """
        start, crossing = before, torch.ones(self._count + 1, dtype=torch.bool, device=before.device)
        for attempt, reach in enumerate(REACHES):
            carried = carried_together(
                before,
                after,
                self._packed.faces,
                features,
                self._samples,
                self._outfit_of_vertex,
                self._sample_offsets,
                reach=reach,
            )
            start = torch.where(crossing[self._outfit_of_vertex.long()][:, None], carried, start)
            self._pairs.find(start, after, finite)
            self._contacts.find(start, after)
            if attempt + 1 < len(REACHES):
                crossing[:-1] = crossing[:-1] & newly_crossing(self._contacts, before, self._count)
                if self.early_exit and not crossing[:-1].any():
                    break
        return start

    def measure(self, vertices: torch.Tensor, finite: torch.Tensor) -> torch.Tensor:
        """Figures [B,4] of positions [m], shape [V,3], without moving them."""
        if not self.on:
            return self._unmeasured
        with self._timings("layers"):
            self._pairs.find(vertices, vertices, finite)
            return self._figures(vertices, self._no_normal, self._unmeasured[:, 2])

    def _figures(self, vertices: torch.Tensor, normal: torch.Tensor, lag: torch.Tensor) -> torch.Tensor:
        members = len(self._pairs.outfits.faces)
        found: Crossings = crossings(self._contacts.model, members, normal, vertices, self._packed.count)
        unseen = torch.zeros(self._count + 1, dtype=torch.int32, device=vertices.device)
        outfit = torch.where(self._outfit >= 0, self._outfit, self._count).long()
        unseen = unseen.index_add(0, outfit, found.unseen)[outfit]
        figures = torch.stack([found.layers.float(), found.itself.float(), lag, unseen.float()], dim=1)
        return torch.where((self._outfit >= 0)[:, None], figures, torch.nan)


def _samples(centroids: np.ndarray, outfit: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """One face in each cell of space of each outfit.

    Args:
        centroids: Centroids of faces [m], shape [M,3].
        outfit: Outfit of each face, shape [M].
        count: Number of outfits O.

    Returns:
        Faces, those of each outfit one after another, and the first one of each outfit, int32 [O+1].
    """
    cells = np.column_stack([outfit, np.floor(centroids / CELL).astype(np.int64)])
    _, first = np.unique(cells, axis=0, return_index=True)
    offsets = np.searchsorted(outfit[first], np.arange(count + 1)).astype(np.int32)
    return first, offsets
