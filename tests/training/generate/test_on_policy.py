"""Sequences in which a teacher goes on from the states of a network's rollouts, and samples in pieces."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support import sequences as synthetic
from support.runs import SHAPE, config_for

from warpgarment.errors import MeshError, UsageError
from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.pieces import Pieces
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.generate.on_policy import OnPolicyConfig, make_on_policy, on_policy, rolled_out
from warpgarment.training.samples.recorded import SequenceData, UnusableSequence
from warpgarment.training.samples.unrolled import UnrolledBuilder
from warpgarment.training.teachers import TeacherError
from warpgarment.training.teachers.warp.settings import WarpSettings
from warpgarment.training.teachers.warp.teacher import WarpTeacher
from warpgarment.training.train import start as train
from warpgarment.training.train.config import TrainConfig

FRAMES = 4


class Rising:
    """A teacher whose cloth rises by 1 mm a frame, and keeps what it was given."""

    name = "rising"

    def __init__(self) -> None:
        self.scenes = []

    def simulate_many(self, scenes):
        self.scenes += scenes
        for frame in range(max(map(len, scenes))):
            yield [s.cloths[0].first + np.float32([0.0, 1e-3 * frame, 0.0]) for s in scenes]

    def settings(self):
        return {"teacher": self.name}


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> Path:
    """An untrained network, whose rollouts move like skin; history 3."""
    out = tmp_path_factory.mktemp("network")
    data = synthetic.write_set(tmp_path_factory.mktemp("tiny"), train=1, frames=8)
    config = TrainConfig(
        data, out, network="small", overrides=(*SHAPE, "history=3"), steps=1, batch_size=1, statistics_batches=1
    )
    train.train(replace(config, validate_sequences=0))
    return out / "network.safetensors"


@pytest.fixture
def data(tmp_path) -> Path:
    folder = tmp_path / "data"
    synthetic.write(folder, "00000_tube", frames=24, manifest={"number": 0})
    return folder


def test_pieces_know_their_samples():
    """A sample would reach over the end of a piece, or targets be the network's own frames. By enumeration."""
    pieces = Pieces(36, 12, 5)
    for steps in (1, 3, 7):
        expected = [t for t in range(36) if t % 12 >= 4 and t % 12 + steps < 12]
        assert pieces.newest(steps).tolist() == expected
        assert [t for t in range(40) if pieces.reaches(t, steps)] == expected
    assert Pieces.of("x", {}, 9).newest(2).tolist() == list(range(7))
    assert Pieces.of("x", {}, 9).whole
    with pytest.raises(MeshError, match="no whole number of pieces"):
        Pieces.of("x", {"pieces": {"frames": 4, "known": 2}}, 9)


def test_pieces_are_the_networks_frames_and_then_the_teachers(data, network, tmp_path):
    """History and targets are mixed up, the body is at another moment, or velocities are another frame's."""
    teacher, simulator = Rising(), Simulator.from_pretrained(network, device="cpu")
    config = OnPolicyConfig(data, tmp_path / "out", str(network), pieces=3, frames=FRAMES)
    make_on_policy(config, teacher)
    source, made = Sequence.load(data / "00000_tube"), Sequence.load(tmp_path / "out" / "00000_tube_on_policy")
    states = rolled_out(source, simulator, source.body())
    at, known = made.manifest["at"], simulator.network.config.history
    assert made.manifest["pieces"] == {"frames": known + FRAMES, "known": known}
    assert len(at) == 3 == len(teacher.scenes)
    assert made.manifest["split"] == "train"
    assert np.isfinite(states).all()
    for k, t in enumerate(at):
        first = k * (known + FRAMES)
        found = made.vertices[first : first + known + FRAMES]
        frames = slice(t - known + 1, t + FRAMES + 1)
        np.testing.assert_allclose(found[:known], states[frames][:known], atol=2e-5)  # stored in 16 bits of a box
        rising = states[t] + 1e-3 * np.arange(1, FRAMES + 1)[:, None, None] * np.float32([0.0, 1.0, 0.0])
        np.testing.assert_allclose(found[known:], rising, atol=2e-5)
        body = made.full_body().vertices[first : first + known + FRAMES]
        np.testing.assert_allclose(body, source.full_body().vertices[frames], atol=1e-5)
        scene = teacher.scenes[k]
        np.testing.assert_array_equal(scene.cloths[0].first, states[t])
        np.testing.assert_allclose(scene.cloths[0].velocity, 30.0 * (states[t] - states[t - 1]), rtol=1e-6)
        np.testing.assert_array_equal(scene.body_frames, source.body().vertices[t : t + FRAMES + 1])
    assert make_on_policy(config, teacher) == {"00000_tube": "is there"}


def test_a_batch_starts_from_the_networks_state_and_aims_at_the_teachers(data, network, tmp_path):
    """Training on pieces reads a history of other frames than those that led to the target."""
    simulator = Simulator.from_pretrained(network, device="cpu")
    config = OnPolicyConfig(data, data, str(network), pieces=2, frames=FRAMES)
    make_on_policy(config, Rising())
    folder = data / "00000_tube_on_policy"
    made, settings = Sequence.load(folder), simulator.network.config
    samples = SequenceData(made, folder, tmp_path / "cache", settings, torch.device("cpu"))
    newest = samples.pieces.newest(FRAMES)
    assert newest.tolist() == [settings.history - 1, 2 * settings.history + FRAMES - 1]
    run = TrainConfig(data, tmp_path, steps=1)
    quiet = replace(run.noise, position=0.0, offset=0.0)
    still = replace(run.augmentation, mirror=0.0, yaw=0.0)
    builder = UnrolledBuilder([samples], simulator.network, quiet, still, FRAMES, 0)
    assert builder.reaches(0, int(newest[1]))
    assert not builder.reaches(0, int(newest[1]) + 1)
    batch = builder.build([(0, int(newest[1]))], None, np.random.default_rng(0))
    np.testing.assert_allclose(batch.vertices, made.vertices[newest[1]], atol=1e-7)
    np.testing.assert_allclose(batch.recorded[-1], made.vertices[newest[1] + FRAMES], atol=1e-7)
    longer = replace(settings, history=settings.history + 1)
    with pytest.raises(UnusableSequence, match="known frames"):
        SequenceData(made, folder, tmp_path / "cache", longer, torch.device("cpu"))


def test_networks_train_on_recordings_and_pieces_together(data, network, tmp_path):
    """`train` fails on such a set, or the pool of rollouts starts within pieces."""
    make_on_policy(OnPolicyConfig(data, data, str(network), pieces=2, frames=FRAMES), Rising())
    synthetic.write(data, "00001_tube", "validation", frames=10, seed=3)
    out = tmp_path / "run"
    config = config_for(data, out, overrides=(*SHAPE, "history=3"))
    share = replace(config.pushforward, share=0.5, every=2, rollouts=4, steps=2)
    unroll = replace(config.unroll, steps=2)
    train.train(replace(config, steps=4, batch_size=2, unroll=unroll, pushforward=share, splits=1))
    assert checkpoint.load(out / "network.safetensors").parameter_count() > 0


def test_the_warp_teacher_goes_on_from_a_networks_states(data, network, tmp_path):
    """Scenes lack what a teacher needs. Cloth stays within 10 cm of the rollout in 2 frames, and falls."""
    simulator = Simulator.from_pretrained(network, device="cpu")
    config = OnPolicyConfig(data, tmp_path / "out", str(network), pieces=2, frames=2)
    teacher = WarpTeacher(WarpSettings(substeps=4, iterations=6))
    arrays, manifest = on_policy(Sequence.load(data / "00000_tube"), simulator, teacher, config)
    frames, known = manifest["pieces"]["frames"], manifest["pieces"]["known"]
    for first in range(0, len(arrays["garment_vertices"]), frames):
        piece = arrays["garment_vertices"][first : first + frames]
        assert np.isfinite(piece).all()
        moved = np.linalg.norm(piece[known:] - piece[known - 1], axis=-1)
        assert 1e-4 < moved.mean() < 0.1


def test_what_cannot_be_used_is_told(data, network, tmp_path):
    """A set without usable sequences, or a teacher that knows no restarts, ends without a word or with a traceback."""
    simulator = Simulator.from_pretrained(network, device="cpu")
    config = OnPolicyConfig(data, tmp_path / "out", str(network), frames=30)
    with pytest.raises(UsageError, match="none of 1 sequences could be used, first: 00000_tube: 24 frames"):
        make_on_policy(config, Rising())

    class Still(Rising):
        def simulate_many(self, scenes):
            raise TeacherError("still cannot go on")

    with pytest.raises(TeacherError, match="cannot go on"):
        on_policy(Sequence.load(data / "00000_tube"), simulator, Still(), replace(config, frames=FRAMES))
    with pytest.raises(UsageError, match="at least 1"):
        OnPolicyConfig(data, data, "small", pieces=0)
    path = data / "00000_tube" / "manifest.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"pieces": {"frames": 4, "known": 4}}))
    with pytest.raises(MeshError, match='"frames" and "known"'):
        Sequence.load(data / "00000_tube")
