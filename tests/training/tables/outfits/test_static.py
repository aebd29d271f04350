"""The static baseline: untrained the smooth skin, of the pose alone, kept in a file, better after training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from reference.features import smooth_skin
from scipy.spatial.transform import Rotation
from support import sequences

from warpgarment.errors import CheckpointError
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.tables.options import DataLacks
from warpgarment.training.tables.outfits.static import StaticGarment, notes_of
from warpgarment.training.tables.outfits.static_training import Recorded, train_static


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("worn")
    for name, split in (("a", "train"), ("b", "train"), ("c", "validation")):
        sequences.write_worn(root, name, split, frames=20, seed=ord(name))
    return root


def random_network() -> StaticGarment:
    """One that displaces cloth and changes its weights."""
    torch.manual_seed(0)
    network = StaticGarment(16, 8)
    for head in (network.weights, network.displacement):
        torch.nn.init.normal_(head.weight, std=2.0)
    return network.eval()


def test_untrained_it_is_the_smooth_skin(data):
    """The baseline would start from elsewhere. The twin in float64; 2e-5 m for float32 and weights that are 1e-6."""
    sequence = Sequence.load(data / "a")
    body = sequence.body()
    frames = np.asarray(body.vertices)[[0, 5, 19]]
    _, expected = smooth_skin(sequence.vertices[0], body.vertices[0], frames)
    found = StaticGarment().posed(sequence, body, frames)
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_frames_depend_on_their_pose_alone(data):
    """A static model would know the past or other frames: another order gives the same frames, 1e-6 m; and frame 0 is
    the recorded one. The random network moves cloth by centimetres."""
    sequence, network = Sequence.load(data / "a"), random_network()
    body = sequence.body()
    frames = np.asarray(body.vertices)
    found = network.posed(sequence, body, frames)
    order = np.random.default_rng(0).permutation(len(frames))
    np.testing.assert_allclose(network.posed(sequence, body, frames[order]), found[order], atol=1e-6)
    np.testing.assert_allclose(found[0], sequence.vertices[0], atol=1e-6)
    assert abs(found - StaticGarment().posed(sequence, body, frames)).max() > 0.01


def test_turns_and_travels_of_the_body_move_cloth_alike(data):
    """The displacement would be in the world's axes: later poses turned and shifted, cloth follows; 1e-5 m."""
    sequence, network = Sequence.load(data / "a"), random_network()
    body = sequence.body()
    turn, frames = Rotation.from_rotvec([0.3, 1.2, -0.4]).as_matrix(), np.asarray(body.vertices)[5:8].astype(np.float64)
    found = network.posed(sequence, body, frames @ turn.T + [0.5, 0.1, 2.0])
    expected = network.posed(sequence, body, frames).astype(np.float64) @ turn.T + [0.5, 0.1, 2.0]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_file_gives_the_same_frames(data, tmp_path):
    """Weights or widths would be lost. The same bits; other files are refused by name."""
    sequence, network = Sequence.load(data / "a"), random_network()
    body = sequence.body()
    network.save(tmp_path / "static.safetensors", {"steps": 7})
    frames = np.asarray(body.vertices)[3:6]
    loaded = StaticGarment.load(tmp_path / "static.safetensors")
    assert np.array_equal(loaded.posed(sequence, body, frames), network.posed(sequence, body, frames))
    assert notes_of(tmp_path / "static.safetensors") == {"steps": 7}
    with pytest.raises(CheckpointError, match=r"none\.safetensors cannot be read"):
        StaticGarment.load(tmp_path / "none.safetensors")
    (tmp_path / "text.safetensors").write_text("hello")
    with pytest.raises(CheckpointError, match="cannot be read"):
        StaticGarment.load(tmp_path / "text.safetensors")


def test_training_helps_and_spends_what_it_says(data, tmp_path):
    """Training would not reach the weights, or take longer than said: a few seconds bring training sequences nearer
    by a fifth; the time is that of the processor, with the last step over it."""
    notes = train_static(data, tmp_path / "static.safetensors", minutes=0.05)
    assert (notes["train"], notes["validation"], notes["skipped"]) == (2, 1, {})
    assert 0.05 <= notes["minutes"] < 0.1
    assert notes_of(tmp_path / "static.safetensors") == notes
    own = [Recorded.of(data / name) for name in "ab"]
    trained = StaticGarment.load(tmp_path / "static.safetensors")
    assert np.mean([r.error_mm(trained) for r in own]) < 0.8 * np.mean([r.error_mm(StaticGarment()) for r in own])


def test_without_training_sequences_it_says_so(tmp_path):
    """It would write an untrained model."""
    sequences.write_worn(tmp_path, "only", "test", frames=3)
    with pytest.raises(DataLacks, match="no sequence to train on"):
        train_static(tmp_path, tmp_path / "static.safetensors", minutes=0.01)
    assert not (tmp_path / "static.safetensors").exists()
