"""Summaries of solves beside NumPy."""

import numpy as np
import pytest
import torch

from warpgarment.kernels.linear.progress import Progress


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("before", [None, (10.0, 2.0, 0.5)])
def test_summary(before):
    """Solves that stopped at their limit would not be told of. Exact: two solves of seven components, and one of none;
    an error counts only where the solve was stopped."""
    rng, progress = np.random.default_rng(0), Progress("solver")
    expected = np.zeros(3) if before is None else np.array(before)
    for number in range(3):
        report = rng.integers(-20, 20, 7 if number else 0).astype(np.int32)
        error = rng.uniform(size=len(report))
        progress.record(torch.from_numpy(report), torch.from_numpy(error), 20, add=number > 0)
        expected[0] += np.abs(report).max(initial=0)
        expected[1] += (report < 0).sum()
        expected[2] = max(expected[2], error[report < 0].max(initial=0.0))
    given = None if before is None else torch.tensor(before, dtype=torch.float64)
    np.testing.assert_array_equal(progress.summary(given), expected)
