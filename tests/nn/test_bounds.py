"""The metadata of a checkpoint are checked before memory is allocated."""

from __future__ import annotations

import json
import resource
import struct
import time

import pytest
import torch

from warpgarment.errors import CheckpointError
from warpgarment.nn import checkpoint
from warpgarment.nn.bounds import DEEPEST, LONGEST
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer


@pytest.fixture
def file(tmp_path):
    """A good checkpoint of a small network."""
    path = tmp_path / "net.safetensors"
    config = NetworkConfig(embedding=16, layers=2, feed_forward=16, heads=2, manifold_heads=1, history=3)
    torch.manual_seed(0)
    checkpoint.save(ManifoldAwareTransformer(config), path)
    return path


def say(path, key, value):
    """Writes a text to the metadata of a file; its tensors do not change."""
    raw = path.read_bytes()
    length = struct.unpack("<Q", raw[:8])[0]
    header = json.loads(raw[8 : 8 + length])
    old = header["__metadata__"][key]
    header["__metadata__"][key] = json.dumps(json.loads(old) | value) if isinstance(value, dict) else value
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + raw[8 + length :])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"embedding": 65_536, "heads": 1}, "embedding must be at most 16,384, got 65,536"),
        ({"embedding": 16_384, "feed_forward": 65_536}, "its config says"),  # within bounds, 8 GB: shapes tell
        ({"layers": 300}, "300 layers, but it holds"),
        ({"layers": 7_000_000}, "layers must be at most 512"),
        ({"face_layers": 4_000}, "face_layers must be at most"),
        ({"history": 2_000_000}, "history must be at most 1,000"),
        ({"geodesic_power": 10**350}, "geodesic_power must be at most"),
        ({"fps": -(10**350)}, "fps must be at most"),
        ({"geodesic_radius": float("nan")}, "geodesic_radius must be at most"),
    ],
)
def test_settings_beyond_the_file(file, changes, message):
    """A file of some kilobytes could ask for gigabytes or minutes: a named error in 5 s and 300 MB more at the peak."""
    say(file, "config", changes)
    started, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(CheckpointError, match=message):
        checkpoint.load(file)
    assert time.process_time() - started < 5.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 * 1024


@pytest.mark.parametrize("key", ["config", "notes"])
@pytest.mark.parametrize("text", ['{"a":' * 70_000, "[" * 50_000, '{"a":' * (DEEPEST + 1) + "1" + "}" * (DEEPEST + 1)])
def test_deep_metadata(file, key, text):
    """Metadata nested too deep would end in a RecursionError, there or where they are written again."""
    say(file, key, text)
    with pytest.raises(CheckpointError, match=f"'{key}' is nested"):
        checkpoint.load(file)
    with pytest.raises(CheckpointError, match=f"'{key}' is nested"):
        checkpoint.read_metadata(file)


def test_long_metadata(file):
    """A text of many megabytes would be parsed for nothing."""
    say(file, "notes", '{"a": "' + "x" * LONGEST + '"}')
    with pytest.raises(CheckpointError, match="more than 16,777,216"):
        checkpoint.load(file)


def test_notes_as_deep_as_training_writes_them(file):
    """Notes of a run, objects within objects, would be refused. Exact."""
    notes = {"training": {"objective": {"weights": [[1, 2], [3, {"a": None}]]}}}
    say(file, "notes", notes)
    assert checkpoint.read_metadata(file)[1] == notes
