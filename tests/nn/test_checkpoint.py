"""Checkpoints: what is written comes back, and nothing else is accepted."""

from __future__ import annotations

import json
import os
import struct

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from warpgarment.errors import CheckpointError
from warpgarment.nn import checkpoint
from warpgarment.nn.config import STATISTICS, NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer


@pytest.fixture
def network() -> ManifoldAwareTransformer:
    """Random weights and statistics."""
    torch.manual_seed(0)
    network = ManifoldAwareTransformer(
        NetworkConfig(
            embedding=16, layers=2, feed_forward=16, heads=2, manifold_heads=1, history=3, geodesic_radius=0.25
        )
    )
    network.set_statistics({name: torch.rand(length) + 0.5 for name, length in STATISTICS.items()})
    return network


@pytest.fixture
def file(network, tmp_path):
    """A good checkpoint."""
    path = tmp_path / "net.safetensors"
    checkpoint.save(network, path, notes={"steps": 12})
    return path


def rewrite(path, change):
    """Lets `change` edit the header of a file: 8 bytes of length, JSON header, data."""
    raw = path.read_bytes()
    length = struct.unpack("<Q", raw[:8])[0]
    header = json.loads(raw[8 : 8 + length])
    change(header)
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + raw[8 + length :])


def edit_config(path, **changes):
    """Changes settings in a checkpoint's metadata; None removes one."""

    def change(header):
        config = json.loads(header["__metadata__"]["config"]) | changes
        header["__metadata__"]["config"] = json.dumps({k: v for k, v in config.items() if v is not None})

    rewrite(path, change)


def test_round_trip(network, file):
    """A trained network would not be the one that is loaded. Exact."""
    loaded = checkpoint.load(file)
    assert loaded.config == network.config
    assert not loaded.training
    wanted, found = network.state_dict(), loaded.state_dict()
    assert wanted.keys() == found.keys()
    assert all(torch.equal(wanted[name], found[name]) for name in wanted)
    assert checkpoint.read_metadata(file) == (network.config, {"steps": 12})
    assert set(STATISTICS) < set(load_file(file))  # statistics are tensors of the file
    assert ManifoldAwareTransformer.load(file).config == network.config


def test_half_precision_file(network, tmp_path):
    """A shipped bfloat16 file would lose its statistics' digits, or not load. Weights: 8 bits, so 2^-8 relative."""
    path = tmp_path / "half.safetensors"
    network.save(path, dtype=torch.bfloat16)
    stored = load_file(path)
    assert stored["embed_faces.weight"].dtype == torch.bfloat16
    loaded = checkpoint.load(path).state_dict()
    for name, tensor in network.state_dict().items():
        assert loaded[name].dtype == torch.float32
        if name in STATISTICS:
            assert torch.equal(loaded[name], tensor)
        else:
            assert torch.allclose(loaded[name], tensor, rtol=2**-8, atol=1e-30)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.05, 0.5, 0.999])
def test_truncated_file(file, share):
    """A download cut short would load as a network of noise, or end in a stack trace of another library."""
    raw = file.read_bytes()
    file.write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(CheckpointError, match=r"net\.safetensors"):
        checkpoint.load(file)


def test_foreign_files(tmp_path):
    """Some other file would be taken for a network."""
    with pytest.raises(CheckpointError, match="no such file"):
        checkpoint.load(tmp_path / "none.safetensors")
    noise = tmp_path / "noise.safetensors"
    noise.write_bytes(np.random.default_rng(0).bytes(4096))
    with pytest.raises(CheckpointError, match="not a safetensors file"):
        checkpoint.load(noise)
    other = tmp_path / "other.safetensors"
    save_file({"weight": torch.zeros(3)}, other)
    with pytest.raises(CheckpointError, match="no warpgarment network"):
        checkpoint.load(other)


def test_checkpoints_made_before(file):
    """Networks that were saved when `format` said what `kind` says now could no longer be loaded."""

    def older(header):
        header["__metadata__"].pop("kind")
        header["__metadata__"]["format"] = "warpgarment.network"

    wanted = checkpoint.load(file).state_dict()
    rewrite(file, older)
    for name, tensor in checkpoint.load(file).state_dict().items():
        assert torch.equal(tensor, wanted[name])
    rewrite(file, lambda header: header["__metadata__"].update(format="pt"))
    with pytest.raises(CheckpointError, match="no warpgarment network"):
        checkpoint.load(file)


def test_newer_version(file):
    """A file of a later format would be misread."""
    rewrite(file, lambda header: header["__metadata__"].update(format_version="99"))
    with pytest.raises(CheckpointError, match="99"):
        checkpoint.load(file)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"wavelets": 3}, "wavelets"),
        ({"layers": None}, "layers"),
        ({"layers": 3}, r"missing \(first: layers\.2"),
        ({"layers": 1}, r"do not belong .*layers\.1"),
        ({"history": 4}, "embed_faces.weight has shape"),
        ({"heads": 3}, "heads"),
        ({"heads": "two"}, "heads must be int"),
        ({"residual": 1}, "residual must be bool"),
        ({"layers": True}, "layers must be int"),
    ],
)
def test_settings_that_do_not_fit(file, changes, word):
    """A config that does not describe the tensors would give a network that is half random."""
    edit_config(file, **changes)
    with pytest.raises(CheckpointError, match=word):
        checkpoint.load(file)


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("face_head.bias", torch.full((12,), torch.nan), "face_head.bias is not finite"),
        ("q_std", torch.zeros(3), "q_std must be positive"),
        ("face_head.bias", torch.zeros(12, dtype=torch.int32), "face_head.bias is int32"),
        ("face_head.bias", torch.zeros(11), r"face_head.bias has shape \[11\]"),
    ],
)
def test_tensors_that_do_not_fit(file, name, value, word):
    """A diverged or edited network would be simulated with."""
    with safe_open(file, framework="pt") as opened:
        metadata = opened.metadata()
        tensors = {key: opened.get_tensor(key).clone() for key in opened.keys()}
    tensors[name] = value
    save_file(tensors, file, metadata=metadata)
    with pytest.raises(CheckpointError, match=word):
        checkpoint.load(file)


def test_metadata_that_is_not_json(file):
    """A damaged header would end in a stack trace."""
    rewrite(file, lambda header: header["__metadata__"].update(config="{"))
    with pytest.raises(CheckpointError, match="config"):
        checkpoint.load(file)


def test_writing_is_atomic(network, file, monkeypatch):
    """A full disk, or a diverged run, would destroy the last good checkpoint."""
    before = file.read_bytes()

    def full_disk(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        checkpoint.save(network, file)
    monkeypatch.undo()
    with torch.no_grad():
        network.face_head.bias[0] = torch.inf
    with pytest.raises(CheckpointError, match=r"face_head\.bias is not finite"):
        checkpoint.save(network, file)
    assert file.read_bytes() == before
    assert [entry.name for entry in file.parent.iterdir()] == [file.name]


def test_finding_networks(network, file, tmp_path, monkeypatch):
    """`from_pretrained` would load another network than the one named, or not say what there is."""
    shipped = tmp_path / "shipped"
    shipped.mkdir()
    monkeypatch.setattr(checkpoint, "WEIGHTS", shipped)
    with pytest.raises(CheckpointError, match="none in this installation"):
        checkpoint.find("default")
    for name in ("small", "base"):
        network.save(shipped / f"{name}.safetensors")
    with pytest.raises(CheckpointError, match="base, small"):
        checkpoint.find("large")
    (shipped / "default.txt").write_text("base\n", encoding="utf-8")
    assert checkpoint.find("default") == shipped / "base.safetensors"
    assert checkpoint.find("small") == shipped / "small.safetensors"
    assert checkpoint.find(file) == file
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(CheckpointError, match="found none"):
        checkpoint.find(folder)
    network.save(folder / "a.safetensors")
    assert checkpoint.find(str(folder)) == folder / "a.safetensors"
    network.save(folder / "b.safetensors")
    with pytest.raises(CheckpointError, match=r"a\.safetensors, b\.safetensors"):
        checkpoint.find(folder)


def test_unknown_dtype(network, tmp_path):
    """An integer checkpoint would be written and never load."""
    with pytest.raises(ValueError, match="dtype"):
        network.save(tmp_path / "x.safetensors", dtype=torch.int8)
