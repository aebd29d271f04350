"""Float64 NumPy twin of kernels/neighbours.py, by all distances."""

from __future__ import annotations

import numpy as np


def nearest_points(points, group, targets, target_group, radius, count, skip=None):
    """Indices of the nearest targets of each point's own group within the radius, [N, count], padded with -1."""
    points, targets = np.asarray(points, np.float64), np.asarray(targets, np.float64)
    found = np.full((len(points), count), -1)
    for i, point in enumerate(points):
        distance = np.linalg.norm(targets - point, axis=1)
        allowed = (np.asarray(target_group) == group[i]) & (distance <= radius)
        if skip is not None:
            allowed[[j for j in skip[i] if j >= 0]] = False
        index = np.flatnonzero(allowed)
        index = index[np.lexsort((index, distance[index]))][:count]
        found[i, : len(index)] = index
    return found
