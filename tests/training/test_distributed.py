"""Training with several processes, started by torchrun: the same losses as one, also after all of them are killed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support import sequences as synthetic_sequences
from support.runs import config_for, losses_of

from tests.support.runs import SETTINGS
from warpgarment.nn import checkpoint
from warpgarment.training.distributed import FRESH, Group, GroupError
from warpgarment.training.train import start as train

WORKER = """
import os, signal, sys
from pathlib import Path
from support.runs import SETTINGS
from support.runs import config_for
from warpgarment.training.train import start as train
data, out, first = Path(sys.argv[1]), Path(sys.argv[2]), os.environ["TORCHELASTIC_RESTART_COUNT"] == "0"
assert first != (out / "state.safetensors").exists()
update = train.Run.update
def killed(run, batch):
    if first and run.step == 6 and run.group.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    update(run, batch)
train.Run.update = killed
train.train(config_for(data, out, resume=True, **SETTINGS))
"""


def test_two_processes_train_as_one_also_after_a_kill(tmp_path):
    """Gradients are added instead of averaged, samples are taken twice, statistics or pools differ between processes,
    or a resumed group goes on elsewhere: then losses leave those of one process. One process is killed at step 6,
    between two saves; torchrun then starts both again.

    Garments have one and two components and different numbers of faces. 1e-3 relative over twelve steps: sums in
    another order differ by 1e-7, and Adam's first steps divide small gradients by themselves.
    """
    data, out, script = tmp_path / "set", tmp_path / "two", tmp_path / "worker.py"
    for number, rings in enumerate((6, 5, 7)):
        settings = {"spoil": _two_pieces} if number == 1 else {}
        synthetic_sequences.write(data, f"train_{number}", seed=number, rings=rings, frames=16, **settings)
    synthetic_sequences.write(data, "validation_0", "validation", frames=12)
    script.write_text(WORKER)
    train.train(config_for(data, tmp_path / "one", **SETTINGS))
    one = losses_of(tmp_path / "one")

    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += ["--max-restarts", "1", "--monitor-interval", "0.05", script, data, out]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1", FRESH: "1"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900.0, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "exitcode: -9" in ended.stderr, ended.stderr  # torchrun saw one killed
    two = losses_of(out)
    assert sorted(two) == list(range(1, 13))
    assert two == pytest.approx(one, rel=1e-3)
    _, notes = checkpoint.read_metadata(out / "network.safetensors")
    assert notes["steps"] == 12


def _two_pieces(content):
    """Cuts the tube between its third and fourth ring."""
    lower = (content["garment_faces"] < 36).all(axis=1)
    upper = (content["garment_faces"] >= 36).all(axis=1)
    content["garment_faces"] = content["garment_faces"][lower | upper]


def test_shares_of_a_batch(monkeypatch):
    """A sample would be left out, or batches be of different sizes in different processes."""
    group = Group("cpu")
    assert list(range(8))[group.part(8)] == list(range(8))
    group.size = 4
    shares = []
    for rank in range(4):
        group.rank = rank
        shares += list(range(8))[group.part(8)]
    assert shares == list(range(8))
    with pytest.raises(GroupError, match="such as 12"):
        group.part(10)
    assert group.first is False
