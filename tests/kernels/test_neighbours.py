"""Nearest points within a radius against all distances in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference import neighbours as reference
from support.poison import poison_outputs

from warpgarment.kernels.neighbours import NearestPoints

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN, or as a senseless integer."""
    return poison_outputs(monkeypatch)


def clouds(seed: int, points: int = 60, targets: int = 300, groups: int = 3, size: float = 0.5):
    """Points and targets in a box [m], with groups that lie at the same place."""
    rng = np.random.default_rng(seed)
    where = [rng.uniform(-size, size, (n, 3)).astype(np.float32) for n in (points, targets)]
    owner = [rng.integers(0, groups, n).astype(np.int32) for n in (points, targets)]
    return where[0], owner[0], where[1], owner[1]


def found(arrays, search=None, **options) -> np.ndarray:
    """The search, with arrays in and out."""
    search = search or NearestPoints(CPU)
    if options.get("skip") is not None:
        options["skip"] = torch.as_tensor(options["skip"])
    return search(*map(torch.as_tensor, arrays), **options).numpy()


@pytest.mark.parametrize("count", [1, 4, 16])
@pytest.mark.parametrize("radius", [0.05, 0.2, 2.0])
def test_agrees_with_all_distances(radius, count):
    """A patch would see points that are far, of another outfit, or not the nearest ones. Exact: no ties in these."""
    arrays = clouds(0)
    np.testing.assert_array_equal(
        found(arrays, radius=radius, count=count), reference.nearest_points(*arrays, radius, count)
    )


def test_far_from_the_origin_and_again():
    """A grid would depend on where it was built before, or lose cells where it repeats itself."""
    search = NearestPoints(CPU)
    for seed, shift in enumerate((0.0, 40.0, -7.0)):
        arrays = clouds(seed, size=2.0)
        arrays = (arrays[0] + np.float32(shift), arrays[1], arrays[2] + np.float32(shift), arrays[3])
        expected = reference.nearest_points(*arrays, 0.4, 5)
        np.testing.assert_array_equal(found(arrays, search, radius=0.4, count=5), expected)


def test_some_are_left_out():
    """World edges would repeat mesh edges, or leaving one out would cost the place of another."""
    points, group, targets, owner = clouds(3)
    skip = np.random.default_rng(1).integers(-1, len(targets), (len(points), 40)).astype(np.int32)
    arrays = (points, group, targets, owner)
    expected = reference.nearest_points(*arrays, 0.3, 6, skip)
    assert (expected != reference.nearest_points(*arrays, 0.3, 6)).any()
    np.testing.assert_array_equal(found(arrays, radius=0.3, count=6, skip=skip), expected)


def test_equally_near_ones():
    """Which of several points at one distance is found would depend on the grid."""
    targets = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1]], np.float32)
    arrays = (np.zeros((1, 3), np.float32), np.zeros(1, np.int32), targets, np.zeros(4, np.int32))
    np.testing.assert_array_equal(found(arrays, radius=1.5, count=3), [[0, 1, 2]])
    np.testing.assert_array_equal(found(arrays, radius=1.0, count=5), [[0, 1, 2, 3, -1]])  # the radius itself is near


def test_nothing_is_near():
    """An empty cloud, a cloud of another group, or a point that is not finite would end in memory of something else."""
    points, group, targets, owner = clouds(4)
    points[0] = np.nan
    alone = (points, group, targets, owner + 10)
    assert (found(alone, radius=1.0, count=3) == -1).all()
    assert (found((points, group, targets[:0], owner[:0]), radius=1.0, count=3) == -1).all()
    assert (found((points, group, targets, owner), radius=1.0, count=3)[0] == -1).all()
    with pytest.raises(ValueError, match="radius must be positive"):
        found((points, group, targets, owner), radius=0.0, count=3)
