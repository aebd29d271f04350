"""Joins vertices that a format repeats, for every face (STL) or at texture seams (glTF)."""

from __future__ import annotations

import numpy as np


def join_exact(places: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joins vertices at exactly the same place, keeping the order of first appearance.

    Args:
        places: Positions, or several of them side by side, [V,C].
        faces: Vertex indices, [F,3].

    Returns:
        Vertices that stay, and faces [F,3] that are counted among these.
    """
    first, inverse = np.unique(places, axis=0, return_index=True, return_inverse=True)[1:]
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[inverse.reshape(-1)][faces]
