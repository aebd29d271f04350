"""Procedural motions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bodies import rest_body

from warpgarment.bodies import skeleton
from warpgarment.training.motions.procedural import KINDS, procedural


@pytest.mark.parametrize("kind", KINDS)
def test_procedural_motions_are_rotations_and_smooth(kind):
    """If this fails, a formula tears the body: no rotation matrices, or jumps between frames."""
    body = rest_body()
    poses = procedural(body, kind, 90, seed=3)
    identity = poses.rotations @ poses.rotations.transpose(0, 1, 3, 2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-9)
    step = Rotation.from_matrix((poses.rotations[1:] @ poses.rotations[:-1].transpose(0, 1, 3, 2)).reshape(-1, 3, 3))
    assert np.degrees(step.magnitude()).max() < 35.0  # a run's shin swings at about 900 degrees a second
    assert np.abs(np.diff(poses.root, axis=0)).max() < 0.2
    again = procedural(body, kind, 90, seed=3)
    np.testing.assert_array_equal(poses.rotations, again.rotations)


@pytest.mark.parametrize("kind", KINDS)
def test_procedural_feet_stay_on_the_floor(kind):
    """If this fails, bodies float or wade: skirts and trousers then move as on nobody."""
    body = rest_body()
    frames, _ = skeleton.posed(body, procedural(body, kind, 90, seed=4))
    lowest = frames[:, :, 1].min(1)
    assert lowest.min() > -0.03
    airborne = {"run": 0.09, "jump": 0.35}.get(kind, 0.03)  # heights of the flights, and smoothing by 50 ms
    assert lowest.max() < airborne
    assert np.median(lowest) < 0.05
