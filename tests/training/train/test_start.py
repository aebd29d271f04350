"""Training runs: they resume exactly, also after a kill, stop where a loss is not finite, and say how fast they are."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support import sequences as synthetic_sequences
from support.runs import SHAPE, config_for, entries_of, losses_of

from warpgarment.errors import UsageError
from warpgarment.nn import checkpoint
from warpgarment.training.samples.pushforward import Pool, PushforwardConfig
from warpgarment.training.samples.single_step import SampleBuilder
from warpgarment.training.train import start as train
from warpgarment.training.train.objective import Objective

QUIET = PushforwardConfig(share=0.0)
KILLED = """
import os, signal, sys
from pathlib import Path
from support.runs import config_for
from warpgarment.training.train import start as train
update = train.Run.update
train.Run.update = lambda run, batch: os.kill(os.getpid(), signal.SIGKILL) if run.step == 6 else update(run, batch)
train.train(config_for(Path(sys.argv[1]), Path(sys.argv[2])))
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return synthetic_sequences.write_set(tmp_path_factory.mktemp("set") / "sequences", train=3, frames=16, pins=4)


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory) -> Path:
    """A run that nothing interrupted."""
    out = tmp_path_factory.mktemp("whole")
    train.train(config_for(data, out))
    assert sorted(losses_of(out)) == list(range(1, 13))
    return out


def assert_same_network(one: Path, other: Path) -> None:
    finals = [checkpoint.load(out / "network.safetensors").state_dict() for out in (one, other)]
    for name, value in finals[0].items():
        assert torch.equal(value, finals[1][name]), name


def test_resumed_run_repeats_the_uninterrupted_one(data, whole, tmp_path, monkeypatch):
    """A run that is stopped and resumed takes other samples, noise, dropout or moments. Bit for bit on the CPU."""
    with monkeypatch.context() as patch:
        over = train.Run.over
        patch.setattr(train.Run, "over", lambda run: over(run) or run.step >= 6)
        train.train(config_for(data, tmp_path))
    assert sorted(losses_of(tmp_path)) == list(range(1, 7))
    path = train.train(config_for(data, tmp_path, resume=True))
    assert losses_of(tmp_path) == losses_of(whole)
    assert checkpoint.load(path).config.embedding == 16
    assert_same_network(whole, tmp_path)


def test_killed_run_repeats_the_uninterrupted_one(data, whole, tmp_path):
    """A run that is killed leaves a state that it cannot go on from, or a log with steps that are there twice. Killed
    between the saves of steps 4 and 8, by SIGKILL; bit for bit on the CPU."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", KILLED, data, tmp_path]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900.0, check=False)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert sorted(losses_of(tmp_path)) == list(range(1, 7))
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"step": 7, "lo')  # as if killed while it wrote
    (tmp_path / ".state.01234567.partial.safetensors").write_bytes(b"half")
    train.train(config_for(data, tmp_path, resume=True))
    assert losses_of(tmp_path) == losses_of(whole)
    assert not list(tmp_path.glob(".*"))
    assert_same_network(whole, tmp_path)


@pytest.mark.parametrize("read_every", [1, 4])
def test_a_loss_that_is_not_finite_stops_the_run(data, tmp_path, monkeypatch, read_every):
    """A diverged run would go on, and nobody could see on what. The batch is kept, also where losses are read later, as
    on a GPU; nothing that came after it is saved."""
    build = SampleBuilder.build

    def poisoned(self, picks, faces, rng, displacements=None, part=slice(None)):
        batch = build(self, picks, faces, rng, displacements, part)
        if rng.bit_generator.seed_seq.entropy == (0, 1, 5):
            batch.target.psi[0, 0, 0, 0] = torch.nan
        return batch

    run_start = train.Run.start

    def start(run, path):
        run_start(run, path)
        run.read_every = read_every

    monkeypatch.setattr(SampleBuilder, "build", poisoned)
    monkeypatch.setattr(train.Run, "start", start)
    config = config_for(data, tmp_path, pushforward=QUIET, validate_every=100, log_every=8)
    with pytest.raises(train.NonFiniteLoss, match=r"step 5 .*not_finite_5"):
        train.train(config)
    saved = np.load(tmp_path / "not_finite_5.npz")
    assert len(saved["sequence"]) == 4
    assert np.isnan(saved["psi"][0, 0, 0, 0])
    checkpoint.load(tmp_path / "network.safetensors")  # refuses what is not finite
    _, notes = checkpoint.read_metadata(tmp_path / "network.safetensors")
    assert notes["steps"] == 4


def test_log_says_how_fast(data, whole):
    """The rate is missing, or counts validation and saves: over a run, samples / rate cannot exceed the time it took.
    One percent: the log rounds seconds."""
    entries = entries_of(whole)
    busy = sum(4 / entry["samples_per_second"] for entry in entries)
    assert 0.0 < busy < 1.01 * entries[-1]["seconds"] + 0.1
    assert all(entry["model_tflops_per_second"] > 0.0 for entry in entries)
    assert all(entry["gradient_norm"] > 0.0 for entry in entries)
    assert "matrix_peak_share" not in entries[0]  # nobody knows a CPU's


def test_time_limit_stops_with_a_checkpoint(data, tmp_path, capsys):
    """A time limit is passed by, or what was trained is lost."""
    path = train.train(config_for(data, tmp_path, steps=None, time_limit=1e-3, pushforward=QUIET, statistics_batches=1))
    assert checkpoint.load(path).config.embedding == 16
    assert (tmp_path / "state.safetensors").exists()
    assert max(losses_of(tmp_path), default=0) < 50


def test_bfloat16_keeps_losses_and_weights_in_float32(data, tmp_path, monkeypatch):
    """Mixed precision does nothing, or reaches the loss: losses differ from those of float32 a little. 3 %: bfloat16
    has 8 bits, and its errors average over the batch."""
    seen = []
    forward = Objective.forward

    def watch(self, *inputs):
        losses = forward(self, *inputs)
        seen.append((losses.dtype, self.network.embed_faces.weight.dtype))
        return losses

    monkeypatch.setattr(Objective, "forward", watch)
    settings = {"steps": 4, "pushforward": QUIET, "validate_sequences": 0}  # the first steps are hardly any
    for precision in ("float32", "bfloat16"):
        train.train(config_for(data, tmp_path / precision, precision=precision, **settings))
    assert set(seen) == {(torch.float32, torch.float32)}
    exact, half = (losses_of(tmp_path / p) for p in ("float32", "bfloat16"))
    assert exact[4] != half[4]
    assert half == pytest.approx(exact, rel=0.03)


def test_compiled_run_gives_the_same_losses(data, tmp_path, monkeypatch):
    """The compiled objective is not the one that is trained, or breaks where shapes change. Traced, but run by PyTorch
    (backend "eager"), so that no compiler is needed. 1e-5: float32."""
    settings = {"steps": 3, "pushforward": QUIET, "validate_sequences": 0, "split_share": 0.5}
    settings["overrides"] = (*SHAPE, "dropout=0.0")
    compile = Objective.compile
    calls = []
    monkeypatch.setattr(Objective, "compile", lambda self, **how: calls.append(how) or compile(self, backend="eager"))
    train.train(config_for(data, tmp_path / "compiled", compile=True, **settings))
    train.train(config_for(data, tmp_path / "plain", **settings))
    assert len(calls) == 1
    compiled, plain = (losses_of(tmp_path / name) for name in ("compiled", "plain"))
    assert compiled == pytest.approx(plain, rel=1e-5)


def test_a_missing_compiler_is_said(data, tmp_path, monkeypatch):
    """Where there is no compiler, a page of traceback would hide what to do."""

    def broken(self, **how):
        def backend(graph, inputs):
            raise RuntimeError("no compiler here")

        torch.nn.Module.compile(self, backend=backend)

    monkeypatch.setattr(Objective, "compile", broken)
    with pytest.raises(train.CompileFailed, match=r"no compiler here.*without --compile"):
        train.train(config_for(data, tmp_path, steps=1, compile=True, pushforward=QUIET))


def test_pool_returns_what_it_saved():
    """A resumed run would start from other displacements."""
    pool = Pool()
    pool.rollouts = [(2, 5, np.arange(36, dtype=np.float32).reshape(3, 4, 3))]
    other = Pool()
    other.restore(pool.tensors())
    sequence, newest, displacement = other.entry(*other.fitting(np.array([9, 9, 50]), 20)[1])
    assert (sequence, newest) == (2, 6)
    np.testing.assert_array_equal(displacement, pool.rollouts[0][2][:2])


def test_settings_are_checked(tmp_path):
    """A misspelt network setting would be ignored."""
    with pytest.raises(ValueError, match="geodesic_radius"):
        config_for(tmp_path, tmp_path, overrides=("radius=1",)).network_config()
    with pytest.raises(ValueError, match="time_limit"):
        train.TrainConfig(data=tmp_path, out=tmp_path)
    with pytest.raises(ValueError, match="save_every"):
        config_for(tmp_path, tmp_path, save_every=0)


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (("layers=2,heads=4",), "layers must be a whole number, got '2,heads=4'. Overrides are NAME=VALUE"),
        (("dropout=many",), "dropout must be a number, got 'many'"),
        (("residual=perhaps",), "residual must be true or false, got 'perhaps'"),
        (("heads=-1",), "overrides: .*heads"),
        (("rounds=3",), "no network setting 'rounds'"),
    ],
)
def test_overrides_that_mean_nothing_are_told_by_name(tmp_path, overrides, says):
    """A slip in --overrides ends with a fault of the program and a traceback."""
    with pytest.raises(UsageError, match=says):
        train.TrainConfig(tmp_path, tmp_path, network="fast", steps=1, overrides=overrides).network_config()


def test_overrides_of_a_trained_network_are_taken_or_refused(data, whole, tmp_path):
    """`--init` with `--overrides physics=8` trains without physics, and one with `heads=4` with the old heads; neither
    with a word."""
    init = {"init": whole / "network.safetensors", "steps": 1, "validate_sequences": 0, "pushforward": QUIET}
    physics = (*SHAPE, "physics=3", "physics_length=0.5")
    train.train(config_for(data, tmp_path / "physics", overrides=physics, **init))
    made = checkpoint.load(tmp_path / "physics" / "network.safetensors").config
    assert (made.physics, made.physics_length) == (3, 0.5)
    with pytest.raises(UsageError, match="layers=2, but the network from init has 1"):
        train.train(config_for(data, tmp_path / "layers", overrides=("layers=2",), **init))
