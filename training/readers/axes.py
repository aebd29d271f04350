"""Conversion between axes with Y up and with Z up."""

from __future__ import annotations

import numpy as np


def y_up(vectors: np.ndarray) -> np.ndarray:
    """Z-up vectors [..., 3] with Y up: (x, y, z) -> (x, z, -y)."""
    return np.stack([vectors[..., 0], vectors[..., 2], -vectors[..., 1]], axis=-1)


def z_up(vectors: np.ndarray) -> np.ndarray:
    """Y-up vectors [..., 3] with Z up: (x, y, z) -> (x, -z, y)."""
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], axis=-1)
