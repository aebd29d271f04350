"""If these failed, predictions would be measured against the recording of other moments."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tests.support import sequences
from tests.support.outfits import layersnet
from tests.support.scenes import network, simulator, skirt, walk
from warpgarment.errors import MeshError
from warpgarment.objects.body import BodyMotion
from warpgarment.training.data.sequence import Sequence
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


@pytest.mark.parametrize("cold", [True, False])
def test_garments_of_an_outfit_are_entries_of_their_own(tmp_path, cold):
    """A network of faces would see an outfit as one mesh in the tables of outfits, or garments in another order: each
    garment rolled out by itself gives the same to 1e-6 m; with contact between garments something else."""
    sequence = Sequence.load(sequences.write_worn(tmp_path, "one", frames=9, wide=1.04))
    made, body = simulator(network()), sequence.body()
    together = predict(made, sequence, 3, 4, cold=cold, layers=False)
    first = 3 if cold else 1
    part = BodyMotion(body.vertices[first:8], body.faces, body.fps)
    for garment, layer in zip(sequence.worn, sequence.layers, strict=True):
        known = np.array(sequence.vertices[first:4, layer.vertices])
        start = {"first_vertices": known[0]} if cold else {"history": known}
        alone = made.rollout(garment, part, **start).vertices[-4:]
        np.testing.assert_allclose(together[:, layer.vertices], alone, atol=1e-6)
    kept = predict(made, sequence, 3, 4, cold=cold, layers=True)
    assert np.isfinite(kept).all()
    assert abs(kept - together).max() > 1e-4


def test_garments_apart_do_not_see_each_other(tmp_path):
    """The row with garments apart would be the LayersNet with layers under another name: each garment alone, with its
    material and the wind, gives the same to 1e-5 m (2e-6 were seen in float32: other batches); together they move
    otherwise."""
    sequence = Sequence.load(sequences.write_worn(tmp_path, "one", frames=6, wide=1.1))
    made, body = simulator(layersnet(patch_radius=0.3)), sequence.body()
    apart = predict(made, sequence, 2, 3, apart=True)
    for k, (garment, layer) in enumerate(zip(sequence.worn, sequence.layers, strict=True)):
        known, own = np.array(sequence.vertices[:3, layer.vertices]), [sequence.materials[k]]
        alone = made.rollout([garment], body, history=[known], materials=own, wind=sequence.wind)[0].vertices
        np.testing.assert_allclose(apart[:, layer.vertices], alone[3:], atol=1e-5)
    assert abs(predict(made, sequence, 2, 3) - apart).max() > 1e-4
