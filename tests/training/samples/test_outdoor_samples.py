"""Samples of garments of an outfit, with their materials and the wind: what a simulation of them would see."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference.outdoor import outdoor
from support import sequences
from support.runs import config_for, losses_of
from support.sequences import two_layers

from warpgarment.kernels.features.channels import OUTDOOR
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import build_network
from warpgarment.nn.config import NetworkConfig
from warpgarment.objects.material import Material
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.data.worn import WornGarment
from warpgarment.training.distributed import Group
from warpgarment.training.rollouts import predict
from warpgarment.training.samples import interactions
from warpgarment.training.samples.augmentation import Augmentation
from warpgarment.training.samples.noise import NoiseConfig
from warpgarment.training.samples.recorded import SequenceData
from warpgarment.training.samples.single_step import SampleBuilder
from warpgarment.training.samples.statistics import outdoor_statistics, statistics
from warpgarment.training.samples.unrolled import UnrolledBuilder
from warpgarment.training.train.config import TrainConfig
from warpgarment.training.train.losses import LossConfig
from warpgarment.training.train.objective import Objective
from warpgarment.training.train.start import train
from warpgarment.training.train.training_set import load_sequences
from warpgarment.training.train.unrolled_objective import UnrollConfig, UnrolledObjective

CPU = torch.device("cpu")
SMALL = NetworkConfig.small(
    embedding=16, layers=1, feed_forward=16, heads=2, dropout=0.0, geodesic_radius=0.2, outdoor=OUTDOOR.names
)
PATCHED = NetworkConfig.fast(
    embedding=16, layers=1, feed_forward=16, heads=2, face_embedding=16, face_feed_forward=16, outdoor=OUTDOOR.names
)
QUIET, PLAIN = NoiseConfig(position=0.0, offset=0.0), Augmentation(mirror=0.0, yaw=0.0)
CLOTH = Material(density=0.4, bend=1e-4)
GARMENTS = [
    {"name": "inner", "category": "tube", "material": CLOTH.as_dict()},
    {"name": "outer", "category": "tube", "material": None},
]
T = 11  # newest frame of most samples


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("layers") / "set"
    for number, name in enumerate("ab"):
        extra = {"garments": GARMENTS}
        sequences.write(root, name, "train", seed=number, frames=18, spoil=two_layers, manifest=extra)
    sequences.write(root, "c", "train", seed=5, frames=18)
    return root


def garments_of(data, config=SMALL) -> list[SequenceData]:
    """The garments of the sequence a."""
    cache = interactions.default_cache(data)
    return [SequenceData(Sequence.load(data / "a"), data / "a", cache, config, CPU, k) for k in range(2)]


def network_of(loaded, config):
    """A network with random weights, normalised by the data."""
    torch.manual_seed(0)
    network = build_network(config)
    builder = SampleBuilder(loaded, config, QUIET, PLAIN)
    network.set_statistics(statistics([builder.build([(0, 5), (1, 9)], 60, np.random.default_rng(0))], network))
    network.set_statistics({"psi_std": [0.05] * 9, "singular_value_std": [0.05] * 3, "q_std": [0.003] * 3})
    for head in (network.face_head, network.velocity_head):
        torch.nn.init.normal_(head.weight, std=0.1)
    torch.nn.init.normal_(network.embed_faces.weight, std=0.1)
    return network.eval()


def test_a_garment_of_an_outfit(data):
    """A garment would be trained on in the frames, on the body, with the geodesics or the material of another one, or
    near the body where the other one is. Exact: the same numbers, found for the garment by itself."""
    whole, loaded = Sequence.load(data / "a"), garments_of(data)
    assert [part.name for part in loaded] == ["a/inner", "a/outer"]
    for k, part in enumerate(loaded):
        own = WornGarment(whole, k)
        assert np.array_equal(part.vertices.numpy(), np.array(whole.vertices)[:, whole.layers[k].vertices])
        assert np.array_equal(own.vertices, part.vertices.numpy())
        assert np.array_equal(part.interaction.numpy(), interactions.compute(own))
        assert np.array_equal(part.garment.geodesics, own.garment.geodesics)
        assert np.array_equal(own.layers[0].faces.stop, len(part.faces))
        assert np.array_equal(part.air.numpy(), whole.wind)
    assert loaded[0].material[0] == np.float32(0.4)
    assert loaded[1].material.isnan().all()
    alone = SequenceData(Sequence.load(data / "c"), data / "c", interactions.default_cache(data), SMALL, CPU)
    assert not alone.air.any()
    assert alone.material.isnan().all()


def test_which_garments_are_trained_on(data, tmp_path):
    """An outfit would be trained on as one garment, with one heading, which is not how it is simulated."""
    with Group("cpu") as group:
        found = load_sequences(TrainConfig(data, tmp_path, steps=1), SMALL, {}, group)
    assert [part.name for part in found] == ["a/inner", "a/outer", "b/inner", "b/outer", "c"]


@pytest.mark.parametrize("augmentation", [PLAIN, Augmentation(mirror=1.0, yaw=20.0)])
@pytest.mark.parametrize("t", [0, T])
def test_channels_of_a_sample(data, augmentation, t):
    """A sample would have another frame's wind, one that did not turn or was not mirrored with the garment, or not
    the velocity of its own, displaced faces. 2e-4: float32 positions up to a metre, 6e-8 off and turned, times 30."""
    loaded = garments_of(data)
    noise = NoiseConfig(position=0.01, offset=0.01, clean=0.0, spread=1.0)
    builder = SampleBuilder(loaded, SMALL, noise, augmentation)
    batch = builder.build([(0, t)], 70, np.random.default_rng(4))
    stream = np.random.default_rng(4).spawn(1)[0]  # what the sample drew
    turn, _, _, mirrored, _ = builder._drawn([(0, t)], [stream])
    subset = np.sort(stream.permutation(len(loaded[0].faces))[:70])
    delta = loaded[0].noise.displacement(SMALL.history, noise, stream)
    sequence = Sequence.load(data / "a")
    now, before = (np.array(sequence.vertices[k], np.float64)[sequence.layers[0].vertices] for k in (t, max(t - 1, 0)))
    if t:  # before the first frame it stands still, with one displacement
        now, before = now + delta[-1], before + delta[-2]
    faces = sequence.worn[0].faces[subset]
    expected = outdoor(OUTDOOR.names, now, before, faces, CLOTH, sequence.wind[t + 1], 30.0)
    expected[:, 5:] = expected[:, 5:] @ turn[0].double().numpy().T
    expected[:, 5] *= -1.0 if mirrored[0] else 1.0
    np.testing.assert_allclose(batch.outdoor[0].numpy(), expected, rtol=0.0, atol=2e-4)


def test_statistics(data):
    """Calm air would not be zero for a network, garments without a material would decide what the mean material is, or
    axes of the wind would be scaled by different numbers. 1e-6 of float32 means."""
    loaded = garments_of(data)
    builder = SampleBuilder(loaded, SMALL, QUIET, PLAIN)
    batches = [builder.build([(0, 5), (1, 9)], 60, np.random.default_rng(0))]
    found = outdoor_statistics(batches, build_network(SMALL))
    rows = batches[0].outdoor.flatten(0, 1)
    torch.testing.assert_close(found["outdoor_mean"][:5], rows[:60, :5].mean(dim=0), rtol=0, atol=1e-6)
    assert not found["outdoor_mean"][5:].any()
    spread = rows[:, 5:].square().mean().sqrt()
    torch.testing.assert_close(found["outdoor_std"][5:], spread.expand(3), rtol=1e-6, atol=0)
    assert (found["outdoor_std"][:5] == np.float32(0.1)).all()  # one material only
    assert statistics(batches, build_network(SMALL))["outdoor_std"].equal(found["outdoor_std"])
    none = [builder.build([(1, 5)], 60, np.random.default_rng(0))]
    assert not outdoor_statistics(none, build_network(SMALL))["outdoor_mean"].any()


@pytest.mark.parametrize("config", [SMALL, PATCHED], ids=["faces", "patches"])
@pytest.mark.parametrize("t", [0, T])
def test_unrolled_states_are_those_of_the_simulator(data, config, t):
    """Training would go through other states than a rollout with the material and the wind of the sequence: another
    frame's air, another garment's material, the velocity of another step. 1e-5 m, as without these channels."""
    loaded = garments_of(data, config)
    network = network_of(loaded, config)
    builder = UnrolledBuilder(loaded, network, QUIET, PLAIN, 3, 0)
    unroll = UnrollConfig(steps=3, position=1.0, collision_passes=0)
    simulator = Simulator(network, "cpu", collision_passes=0)
    for k in range(2):
        batch = builder.build([(k, t)], None, np.random.default_rng(4))
        with torch.no_grad():
            objective = UnrolledObjective(network, LossConfig(), 0.0, "float32", unroll)
            states = torch.stack([step.vertices for step in objective.steps(batch)]).numpy()
        expected = predict(simulator, loaded[k].source, t, 3, cold=t == 0)
        np.testing.assert_allclose(states, expected, atol=1e-5)
        whole = predict(simulator, Sequence.load(data / "a"), t, 3, cold=t == 0)
        np.testing.assert_allclose(whole[:, loaded[0].vertices.shape[1] * k :][:, : states.shape[1]], states, atol=1e-5)
        calm = builder.build([(k, t)], None, np.random.default_rng(4))
        for air in calm.air:
            air.zero_()
        with torch.no_grad():
            other = torch.stack([step.vertices for step in objective.steps(calm)]).numpy()
        assert np.abs(other - states).max() > 2e-5


@pytest.mark.parametrize("augmentation", [PLAIN, Augmentation(mirror=1.0, yaw=20.0)])
def test_one_step_has_the_loss_of_one_step_training(data, augmentation):
    """The wind of unrolled training would turn or mirror otherwise than that of one-step training. 1e-3, as without
    these channels (test_unrolled_objective.py)."""
    loaded = garments_of(data)
    network = network_of(loaded, SMALL)
    noise = NoiseConfig(position=0.0, offset=0.02, clean=0.0, spread=1.0)
    single = SampleBuilder(loaded, SMALL, noise, augmentation)
    one = single.build([(0, T)], len(loaded[0].faces), np.random.default_rng(4))
    expected = Objective(network, LossConfig(), 0.0, "float32")(*Objective.inputs(one))
    stream = np.random.default_rng(4).spawn(1)[0]
    joint = single._drawn([(0, T)], [stream])[2]
    stream.permutation(len(loaded[0].faces))
    delta = loaded[0].noise.displacement(SMALL.history, noise, stream)
    builder = UnrolledBuilder(loaded, network, QUIET, augmentation, 1, 0)
    batch = builder.build([(0, T)], len(loaded[0].faces), np.random.default_rng(0), [delta])
    batch.turn[:], batch.joint[:] = joint, joint
    unroll = UnrollConfig(steps=1, position=0.0, collision_passes=0)
    with torch.no_grad():
        found = UnrolledObjective(network, LossConfig(), 0.0, "float32", unroll)(batch)
    torch.testing.assert_close(found[:4], expected.detach(), rtol=1e-3, atol=0.0)
    calm = one._replace(outdoor=torch.zeros_like(one.outdoor))
    other = Objective(network, LossConfig(), 0.0, "float32")(*Objective.inputs(calm))
    assert (other[0] / expected[0] - 1.0).abs() > 3e-3  # the channels count


def test_rollouts_of_outfits_without_the_channels(data):
    """An outfit would be rolled out as one garment by networks that read neither material nor wind, and so compared
    unfairly with those that do. Exact."""
    loaded = garments_of(data)
    network = network_of(loaded, SMALL)
    plain = build_network(NetworkConfig.small(**{k: v for k, v in vars(SMALL).items() if k != "outdoor"}))
    own = network.state_dict()
    wanted = {name: own[name][:, : tensor.shape[1]] if name == "embed_faces.weight" else own[name]
              for name, tensor in plain.state_dict().items()}  # fmt: skip
    plain.load_state_dict(wanted)
    simulator, sequence = Simulator(plain, "cpu", collision_passes=0), Sequence.load(data / "a")
    found = predict(simulator, sequence, T, 3)
    for k, layer in enumerate(sequence.layers):
        assert np.array_equal(found[:, layer.vertices], predict(simulator, WornGarment(sequence, k), T, 3))


@pytest.mark.parametrize("kind", ["single", "unrolled"])
def test_a_run_that_adds_the_channels(data, tmp_path, kind):
    """`--init` with the channels would train another network, leave them without statistics, or change the statistics
    of features, which belong to the weights that are already there."""

    base = checkpoint.load(checkpoint.find("fast"))
    options = {"network": "fast", "init": "fast", "overrides": ("outdoor=density,wind",), "steps": 3, "batch_size": 2}
    if kind == "unrolled":
        options |= {"unroll": UnrollConfig(steps=2), "splits": 1}
    trained = checkpoint.load(train(config_for(data, tmp_path / "run", **options, lr=1e-3)))
    assert trained.config.outdoor == ("density", "wind")
    assert torch.equal(trained.feature_mean, base.feature_mean)
    assert (trained.outdoor_std != 1.0).all()
    assert trained.embed_faces.weight[:, -4:].any()
    assert all(np.isfinite(list(losses_of(tmp_path / "run").values())))
