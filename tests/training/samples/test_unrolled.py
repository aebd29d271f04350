"""Samples of unrolled training: what a builder keeps between batches, and the bodies it poses."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support import sequences as synthetic_sequences

from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.samples import interactions
from warpgarment.training.samples.augmentation import Augmentation
from warpgarment.training.samples.noise import NoiseConfig
from warpgarment.training.samples.recorded import SequenceData
from warpgarment.training.samples.scenes import Scenes
from warpgarment.training.samples.unrolled import UnrolledBuilder
from warpgarment.training.train.losses import LossConfig
from warpgarment.training.train.unrolled_objective import UnrollConfig, UnrolledObjective

SMALL = NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2, dropout=0.0, geodesic_radius=0.2)
T = 11  # newest frame of the samples


@pytest.fixture(scope="module")
def loaded(tmp_path_factory) -> list[SequenceData]:
    root = tmp_path_factory.mktemp("set") / "sequences"
    synthetic_sequences.write(root, "train_0", seed=0, frames=14, pins=4)
    synthetic_sequences.write(root, "train_1", seed=1, frames=14, rings=5)
    cache = interactions.default_cache(root)
    return [SequenceData(Sequence.load(f), f, cache, SMALL, torch.device("cpu")) for f in sorted(root.glob("train_*"))]


def network_of() -> ManifoldAwareTransformer:
    """A network that does more than to move cloth as skin."""
    torch.manual_seed(0)
    network = ManifoldAwareTransformer(SMALL)
    for head in (network.face_head, network.velocity_head):
        torch.nn.init.normal_(head.weight, std=0.1)
    return network


def test_a_builder_gives_the_same_batch_again(loaded):
    """Set-up that was kept from an earlier batch is that of another garment or body: losses and gradients differ."""
    network = network_of()
    quiet, plain = NoiseConfig(position=0.0, offset=0.0), Augmentation(mirror=0.0, yaw=0.0)
    objective = UnrolledObjective(network, LossConfig(), 0.0, "float32", UnrollConfig(steps=2))

    def trained(builder: UnrolledBuilder, picks: list[tuple[int, int]]) -> list[torch.Tensor]:
        losses = objective(builder.build(picks, None, np.random.default_rng(0)))
        return [losses, *torch.autograd.grad(losses[0], list(network.parameters()))]

    builder = UnrolledBuilder(loaded, network, quiet, plain, 2, 1)
    for picks in ([(0, T), (1, T)], [(1, T), (0, T)], [(0, T), (1, T)], [(1, T)]):
        new = UnrolledBuilder(loaded, network, quiet, plain, 2, 1)
        for one, other in zip(trained(builder, picks), trained(new, picks), strict=True):
            assert torch.equal(one, other)
    assert len(builder._kept) > len(new._kept) > 0, "there was something to keep"
    assert len(builder._scenes) == 2, "a scene came again"


def test_a_scene_is_not_taken_from_a_batch_that_lives(loaded):
    """Two batches would share bodies and pins, so that the first one is changed by the second."""
    network, store = network_of(), Scenes(most=2)
    builder = UnrolledBuilder(loaded, network, NoiseConfig(), Augmentation(), 2, 1)
    one = builder.build([(0, T)], None, np.random.default_rng(0))
    other = builder.build([(0, 3)], None, np.random.default_rng(0))
    assert one.scene is not other.scene
    kept = one.scene
    del one
    assert builder.build([(0, 5)], None, np.random.default_rng(0)).scene is kept
    for key in "abc":
        store.keep(key, kept, np.zeros(1))
    assert len(store) == 2
    assert store.take("a") is None
    assert store.take("c") is kept
    assert store.take("c") is None


def test_bodies_of_samples_are_those_of_the_sequence(loaded):
    """A body is posed with the bones of other vertices, or in another frame."""
    for data in loaded:
        whole = data.source.body()
        vertices, faces = data.body_frames([3, 0, T])
        np.testing.assert_array_equal(vertices, whole.vertices[[3, 0, T]])
        np.testing.assert_array_equal(faces, whole.faces)
