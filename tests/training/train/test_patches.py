"""Training of networks of patches: on subsets of faces, then on whole garments of several sizes in one batch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from support import sequences as synthetic_sequences
from support.runs import config_for, losses_of

from warpgarment.nn import checkpoint
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.nn.parametrisation import NetworkOutput
from warpgarment.nn.patches.layout import garment_patches, patch_layout
from warpgarment.nn.patches.network import PatchTransformer
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.samples import interactions
from warpgarment.training.samples.augmentation import Augmentation
from warpgarment.training.samples.noise import NoiseConfig
from warpgarment.training.samples.pushforward import Pool
from warpgarment.training.samples.recorded import SequenceData
from warpgarment.training.samples.single_step import SampleBuilder
from warpgarment.training.train import start as train
from warpgarment.training.train.losses import LossConfig, loss
from warpgarment.training.train.unrolled_objective import UnrollConfig

SHAPE = (
    "embedding=16", "layers=1", "feed_forward=16", "heads=2", "geodesic_radius=0.2", "face_embedding=16",
    "face_feed_forward=16", "patch_spacing=0.15",
)  # fmt: skip
FAST = train.TrainConfig(Path(), Path(), network="fast", overrides=SHAPE, steps=1).network_config()
QUIET = NoiseConfig(position=0.0, offset=0.0)
PLAIN = Augmentation(mirror=0.0, yaw=0.0)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    root = synthetic_sequences.write_set(tmp_path_factory.mktemp("set") / "sequences", train=2, frames=16)
    synthetic_sequences.write(root, "train_9", "train", seed=9, frames=16, around=14, rings=7)
    return root


@pytest.fixture(scope="module")
def loaded(data) -> list[SequenceData]:
    cache = interactions.default_cache(data)
    return [
        SequenceData(Sequence.load(data / name), data / name, cache, FAST, torch.device("cpu"))
        for name in ("train_0", "train_9")
    ]


def test_whole_garments_of_two_sizes(loaded):
    """A batch of whole garments would hold other numbers than its garments alone, or the wrong patches.

    Bit for bit; but for the heading's turn, which is one product for all: 1e-5.
    """
    builder = SampleBuilder(loaded, FAST, QUIET, PLAIN)
    picks, sizes = [(0, 3), (1, 12)], [len(s.faces) for s in loaded]
    assert sizes[0] != sizes[1]
    batch = builder.build(picks, None, np.random.default_rng(0))
    assert batch.face_mask is not None
    assert batch.face_mask.sum(dim=1).tolist() == sizes
    assert batch.faces.item() == sum(sizes)
    assert torch.isfinite(batch.features).all()
    for b, (pick, count) in enumerate(zip(picks, sizes, strict=True)):
        alone = builder.build([pick], count, np.random.default_rng(0))
        torch.testing.assert_close(batch.features[b, :count], alone.features[0], atol=1e-5, rtol=0)
        for both, one in zip(batch.target[:2], alone.target[:2], strict=True):
            torch.testing.assert_close(both[b, :count], one[0], atol=1e-5, rtol=0)
        garment = loaded[b].source.garment
        mine = patch_layout([garment_patches(garment, FAST.patch_spacing)], FAST.geodesic_radius, FAST.geodesic_power)
        assert torch.equal(batch.weights.patch[b, :count], mine.patch[0])
        patches = mine.weights.shape[1]
        torch.testing.assert_close(batch.weights.weights[b, :patches, :patches], mine.weights[0], atol=1e-6, rtol=0)
        torch.testing.assert_close(batch.weights.share[b, :count], mine.share[0], atol=1e-6, rtol=0)


def test_padding_costs_nothing(loaded):
    """Padded faces would count in the loss, or real ones not all count alike; 1e-6 for float32 sums."""
    network = PatchTransformer(FAST)
    batch = SampleBuilder(loaded, FAST, QUIET, PLAIN).build([(0, 3), (1, 12)], None, np.random.default_rng(0))
    normalised = network.normalise_targets(NetworkOutput(*batch.target))
    predicted = normalised._replace(psi=normalised.psi + 1.0, singular_values=normalised.singular_values - 0.5)
    predicted.psi[~batch.face_mask], predicted.singular_values[~batch.face_mask] = 1e6, 1e6
    found = loss(predicted, normalised, network, LossConfig(), None, batch.components, batch.face_mask, batch.faces)
    np.testing.assert_allclose([v.item() for v in found], [9.0 + 1.5, 9.0, 1.5, 0.0], rtol=1e-5)


def test_pool_fits_whole_garments():
    """A pool's rollout of a large garment would pad a batch of small ones, or small ones never be used."""
    pool = Pool()
    pool.rollouts = [(s, 10, np.zeros((1, 4, 3), np.float32)) for s in range(3)]
    assert pool.fitting(np.array([100, 200, 300]), 200) == [(1, 0), (2, 0)]
    assert pool.fitting(np.array([100, 200, 300]), 200, whole=True) == [(0, 0), (1, 0)]


def test_run_goes_from_subsets_to_whole_garments(data, tmp_path, monkeypatch):
    """The loss would jump or end in NaN where garments are no longer split, neighbours never be heard, or a resumed run
    go on with other samples. Bit for bit on the CPU.
    """
    shown = []
    build = SampleBuilder.build

    def noted(self, picks, faces, *rest):
        shown.append(faces)
        return build(self, picks, faces, *rest)

    monkeypatch.setattr(SampleBuilder, "build", noted)
    settings = {"network": "fast", "overrides": SHAPE, "splits": 2, "split_share": 0.5}
    path = train.train(config_for(data, tmp_path / "whole", **settings))
    assert shown.count(None) == 6
    losses = losses_of(tmp_path / "whole")
    assert all(np.isfinite(list(losses.values())))
    assert max(losses[s] for s in (7, 8)) < 2.0 * max(losses[s] for s in (5, 6))
    network = checkpoint.load(path)
    assert type(network) is PatchTransformer
    final = checkpoint.load(tmp_path / "whole" / "network.safetensors")
    assert all(layer.hear.weight.any() for layer in final.after)
    with monkeypatch.context() as patch:
        over = train.Run.over
        patch.setattr(train.Run, "over", lambda run: over(run) or run.step >= 8)
        train.train(config_for(data, tmp_path / "parts", **settings))
    train.train(config_for(data, tmp_path / "parts", **settings, resume=True))
    assert losses_of(tmp_path / "parts") == losses


def test_unrolled_run_of_whole_garments(data, tmp_path):
    """A run would fail where the schedule no longer splits garments; of patches, it shows all of each at once."""
    settings = {"network": "fast", "overrides": SHAPE, "splits": 2, "split_share": 0.5, "steps": 4, "batch_size": 2}
    train.train(config_for(data, tmp_path, **settings, unroll=UnrollConfig(steps=2, position=1.0)))
    losses = losses_of(tmp_path)
    assert sorted(losses) == [1, 2, 3, 4]
    assert all(np.isfinite(list(losses.values())))


def test_run_starts_from_a_network_of_faces(data, tmp_path):
    """`init` would be ignored, or train the network of faces it names instead of one of patches.

    With a rate of nothing, what is saved is what it started from.
    """
    faces = ManifoldAwareTransformer(NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2))
    torch.nn.init.normal_(faces.velocity_head.weight)
    faces.save(tmp_path / "faces.safetensors")
    settings = {"network": "fast", "overrides": SHAPE, "init": tmp_path / "faces.safetensors", "lr": 0.0, "steps": 1}
    path = train.train(config_for(data, tmp_path / "run", **settings))
    found = checkpoint.load(path)
    assert type(found) is PatchTransformer
    weights = found.state_dict()
    for name, value in faces.state_dict().items():
        assert torch.equal(weights[name.replace("final_norm", "face_norm")], value), name
    assert torch.equal(weights["from_patches.weight"], torch.eye(16))
    assert not any(layer.contract.weight.any() for layer in (found.before, *found.after))


def test_named_network():
    """`--network fast` would train another network than the one described.

    Faces of width F = 128, G = 128: an embedding of 341 F = 43,648; layers of 2 F norms, 2 F G + G + F = 33,024, two of
    which also hear, F G = 16,384; a norm of 256 and a head of 129 * 12 = 1,548. Patches of width E = 128: four layers
    of 116,032 (see test_network), a norm of 256, 28 E = 3,584, to and from the faces 2 * 129 E = 33,024, the mean E^2 =
    16,384, and the head 129 * 3 = 387.
    """
    config = train.TrainConfig(Path(), Path(), network="fast", overrides=(), steps=1).network_config()
    assert config == NetworkConfig.fast()
    faces = 43_648 + 3 * (256 + 33_024) + 2 * 16_384 + 256 + 1_548
    assert PatchTransformer(config).parameter_count() == faces + 4 * 116_032 + 256 + 3_584 + 33_024 + 16_384 + 387
