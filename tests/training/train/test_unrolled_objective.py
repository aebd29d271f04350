"""Unrolled training: the states of the simulator, the losses of one-step training, gradients of finite differences."""

from __future__ import annotations

import inspect
import json
import typing
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
from support import sequences as synthetic_sequences
from support.runs import config_for, entries_of, losses_of

from warpgarment.kernels.features import LAYOUT
from warpgarment.metrics import mean_vertex_error
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import build_network
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.grow import added
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.sim.simulator import Simulator
from warpgarment.sim.stages import features
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.rollouts import predict
from warpgarment.training.samples import interactions
from warpgarment.training.samples.augmentation import Augmentation
from warpgarment.training.samples.drawing import Builder
from warpgarment.training.samples.noise import NoiseConfig
from warpgarment.training.samples.pushforward import PushforwardConfig
from warpgarment.training.samples.recorded import SequenceData
from warpgarment.training.samples.single_step import Batch, SampleBuilder
from warpgarment.training.samples.statistics import statistics
from warpgarment.training.samples.unrolled import UnrolledBatch, UnrolledBuilder
from warpgarment.training.train import start as train
from warpgarment.training.train import unrolled_objective as unroll
from warpgarment.training.train.losses import LossConfig
from warpgarment.training.train.objective import Objective
from warpgarment.training.train.unrolled_objective import UnrollConfig, UnrolledObjective

SMALL = NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2, dropout=0.0, geodesic_radius=0.2)
QUIET = NoiseConfig(position=0.0, offset=0.0)
PLAIN = Augmentation(mirror=0.0, yaw=0.0)
T = 11  # newest frame of most samples


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("set") / "sequences"
    synthetic_sequences.write(root, "train_0", seed=0, frames=18, pins=4)
    synthetic_sequences.write(root, "train_1", seed=1, frames=18, rings=5)
    synthetic_sequences.write(root, "validation_0", "validation", seed=2, frames=12)
    return root


@pytest.fixture(scope="module")
def loaded(data) -> list[SequenceData]:
    cache = interactions.default_cache(data)
    return [SequenceData(Sequence.load(f), f, cache, SMALL, torch.device("cpu")) for f in sorted(data.glob("train_*"))]


@pytest.fixture
def network(loaded) -> ManifoldAwareTransformer:
    """Inputs normalised by the data, outputs by deviations as sets of real garments have them, and not zero."""
    torch.manual_seed(0)
    module = ManifoldAwareTransformer(SMALL)
    builder = SampleBuilder(loaded, SMALL, QUIET, PLAIN)
    module.set_statistics(statistics([builder.build([(0, 5), (1, 9)], 60, np.random.default_rng(0))], module))
    module.set_statistics({"psi_std": [0.05] * 9, "singular_value_std": [0.05] * 3, "q_std": [0.003] * 3})
    for head in (module.face_head, module.velocity_head):
        torch.nn.init.normal_(head.weight, std=0.1)
    return module


def batch_of(loaded, network, picks, *, steps=3, faces=None, passes=0, augmentation=PLAIN, noise=QUIET, part=None):
    builder = UnrolledBuilder(loaded, network, noise, augmentation, steps, passes)
    smallest = min(len(loaded[s].faces) for s, _ in picks)
    return builder.build(picks, faces or smallest, np.random.default_rng(4), None, part or slice(None))


def objective_of(network, **settings) -> UnrolledObjective:
    unroll = UnrollConfig(**({"steps": 3, "position": 0.0, "collision_passes": 0} | settings))
    return UnrolledObjective(network, LossConfig(), 0.0, "float32", unroll)


@pytest.mark.parametrize(("s", "t", "passes"), [(0, T, 2), (1, T, 0), (0, 0, 2)])
def test_states_are_those_of_the_simulator(loaded, network, s, t, passes):
    """Training goes through other states than a rollout: against `Simulator.rollout`, warm with and without pins and
    collisions, and cold.

    1e-5 m: the same float32 operations, but for cached features of the history.
    """
    batch = batch_of(loaded, network, [(s, t)], passes=passes)
    objective = objective_of(network, position=1.0, collision_passes=passes)
    with torch.no_grad():
        states = [step.vertices for step in objective.steps(batch)]
    simulator = Simulator(network, "cpu", collision_passes=passes)
    expected = predict(simulator, loaded[s].source, t, 3, cold=t == 0)
    moved = np.abs(expected[-1] - np.array(loaded[s].source.vertices[t + 3])).max()
    assert moved > 1e-3  # the network does not just repeat the recording
    np.testing.assert_allclose(torch.stack(states).numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("augmentation", [PLAIN, Augmentation(mirror=1.0, yaw=20.0)])
def test_one_step_has_the_loss_of_one_step_training(loaded, network, augmentation):
    """Weights, normalisation, heading, turns or mirror differ from one-step training: for one step of one garment with
    a history 2 cm off both must have the same losses. (Displaced as a whole: one-step training turns samples by the
    heading of the recording, a rollout by its own.) 1e-3: one-step training keeps geodesic weights in float16."""
    noise = NoiseConfig(position=0.0, offset=0.02, clean=0.0, spread=1.0)
    single = SampleBuilder(loaded, SMALL, noise, augmentation)
    one = single.build([(1, T)], len(loaded[1].faces), np.random.default_rng(4))
    expected = Objective(network, LossConfig(), 0.0, "float32")(*Objective.inputs(one))

    stream = np.random.default_rng(4).spawn(1)[0]  # what the sample above drew
    joint = single._drawn([(1, T)], [stream])[2]
    stream.permutation(len(loaded[1].faces))
    delta = loaded[1].noise.displacement(SMALL.history, noise, stream)
    builder = UnrolledBuilder(loaded, network, QUIET, augmentation, 1, 0)
    batch = builder.build([(1, T)], len(loaded[1].faces), np.random.default_rng(0), [delta])
    batch.turn[:], batch.joint[:] = joint, joint
    assert batch.mirrored.all() == (augmentation.mirror > 0.0)
    with torch.no_grad():
        found = objective_of(network, steps=1)(batch)
    torch.testing.assert_close(found[:4], expected.detach(), rtol=1e-3, atol=0.0)


def windy(network: ManifoldAwareTransformer) -> ManifoldAwareTransformer:
    """The network with the wind relative to each face as one more input, on which it depends as on the others."""
    made = added(network, ("wind",))
    torch.nn.init.normal_(made.embed_faces.weight[:, -3:], std=0.3)
    made.set_statistics({"outdoor_std": [0.05] * 3})
    return made


@pytest.mark.parametrize(("which", "wind"), [(0, False), (4, False), (4, True)])
def test_gradients_are_those_of_finite_differences(loaded, network, monkeypatch, which, wind):
    """A gradient is lost on the way through three steps: between the prediction and the state, in a solve, in the
    features, in the velocities of faces relative to the air, or in targets that depend on the state.

    Along random directions of the weights, all uphill so that the slope is far above rounding, for the whole loss (0)
    and the distance from the recording alone (4). Nearest points are those found at first: they are constants of the
    gradient. Squares take the place of absolute differences, whose kinks, thousands of them, leave differences off by
    2 %. 0.5 % of the slope: the loss is curved, and float32 positions, 1e-7 m off, limit differences to some 1e-3.
    Frames in which no two singular values of a face meet: replacing them is discontinuous there.
    """
    found, calls, search = [], [], features.body_interaction

    def remembered(*arguments):
        calls.append(None)
        if len(calls) > len(found):
            found.append(search(*arguments))
        return found[len(calls) - 1]

    def squares(predicted, target, network, config, face_weight, component_weight):
        weights, factors = (face_weight, face_weight, component_weight), (1.0, 1.0, 3.0)
        parts = zip(predicted, target, weights, strict=True)
        terms = [((a.double() - b.double()).square().sum(dim=-1) * w).sum() for a, b, w in parts]
        return sum(f * term for f, term in zip(factors, terms, strict=True)), *terms

    monkeypatch.setattr(features, "body_interaction", remembered)
    monkeypatch.setattr(unroll, "weighted", squares)
    network = windy(network) if wind else network
    batch = batch_of(loaded, network, [(0, T + 1), (1, T + 1)])
    objective = objective_of(network, position=1.0, sliding=False)  # nearest points are remembered
    parameters = list(network.parameters())

    def value() -> torch.Tensor:
        calls.clear()
        return objective(batch)[which]

    gradients = torch.autograd.grad(value(), parameters)
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        directions = [
            torch.rand(p.shape, generator=generator) * p.detach().abs().mean() * g.sign()
            for p, g in zip(parameters, gradients, strict=True)
        ]
        slope = sum((g * d).sum().item() for g, d in zip(gradients, directions, strict=True))
        step, values = 1e-3, []

        def move(by: float, directions=directions) -> None:
            with torch.no_grad():
                for p, d in zip(parameters, directions, strict=True):
                    p += by * d

        for by in (step, -2.0 * step):
            move(by)
            values.append(value().item())  # with gradients, so that the same operators run
        move(step)
        assert slope == pytest.approx((values[0] - values[1]) / (2.0 * step), rel=5e-3)


def test_parts_of_a_batch_average_to_its_loss(loaded, network):
    """Several processes would train on other losses than one: garments of different sizes, seen in one piece and in
    two."""
    objective, noise = objective_of(network), NoiseConfig()
    turns = Augmentation(mirror=0.5, yaw=5.0)
    picks = [(0, T), (1, T), (1, 3), (0, 0)]
    for faces in (96, 48):
        losses = [
            objective(
                batch_of(loaded, network, picks, faces=faces, augmentation=turns, noise=noise, part=part)
            ).detach()
            for part in (slice(None), slice(0, 2), slice(2, 4))
        ]
        # a part of the batch is split by its own smallest garment, which here is the same
        torch.testing.assert_close(torch.stack(losses[1:]).mean(dim=0), losses[0], rtol=1e-4, atol=0.0)


def test_three_unrolled_steps_lower_the_rollout_error(loaded, network):
    """The gradient does not lead to rollouts closer to the recording, which is what it is for."""
    batch = batch_of(loaded, network, [(1, T)])
    objective = objective_of(network, position=1000.0)

    def error() -> float:
        predicted = predict(Simulator(network, "cpu", collision_passes=0), loaded[1].source, T, 3)
        return mean_vertex_error(predicted, np.array(loaded[1].source.vertices[T + 1 : T + 4]))

    optimizer, errors = torch.optim.AdamW(network.parameters(), lr=1e-3), [error()]
    for _ in range(3):
        optimizer.zero_grad()
        objective(batch)[0].backward()
        optimizer.step()
        errors.append(error())
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.9 * errors[0]


UNROLLED = {
    "unroll": UnrollConfig(steps=2, position=1.0), "batch_size": 2, "steps": 6, "save_every": 2, "validate_every": 4,
    "statistics_batches": 1, "pushforward": PushforwardConfig(every=2, rollouts=2, steps=2, share=0.5),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["small", "fast"])
def test_unrolled_work_is_that_of_single_steps(data, kind):
    """The rates in log.jsonl count other operations for unrolled steps than for single ones, such as no patches: four
    steps in a row are four times one step on the same faces, exactly."""
    shape = {"embedding": 16, "layers": 2, "feed_forward": 16, "heads": 2, "dropout": 0.0, "patch_spacing": 0.15}
    config = getattr(NetworkConfig, kind)(**shape)
    cache, folder, picks = interactions.default_cache(data), data / "train_0", [(0, 3), (0, 9)]
    loaded = [SequenceData(Sequence.load(folder), folder, cache, config, torch.device("cpu"))]
    network, faces = build_network(config), len(loaded[0].faces)
    single = SampleBuilder(loaded, config, QUIET, PLAIN).build(picks, faces, np.random.default_rng(0))
    unrolled = UnrolledBuilder(loaded, network, QUIET, PLAIN, 4, 0).build(picks, None, np.random.default_rng(0))
    samples, operations = single.work(config)
    assert unrolled.work(config) == (samples, 4 * operations)


def test_objectives_keep_the_methods_of_modules(network):
    """A setting has the name of a method of `nn.Module`, such as `half`, which can no longer be called."""
    one = Objective(network, LossConfig(), 0.0, "bfloat16")
    several = UnrolledObjective(network, LossConfig(), 0.0, "bfloat16", UnrollConfig())
    for objective in (one, several):
        assert not [name for name in vars(objective) if callable(getattr(torch.nn.Module, name, None))]


def test_a_resumed_unrolled_run_repeats_the_uninterrupted_one(data, tmp_path, monkeypatch):
    """As for one-step training: bit for bit on the CPU; and the log has the distance from the recording."""
    train.train(config_for(data, tmp_path / "whole", **UNROLLED))
    entries = entries_of(tmp_path / "whole")
    assert [entry["step"] for entry in entries] == list(range(1, 7))
    for entry in entries:
        parts = entry["loss_deformation"] + entry["loss_singular_values"] + 3.0 * entry["loss_velocity"]
        assert entry["loss"] == pytest.approx(parts + entry["position_m"], rel=1e-5)
        assert 0.0 < entry["position_m"] < 0.05
        assert entry["samples_per_second"] > 0.0
    with monkeypatch.context() as patch:
        over = train.Run.over
        patch.setattr(train.Run, "over", lambda run: over(run) or run.step >= 3)
        train.train(config_for(data, tmp_path / "cut", **UNROLLED))
    train.train(config_for(data, tmp_path / "cut", resume=True, **UNROLLED))
    assert losses_of(tmp_path / "cut") == losses_of(tmp_path / "whole")
    ours, theirs = (checkpoint.load(tmp_path / n / "network.safetensors").state_dict() for n in ("cut", "whole"))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert json.loads((tmp_path / "cut" / "config.json").read_text())["unroll"]["steps"] == 2


def test_an_unrolled_loss_that_is_not_finite_stops_the_run(data, tmp_path, monkeypatch):
    """A diverged unrolled run would go on, or its batch would be lost, as for one-step training."""
    build = UnrolledBuilder.build

    def poisoned(self, picks, faces, rng, displacements=None, part=slice(None)):
        batch = build(self, picks, faces, rng, displacements, part)
        if rng.bit_generator.seed_seq.entropy == (0, 1, 1):
            batch.recorded[0][0] = torch.nan
        return batch

    monkeypatch.setattr(UnrolledBuilder, "build", poisoned)
    settings = UNROLLED | {"validate_sequences": 0, "pushforward": PushforwardConfig(share=0.0)}
    with pytest.raises(train.NonFiniteLoss, match=r"step 1 .*not_finite_1"):
        train.train(config_for(data, tmp_path, **settings))
    saved = np.load(tmp_path / "not_finite_1.npz")
    assert len(saved["sequence"]) == 2
    assert np.isnan(saved["recorded"][0, 0]).all()
    assert np.isfinite(saved["features"]).all()


def test_both_builders_are_what_a_loader_needs(loaded, network):
    """One builder is taken for the other, whose batches are of another type, or a loader calls what only one has."""
    single, unrolled = SampleBuilder(loaded, SMALL, QUIET, PLAIN), UnrolledBuilder(loaded, network, QUIET, PLAIN, 3, 0)
    assert not isinstance(unrolled, SampleBuilder)
    for name in ("build", "reaches"):
        wanted = inspect.signature(getattr(Builder, name))
        for builder in (SampleBuilder, UnrolledBuilder):
            assert inspect.signature(getattr(builder, name)).parameters == wanted.parameters
    assert typing.get_type_hints(SampleBuilder.build)["return"] is Batch
    assert typing.get_type_hints(UnrolledBuilder.build)["return"] is UnrolledBatch
    for name in typing.get_type_hints(Builder):
        assert getattr(single, name) == getattr(unrolled, name), name


@pytest.mark.parametrize("t", [0, 2, T])
def test_both_begin_with_the_same_history(loaded, network, t):
    """Unrolled training starts from another history than training of one step: in frames before the first, in what a
    rollout did wrong, or with a body that is not at rest there. What no turn changes, to 1e-5: float32."""
    shift = np.random.default_rng(2).normal(0.0, 0.01, (2, *loaded[0].vertices[0].shape)).astype(np.float32)
    arguments = [(0, t)], len(loaded[0].faces), np.random.default_rng(4), [shift]
    one = SampleBuilder(loaded, SMALL, QUIET, PLAIN).build(*arguments)
    several = UnrolledBuilder(loaded, network, QUIET, PLAIN, 1, 0).build(*arguments)
    speeds = [v.reshape(-1, SMALL.history - 1, 3).norm(dim=2) for v in (one.velocities, several.history.velocities)]
    torch.testing.assert_close(*speeds, rtol=0, atol=1e-5)
    assert (speeds[0][:, -1] > 1e-3).all() == (t > 0)  # the shift; in frame 0 that of all frames before it
    features = one.features[0], several.history.stacked(several.features).flatten(1)
    features = [part.unflatten(1, (SMALL.history, -1)) for part in features]
    for name in ("singular_values", "body_velocity", "body_deformation"):
        lengths = [part[..., LAYOUT[name]].norm(dim=2) for part in features]
        torch.testing.assert_close(*lengths, rtol=0, atol=1e-5, msg=lambda m, n=name: f"{n}: {m}")


def test_cloth_far_from_the_body_counts_less(loaded, network):
    """The position loss weighs vertices otherwise than it says: against distances to the body by brute force, and the
    loss itself as the weighted mean. 1e-4: distances of float32, to faces and not through the cache."""
    batch = batch_of(loaded, network, [(0, T), (1, T)], steps=1)
    garments, bodies = [loaded[s].source.garment for s in (0, 1)], [loaded[s].source.body() for s in (0, 1)]
    wanted = []
    for s, (garment, body) in enumerate(zip(garments, bodies, strict=True)):
        recorded = np.asarray(loaded[s].source.vertices[T], np.float64)
        middles = recorded[garment.faces].mean(axis=1)
        solid = body.vertices[T].astype(np.float64), body.faces.astype(np.int64)
        outside = igl.signed_distance(middles, *solid)[0] > 0.0  # its lengths are up to 0.03 mm off
        distance = np.sqrt(igl.point_mesh_squared_distance(middles, *solid)[0]) * outside
        counts = np.bincount(garment.faces.ravel(), minlength=len(recorded))
        total = np.bincount(garment.faces.ravel(), np.repeat(distance, 3), len(recorded))
        wanted.append(0.005 / (0.2 * total / np.maximum(counts, 1) + 0.005))
    weights = np.concatenate(wanted)
    assert weights.min() < 0.9 * weights.max()
    np.testing.assert_allclose(unroll.certainty(batch, 0.2).numpy(), weights, rtol=1e-4)
    assert (unroll.certainty(batch, 0.0) == 1.0).all()

    objective = objective_of(network, steps=1, position=1.0, floor=0.2)
    with torch.no_grad():
        found = objective(batch)[4]
        ((_, vertices, recorded, _),) = objective.steps(batch)
    apart = (vertices - recorded).norm(dim=1).double() * torch.from_numpy(weights) * batch.vertex_weight
    assert float(found) == pytest.approx(float(apart.sum()), rel=1e-4)


def test_gradients_slide_along_the_body_if_asked(loaded, network):
    """The setting does not reach the features, so that both gradients are the same."""
    slopes = []
    for sliding in (False, True):
        batch = batch_of(loaded, network, [(0, T)], steps=2)
        network.zero_grad()
        objective_of(network, steps=2, position=1.0, sliding=sliding)(batch)[0].backward()
        slopes.append(network.face_head.weight.grad.clone())
    assert (slopes[0] - slopes[1]).abs().max() > 1e-6 * slopes[0].abs().max()


def test_samples_end_where_the_recording_does(loaded, network):
    """The last step of a sample would lie after the last recorded frame."""
    builder = UnrolledBuilder(loaded, network, QUIET, PLAIN, 3, 0)
    last = len(loaded[0].vertices) - 1
    assert [builder.reaches(0, t) for t in (last - 4, last - 3, last - 2)] == [True, True, False]
    batch = builder.build([(0, last - 3)], 999, np.random.default_rng(0))
    np.testing.assert_array_equal(batch.recorded[-1].numpy(), np.array(loaded[0].source.vertices[last]))


def test_settings_that_do_not_go_together_are_refused(data, tmp_path):
    """A run would silently train otherwise than asked."""
    with pytest.raises(ValueError, match="between 1 and"):
        UnrollConfig(steps=0)
    with pytest.raises(ValueError, match=r"unroll\.position must be at least 0 and finite, got -1"):
        UnrollConfig(position=-1.0)
    with pytest.raises(ValueError, match=r"unroll\.floor must be at least 0 and finite, got inf"):
        UnrollConfig(floor=float("inf"))
    with pytest.raises(ValueError, match="leave out compile"):
        config_for(data, tmp_path, unroll=UnrollConfig(steps=2), compile=True)
    with pytest.raises(ValueError, match=r"augmentation\.scale"):
        config_for(data, tmp_path, unroll=UnrollConfig(steps=2), augmentation=Augmentation(scale=0.05))
