"""Distance at which a garment's vertices are kept from the body."""

from __future__ import annotations

import numpy as np

from .garment import Garment

CLOSEST = 0.004  # least distance between a vertex and the body [m]
CLEARANCE_PER_EDGE = 0.2  # least distance as a share of the mean edge length


def clearance(garment: Garment) -> float:
    """Distance that vertices keep from the body [m]: 4 mm, or a fifth of the mean edge length if that is more.

    A round body comes nearer between the vertices of a coarse garment; see also `sim.surface`.
    """
    i, j = garment.edges.T
    edge = float(np.linalg.norm(garment.vertices[i] - garment.vertices[j], axis=1).mean())
    return max(CLOSEST, CLEARANCE_PER_EDGE * edge)
