"""Samples of outfits: their frames, in a mirror, and statistics."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.outfits import MATERIAL, batch_of, builder_of, network_of, recorded

from warpgarment.training.data.sequence import Sequence
from warpgarment.training.samples import outfits
from warpgarment.training.samples.statistics import position_statistics


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Recorded outfits."""
    return recorded(tmp_path_factory.mktemp("layers"))


def test_frames_of_a_batch(data):
    """A sample would hold other frames, garments, materials or wind than its sequence. Exact."""
    batch, network = batch_of(data, network_of(), ((0, 5), (1, 1)), ahead=2, steps=2), network_of()
    assert batch.ahead == 2
    parts = [Sequence.load(data / name) for name in "ab"]
    count = len(parts[0].garment.vertices)
    assert batch.packed.vertex_offsets == (0, count // 2, count, 3 * count // 2, 2 * count)
    for k, (sequence, newest) in enumerate(zip(parts, (5, 1), strict=True)):
        for i in range(7):
            frame = max(newest - 4 + i, 0)  # a cold start repeats the first one
            mine = batch.frames[i, k * count : (k + 1) * count]
            np.testing.assert_array_equal(mine.numpy(), np.asarray(sequence.vertices[frame]))
            body = batch.body[i].chunk(2)[k]
            np.testing.assert_array_equal(body.numpy(), sequence.body().vertices[frame].astype(np.float32))
            np.testing.assert_array_equal(batch.wind[i, 2 * k : 2 * k + 2].numpy(), [sequence.wind[frame]] * 2)
    assert batch.materials[0].tolist() == pytest.approx(list(MATERIAL.as_dict().values()))
    assert batch.materials[1].isnan().all()
    inputs = batch.inputs(batch.recorded(4), 4, network.reads)
    assert torch.equal(inputs.vertices, batch.frames[4])
    assert torch.equal(inputs.previous, batch.frames[[3, 2]])
    assert torch.equal(inputs.next_body, batch.body[5])
    assert torch.equal(inputs.previous_body, batch.body[[3, 2]])
    assert torch.equal(inputs.wind, batch.wind[[5, 4]])
    assert inputs.bodies.body_of_garment.tolist() == [0, 0, 1, 1]


def test_mirrored_samples(data, monkeypatch):
    """A mirrored sample would not be what a mirror shows. Its frames are exact; a network that ignores sides moves it
    as the mirror of the sample, to 1e-5 m, and the body's volume does not change sign, to 1e-5 m^3."""
    monkeypatch.setattr(outfits, "FROM_FIRST", 1.0)  # both are bound in the first frame
    network = network_of(residual=True)  # untrained: cloth moves on about its body
    plain = batch_of(data, network, ahead=1)
    builder = builder_of(data, network, ahead=1)
    builder.mirror = 1.0
    shown = builder.build([(0, 5), (1, 9)], None, np.random.default_rng(0))
    flip = torch.tensor([-1.0, 1.0, 1.0])
    assert torch.equal(shown.frames, plain.frames * flip)
    assert torch.equal(shown.body, plain.body * flip)
    assert torch.equal(shown.wind, plain.wind * flip)
    volumes = []
    for batch in (plain, shown):
        corners = batch.body[0][batch.bodies.faces.long()]
        volumes.append(torch.linalg.det(corners).sum())
    assert volumes[0] > 0.01
    assert abs(volumes[0] - volumes[1]) < 1e-5
    found = []
    for batch in (plain, shown):
        with torch.no_grad():
            inputs = batch.inputs(batch.recorded(3), 3, network.reads)
            found.append(network.predict(inputs, batch.layout).positions)
    assert (found[0] - plain.frames[3]).abs().max() > 1e-4
    assert (found[1] - found[0] * flip).abs().max() < 1e-5


def test_statistics(data):
    """Inputs or outputs of the network would not have zero mean and unit variance. 1e-3."""
    network = network_of()
    batches = [batch_of(data, network, picks) for picks in (((0, 5), (1, 9)), ((0, 8), (1, 3)))]
    found = position_statistics(batches, network)
    network.set_statistics(found)
    seen = [network.observed(b.inputs(b.recorded(2), 2, network.reads), b.layout, b.frames[3]) for b in batches]
    for name in ("state", "acceleration"):
        values = torch.cat([s[name] for s in seen])
        scaled = (values - found[f"{name}_mean"]) / found[f"{name}_std"]
        assert scaled.mean(dim=0).abs().max() < 1e-3
        assert (scaled.std(dim=0) - 1).abs().max() < 1e-3 or (found[f"{name}_std"] <= 1.1e-3).any()


def test_histories_towards_skin(data):
    """A history would not lie between the recorded one and the skin, or a target not come back by a fifth in a frame.
    1e-6 m; shares to 1e-4."""
    network = network_of()
    builder = builder_of(data, network, ahead=1)
    builder.to_skin, shares = 1.0, []
    for seed in range(4):
        batch = builder.build([(0, 5), (1, 9)], None, np.random.default_rng(seed))
        for sample in range(2):
            mine, found = batch.sample_of_vertex == sample, []
            for k in range(3):
                away = (batch.skin(batch.body[3 - k])[1] - batch.frames[3 - k])[mine]
                share = (batch.delta[k][mine] * away).sum() / away.square().sum()
                assert (batch.delta[k][mine] - share * away).abs().max() < 1e-6
                found.append(float(share))
            assert away.abs().max() > 2e-3
            shares.append(found)
        steps = torch.full((len(batch.frames[0]),), 2)
        assert (batch.wanted(4, steps) - batch.frames[4] - 0.64 * batch.delta[0]).abs().max() < 1e-6
    shares = np.array(shares)
    assert ((shares[:, 0] > 0.0) & (shares[:, 0] < 1.0)).all()
    ratio = shares[:, 1:] / shares[:, :1]
    at_rest = np.abs(ratio - 1.0).max(axis=1) < 1e-4
    returning = np.abs(ratio - [1 / 0.8, 1 / 0.64]).max(axis=1) < 1e-4
    assert (at_rest | returning).all()
    assert at_rest.any()
    assert returning.any()
    plain = batch_of(data, network, ahead=1)
    assert torch.equal(plain.wanted(4, steps), plain.frames[4])
