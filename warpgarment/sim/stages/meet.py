"""Step 6 of a frame: keeps garments that are worn over each other, and each garment with itself, from crossing.

The start of the step is the last frame, carried with the body by one smooth motion for all layers of an outfit
(`kernels/features/carry_together.py`); its end is the frame after contact with the body. Faces that come too close are
pushed apart (`kernels/cloth/contacts.py`, `parting.py`), and vertices go as far as nothing crosses (`steps.py`). Where
they stay behind, the step is repeated from where they got, with the directions of pairs found there. Cloth that is then
deep in the body, since layers held it or pushed it there, is moved out by another contact with the body, whose result
is the end of another step: so layers stay in their order, and cloth may stay in the body where both cannot be had. What
crosses in the result is counted, and so is how far vertices stayed behind. Where layers cross at the start, faces
around the crossing are pushed to the sides that the order of the layers gives them (`order.py`).

What was free stays free. Where the carried start crosses and the last frame did not, the outfit is carried by an affine
motion, which cannot make anything cross, and goes from there towards the smooth one as far as nothing crosses. The
steps hold an outfit at its start if they find no safe way. The exception is a face with more partners than there is
room for, whose frame is reported as not counted. Neither guaranteed nor counted are faces of a garment with a common
vertex: they can fold through each other about that vertex.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.cloth.contacts import Contacts
from warpgarment.kernels.cloth.crossings import Crossings, crossings
from warpgarment.kernels.cloth.newly import newly_crossing
from warpgarment.kernels.cloth.order import set_free
from warpgarment.kernels.cloth.pairs import MARGIN, FacePairs, Outfits
from warpgarment.kernels.cloth.parting import parted
from warpgarment.kernels.cloth.steps import Steps, safe_steps
from warpgarment.kernels.features.carry_together import carried_together
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim.frame import FIGURES
from warpgarment.sim.timing import Timings

from .contact import Contact

THICKNESS = 0.002
"""Distance that garments keep from each other [m]."""
ROUNDS = 6
"""Rounds of pushes in a step."""
PARTINGS = 16
"""Most rounds in which pairs are parted in a step."""
WIDE = 0.015
"""Margin of boxes [m] in a step that is not the first of its frame."""
STEPS = 3
"""Most steps from the start towards the end of a frame."""
BEHIND = 0.001
"""Lag [m] from which an outfit takes another step."""
OUT = 2
"""Most steps out of the body."""
DEEP = 0.002
"""Depth in the body [m] from which an outfit takes one."""
SMOOTH, AFFINE = 0.2, 1.0e6
"""Reaches [m] of the motions that carry an outfit: the usual one, and one by which nothing can begin to cross."""
CELL = 0.08
"""Side of the cells [m] of which each gives one face whose motion carries the garments."""


class Meet:
    """Contact of cloth with cloth.

    Args:
        packed: The batch.
        layers: Garments of each outfit, at least one, innermost first, as numbers in the batch; none twice.
        first_vertices: Positions in the first frame [m], shape [V,3].
        contact: Contact with the body.
        timings: Times of the stages, to which this one adds its own as "layers".

    Attributes:
        early_exit: Whether the host looks if another motion, step or round is needed. On a GPU all are done.
    """

    def __init__(
        self,
        packed: PackedGarments,
        layers: Sequence[Sequence[int]],
        first_vertices: torch.Tensor,
        contact: Contact,
        timings: Timings,
    ) -> None:
        self._packed, self._contact, self._timings = packed, contact, timings
        self._count = len(layers)
        device = packed.faces.device
        self.early_exit = device.type == "cpu"
        self._unmeasured = torch.full((packed.count, FIGURES), torch.nan, device=device)
        outfit, rank = np.full(packed.count, -1, np.int32), np.full(packed.count, -1, np.int32)
        for number, garments in enumerate(layers):
            outfit[list(garments)] = number
            rank[list(garments)] = np.arange(len(garments))
        owner = packed.garment_of_face.cpu().numpy()
        members = np.flatnonzero(outfit[owner] >= 0)
        self._outfit = torch.from_numpy(outfit).to(device)
        self._owner = packed.garment_of_vertex.long()
        self._outfit_of_vertex = self._outfit[self._owner].contiguous()
        self._every = torch.ones(len(layers) + 1, dtype=torch.bool, device=device)
        self._every[-1] = False  # that of garments of no outfit, whose outfit is -1
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
        self,
        before: torch.Tensor,
        after: torch.Tensor,
        features: torch.Tensor,
        next_body: torch.Tensor,
        finite: torch.Tensor,
        origin: torch.Tensor | None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Positions at t+1 [m], shape [V,3], figures [B,4], NaN where there is no outfit, and depths in the bodies [m],
        shape [B]; without gradients.

        Args:
            before: Garments at t [m], shape [V,3].
            after: Garments at t+1 after contact with the body [m], shape [V,3].
            features: Features at t, shape [F,34].
            next_body: Bodies at t+1 [m], shape [U,3].
            finite: Which garments are simulated, bool [B].
            origin: Where vertices come from, see `Contact.origin`; None: nothing is moved out of the body.
        """
        with torch.no_grad():
            with self._timings("layers"):
                self._pairs.margin = MARGIN
                start = self._start(before, after, features, finite)
                points, active, figures = start, self._every, self._unmeasured
                for number in range(STEPS):
                    points, lag = self._step(points, after, finite, active, found=number == 0)
                    figures = self._renewed(figures, points, lag, active)
                    active = active & self._any(lag > BEHIND)
                    if self.early_exit and not active.any():
                        break
            depth = self._contact.depth(points, next_body)
            for _ in range(0 if origin is None else OUT):
                deep = finite & (depth > DEEP)
                active = self._every & self._any(deep)
                if self.early_exit and not active.any():
                    break
                out = self._contact(points, next_body, deep, origin, measure=False)[0]
                with self._timings("layers"):
                    points, _ = self._step(points, out, finite, active)
                    figures = self._renewed(figures, points, figures[:, 2], active)
                depth = self._contact.depth(points, next_body)
            moving = (self._outfit_of_vertex >= 0) & finite[self._owner]
            return torch.where(moving[:, None], points, after), figures, depth

    def _any(self, garments: torch.Tensor) -> torch.Tensor:
        """Outfits of which any garment is chosen, bool [O+1]; [B] -> [O+1], the last one being that of no outfit."""
        chosen = torch.zeros(self._count + 1, dtype=torch.int32, device=garments.device)
        outfit = torch.where(self._outfit >= 0, self._outfit, self._count).long()
        return chosen.index_add(0, outfit, garments.int()) > 0

    def _start(
        self, before: torch.Tensor, after: torch.Tensor, features: torch.Tensor, finite: torch.Tensor
    ) -> torch.Tensor:
        """The last frame, carried with the body [m], shape [V,3]; pairs and their directions are found for it."""

        def carried(reach: float) -> torch.Tensor:
            packed, owners = self._packed, (self._outfit_of_vertex, self._sample_offsets)
            return carried_together(before, after, packed.faces, features, self._samples, *owners, reach=reach)

        start = carried(SMOOTH)
        self._find(start, after, finite)
        wrong = torch.cat([newly_crossing(self._contacts, before, self._count), ~self._every[-1:]])
        wrong = wrong & self._every
        if self.early_exit and not wrong.any():
            return start
        affine = carried(AFFINE)
        self._find(affine, start, finite & wrong[self._outfit.long()])
        start = torch.where(wrong[self._outfit_of_vertex.long()][:, None], self._safe(affine, start).positions, start)
        self._find(start, after, finite)
        return start

    def _find(self, start: torch.Tensor, end: torch.Tensor, moving: torch.Tensor) -> None:
        self._pairs.find(start, end, moving)
        self._contacts.find(start, end)

    def _safe(self, start: torch.Tensor, end: torch.Tensor) -> Steps:
        return safe_steps(self._contacts, start, end, self._outfit_of_vertex, self._count, early_exit=self.early_exit)

    def _step(
        self,
        start: torch.Tensor,
        end: torch.Tensor,
        finite: torch.Tensor,
        active: torch.Tensor,
        *,
        found: bool = False,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """One step of the outfits that are active; the others stay.

        Args:
            start: Positions without crossings, or with as few as there were [m], shape [V,3].
            end: Positions to reach [m], shape [V,3].
            finite: Which garments are simulated, bool [B].
            active: Outfits, bool [O+1].
            found: Whether pairs and directions are found already.

        Returns:
            Positions [m], shape [V,3], and the largest distance of a vertex of each garment from where pushes wanted it
            [m], shape [B].
        """
        if not found:
            self._pairs.margin = WIDE
            self._find(start, end, finite & active[self._outfit.long()])
        set_free(self._contacts, start, self._count, early_exit=self.early_exit)
        wanted = self._contacts.pushed(start, end)
        wanted = parted(self._contacts, start, end, wanted, self._count, rounds=PARTINGS, early_exit=self.early_exit)
        reached = self._safe(start, wanted).positions
        points = torch.where(active[self._outfit_of_vertex.long()][:, None], reached, start)
        behind = (wanted - points).norm(dim=1)
        return points, behind.new_zeros(self._packed.count).scatter_reduce(0, self._owner, behind, "amax")

    def measure(self, vertices: torch.Tensor, finite: torch.Tensor) -> torch.Tensor:
        """Figures [B,4] of positions [m], shape [V,3], without moving them."""
        with self._timings("layers"):
            self._pairs.find(vertices, vertices, finite)
            return self._figures(vertices, self._no_normal, self._unmeasured[:, 2])

    def _renewed(
        self, figures: torch.Tensor, points: torch.Tensor, lag: torch.Tensor, active: torch.Tensor
    ) -> torch.Tensor:
        """Figures [B,4], counted anew for outfits that are active, whose pairs have been found."""
        return torch.where(
            active[self._outfit.long()][:, None], self._figures(points, self._contacts.normal, lag), figures
        )

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
