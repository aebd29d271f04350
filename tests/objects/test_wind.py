"""Wind as users give it: velocities at the network's rate, and silly values told by name."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import torch

from warpgarment.errors import UsageError
from warpgarment.objects.wind import Wind


def test_a_direction_of_any_length_and_a_speed():
    """The length of the direction would count as speed. Rounding of float32, 1e-6 m/s."""
    for direction in ([3, 0, 4], [0.3, 0, 0.4], torch.tensor([30.0, 0, 40.0])):
        np.testing.assert_allclose(Wind(direction, 5).velocities(30.0), [[3, 0, 4]], atol=1e-6)
    turned = Wind([[0, 0, 2], [1, 0, 0]], 3.0).velocities(30.0)
    np.testing.assert_allclose(turned, [[0, 0, 3], [3, 0, 0]], atol=1e-6)
    assert turned.dtype == np.float32
    assert not Wind([1, 0, 0], [0, 0]).velocities(30.0).any()
    assert not Wind([0, 0, 0], 0).velocities(30.0).any()  # still air goes nowhere
    np.testing.assert_allclose(Wind.of_velocities([[3, 0, 4], [0, 0, 0]]).rows, [[3, 0, 4], [0, 0, 0]], atol=1e-12)


def test_rows_at_another_rate():
    """Gusts would come too soon or too late: by NumPy's own interpolation at the times of the frames, 1e-6 m/s; the end
    of the last row is not left out."""
    speeds = [0.0, 4.0, 2.0, 8.0]
    for fps in (10.0, 24.0, 60.0):
        found = Wind([0, 0, 1], speeds, fps=fps).velocities(30.0)
        times = np.arange(len(found)) / 30.0
        assert times[-1] >= 3 / fps - 1e-9 > times[-1] - 1 / 30.0
        np.testing.assert_allclose(found[:, 2], np.interp(times, np.arange(4) / fps, speeds), atol=1e-6)
        assert not found[:, :2].any()
    np.testing.assert_array_equal(Wind([0, 0, 1], speeds).velocities(30.0)[:, 2], np.float32(speeds))
    np.testing.assert_array_equal(Wind([0, 0, 1], speeds, fps=30).velocities(30.0)[:, 2], np.float32(speeds))
    assert len(Wind([0, 0, 1], 2.0, fps=24).velocities(30.0)) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 0, np.nan], 1), "direction holds NaN or infinity"),
        (([0, 0, 1], [1, np.inf]), r"speed holds NaN or infinity \(first: row 1\)"),
        (([0, 0, 0], 2), "direction has no length.*or speed 0 for still air"),
        (([[1, 0, 0], [0, 0, 0]], 2), r"no length \(first: row 1\)"),
        (([0, 0, 1], -2), "must not be negative, got -2 m/s. Turn its direction round"),
        (([0, 0, 1], 1000), "wind of 1,000 m/s; it must be at most 100 m/s. Check its unit"),
        (([0, 1], 1), r"shape \[3\] or \[T,3\], got \[2\]"),
        (([0, 0, 1], [[1.0]]), r"shape \[T\], got \[1, 1\]"),
        (([0, 0, 1], []), r"got \[0\]"),
        (([[0, 0, 1]] * 2, [1, 2, 3]), "2 directions and 3 speeds"),
        (("north", 2), "direction must be numbers, got 'north'"),
    ],
)
def test_silly_winds_are_refused(arguments, message):
    """Wind that no air has would reach the network, or an error of NumPy's the user."""
    with pytest.raises(UsageError, match=message):
        Wind(*arguments)


@pytest.mark.parametrize("fps", [0, -24, np.nan, np.inf])
def test_rates_that_are_none_are_refused(fps):
    """A rate of 0 would be an endless wind."""
    with pytest.raises(UsageError, match="positive number of rows a second"):
        Wind([0, 0, 1], [1, 2], fps=fps)


def test_a_rate_far_too_low_is_refused():
    """Memory would be filled by one gust."""
    with pytest.raises(UsageError, match="Check fps"):
        Wind([0, 0, 1], [1, 2], fps=1e-9).velocities(30.0)


def test_it_is_not_changed():
    """Someone who changes a wind in a rollout would change another rollout."""
    given = np.array([0.0, 0.0, 1.0])
    wind = Wind(given, 2.0)
    given[:] = 0.0
    assert wind.rows.tolist() == [[0, 0, 2]]
    with pytest.raises(FrozenInstanceError):
        wind.fps = 3
    with pytest.raises(ValueError, match="read-only"):
        wind.rows[0] = 1
    for same in (copy.copy(wind), pickle.loads(pickle.dumps(wind))):
        assert same.rows.tolist() == [[0, 0, 2]]
