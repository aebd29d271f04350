"""Comparing results of networks."""

from __future__ import annotations

import numpy as np
import torch


def close(result: torch.Tensor, expected, tolerance: float) -> None:
    """Asserts that every number is finite and within a tolerance of the expected one; NaN never is."""
    expected = torch.as_tensor(np.asarray(expected), dtype=torch.float64)
    assert result.shape == expected.shape
    assert torch.isfinite(result).all()
    assert (result.double() - expected).abs().max().item() <= tolerance
