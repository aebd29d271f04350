"""The data of a run: bad sequences are skipped and counted, with a reason; cache folders depend on the content."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support import sequences as synthetic_sequences
from support.runs import config_for, losses_of

from warpgarment.nn.config import NetworkConfig
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.distributed import Group
from warpgarment.training.samples import interactions
from warpgarment.training.samples.pushforward import PushforwardConfig
from warpgarment.training.train import start as train
from warpgarment.training.train.training_set import load_sequences, load_validation, report

SMALL = NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2)


def nan_frame(content):
    content["garment_vertices"][3, 2] = np.nan


def nan_body(content):
    content["body_rest_vertices"][5] = np.nan


def overwrite(name: str, content: bytes):
    return lambda folder: (folder / name).write_bytes(content)


def truncate(folder):
    path = folder / "garment_positions.npy"
    path.write_bytes(path.read_bytes()[:-100])


def change_manifest(**changes):
    def change(folder):
        path = folder / "manifest.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


BAD = {  # name: (settings of the sequence, what is done to its folder, what the reason says)
    "short": ({"frames": 8}, None, "8 frames"),
    "nan": ({"spoil": nan_frame}, None, "frame 3"),
    "corrupt": ({}, overwrite("garment_positions.npy", b"not an array"), "garment_positions.npy"),
    "truncated": ({}, truncate, "garment_positions.npy"),
    "missing": ({}, lambda folder: (folder / "garment_faces.npy").unlink(), "garment_faces"),
    "no_manifest": ({}, lambda folder: (folder / "manifest.json").unlink(), "manifest.json"),
    "bad_manifest": ({}, overwrite("manifest.json", b'{"status": "go'), "manifest.json"),
    "odd_manifest": ({}, change_manifest(fps="thirty"), "thirty"),
    "other_rate": ({}, change_manifest(fps=24.0), "24 frames a second and the network at 30"),
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("bad") / "set"
    synthetic_sequences.write(root, "good", frames=14)
    for split in ("train", "validation"):
        for name, (settings, harm, _) in BAD.items():
            folder = synthetic_sequences.write(root, f"{split}_{name}", split, **({"frames": 14} | settings))
            if harm:
                harm(folder)
    (root / "pictures").mkdir()  # no sequence, and nobody said it was
    return root


def test_bad_sequences_are_skipped_with_their_reasons(root, tmp_path):
    """One bad sequence among good ones ends the run, is trained on, or disappears without a word."""
    skipped: dict[str, str] = {}
    sequences = load_sequences(config_for(root, tmp_path), SMALL, skipped, Group("cpu"))
    assert [s.name for s in sequences] == ["good"]
    for name, (_, _, reason) in BAD.items():
        assert reason in skipped[f"train_{name}"], name
    # nobody can say what split these are of
    unread = {"validation_no_manifest", "validation_bad_manifest", "validation_odd_manifest"}
    assert set(skipped) == {f"train_{name}" for name in BAD} | unread


def test_bad_validation_sequences_are_skipped_too(root, tmp_path):
    """A bad sequence that is only validated on would end the run at its first validation. Shortness is no harm there:
    a cold start needs one frame."""
    skipped: dict[str, str] = {}
    found = load_validation(config_for(root, tmp_path, validate_sequences=99), skipped)
    assert [sequence.name for sequence, _, _ in found] == ["validation_short"]
    assert {f"validation_{name}" for name in BAD if name != "short"} <= set(skipped)


def test_a_run_ends_with_the_count(root, tmp_path, monkeypatch):
    """The run succeeds, and nobody learns that most of the set was not used."""
    said = []
    monkeypatch.setattr(train, "say", said.append)
    config = config_for(root, tmp_path, steps=1, pushforward=PushforwardConfig(share=0.0), validate_sequences=99)
    train.train(config)
    assert len(losses_of(tmp_path)) == 1
    final = next(text for text in said if "sequences skipped:" in text).splitlines()
    assert final[0] == f"{len(final) - 1} sequences skipped:"
    assert len(final) - 1 == 2 * len(BAD) - 1  # validation_short can be used
    assert any("train_nan" in line and "frame 3" in line for line in final)
    assert report({}) == ""


def test_nothing_usable_is_said(root, tmp_path):
    """A set of bad sequences only would give a run without data."""
    config = config_for(root, tmp_path)
    good = root / "good" / "pins.npy"
    content = good.read_bytes()
    good.unlink()
    try:
        with pytest.raises(train.NoTrainingData, match="7 training sequences, none usable"):
            load_sequences(config, SMALL, {}, Group("cpu"))
    finally:
        good.write_bytes(content)
    with pytest.raises(FileNotFoundError, match="generate"):
        load_sequences(config_for(tmp_path / "nowhere", tmp_path), SMALL, {}, Group("cpu"))


def test_cache_is_keyed_by_content(tmp_path):
    """A changed sequence would be trained with the interactions of the old one."""
    folder = synthetic_sequences.write(tmp_path / "s", "one", frames=12)
    interactions.cached(Sequence.load(folder), folder, tmp_path / "cache")
    key = interactions.key_of(folder)
    assert [p.name for p in (tmp_path / "cache").iterdir()] == [f"one-{key}"]
    for name in ("garment_positions", "garment_boxes", "bone_rotations"):
        changed = np.load(folder / f"{name}.npy")
        changed.flat[0] += 1
        np.save(folder / f"{name}.npy", changed)
        assert interactions.key_of(folder) != key, name
        key = interactions.key_of(folder)
