"""What users brought to a batch, and the way from what is simulated to their vertices; see `objects/simulated.py`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedBodies

from .bodies import MovingBodies


class Brought:
    """Garments as they were brought, and what is simulated of them.

    Args:
        garments: In the order of the batch.
        known: Positions in the frames that a simulation begins with [m], packed, float32 [K,U,3]; None: at rest.

    Attributes:
        garments: As they were brought.
        given: Known frames of each garment, as they were brought, [K,U,3].
        simulated: What is simulated of each garment.
        known: Known frames of what is simulated, packed, float32 [K,V,3].
        rides: Whether there are vertices that are carried by simulated ones.
    """

    def __init__(self, garments: Sequence[Garment], known: np.ndarray | None = None) -> None:
        self.garments = list(garments)
        if known is None:
            known = np.concatenate([garment.vertices for garment in garments])[None]
        starts = np.cumsum([len(garment.vertices) for garment in garments])[:-1]
        self.given = np.split(known, starts, axis=1)
        self._ways = [g.simulated.from_frame(given[-1]) for g, given in zip(garments, self.given, strict=True)]
        self.simulated = [way.garment for way in self._ways]
        self.known = np.concatenate([w.reduced(g) for w, g in zip(self._ways, self.given, strict=True)], axis=1)
        self.rides = any(len(way.riders) for way in self._ways)
        self._bodies: MovingBodies | None = None

    def restored(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Simulated positions of each garment [V,3] -> those of all its vertices [U,3], as copies."""
        return [np.array(way.restored(part)) for way, part in zip(self._ways, parts, strict=True)]

    def reduced(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Positions of all vertices of each garment [U,3] -> those of what is simulated, packed, float32 [V,3]."""
        return np.concatenate([way.reduced(part[None])[0] for way, part in zip(self._ways, parts, strict=True)])

    def depth(self, parts: Sequence[np.ndarray], body: torch.Tensor, bodies: PackedBodies) -> np.ndarray:
        """How deep vertices that are carried are in their bodies [m], at least 0, float64 [B]; not their faces.

        Args:
            parts: Positions of all vertices of each garment [U,3].
            body: Packed positions of the bodies [m], on the host.
            bodies: Their topology, on any device.
        """
        if self._bodies is None:
            host = dataclasses.replace(bodies, faces=bodies.faces.cpu(), body_of_garment=bodies.body_of_garment.cpu())
            self._bodies = MovingBodies(body, host)
        riding = [part[way.riders] for way, part in zip(self._ways, parts, strict=True)]
        counts = [len(points) for points in riding]
        points = torch.from_numpy(np.concatenate(riding))
        on = torch.repeat_interleave(bodies.body_of_garment.cpu(), torch.tensor(counts))
        distance = np.nan_to_num(self._bodies.at(body).query(points, on).distance.numpy(), nan=0.0)
        return np.array([max(0.0, -d.min(initial=0.0)) for d in np.split(distance, np.cumsum(counts)[:-1])])
