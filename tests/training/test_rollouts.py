"""If these failed, predictions would be measured against the recording of other moments."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.scenes import network, simulator, skirt, walk
from warpgarment.errors import MeshError
from warpgarment.training.rollouts import check_rate, predict


def test_recordings_at_another_rate_than_the_network_are_refused():
    """Frame k of a recording at 24 a second would be compared with frame k of a prediction at 30."""
    garment = skirt()
    for fps in (24.0, 60.0):
        motion = walk(6, fps)
        recorded = SimpleNamespace(garment=garment, vertices=np.stack([garment.vertices] * 6), body=lambda m=motion: m)
        with pytest.raises(MeshError, match=f"the recording runs at {fps:g} frames a second and the network at 30"):
            predict(simulator(network()), recorded, 0, 3, cold=True)
    check_rate(30.0, 30.0)
    recorded.body = lambda: walk(6)
    assert predict(simulator(network()), recorded, 0, 3, cold=True).shape == (3, len(garment.vertices), 3)
