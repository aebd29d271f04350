"""Every reader opens plain files alone: a pipe under any suffix is refused by name, and never waited for."""

from __future__ import annotations

import os
import struct

import pytest

from warpgarment.bodies.amass import amass_length, read_amass
from warpgarment.bodies.bvh import bvh_length, read_bvh
from warpgarment.bodies.clips import list_clips
from warpgarment.bodies.rest import RestBody
from warpgarment.errors import CheckpointError, MeshError
from warpgarment.io.disk.plain import read_plain
from warpgarment.io.files import FORMATS, read_mesh, read_motion
from warpgarment.io.pc2 import SIGNATURE
from warpgarment.nn import checkpoint, shards
from warpgarment.training.evaluate.model_card import CardError, read_evaluation, read_log
from warpgarment.training.readers.formats import detect
from warpgarment.training.readers.matlab import read_mat
from warpgarment.training.readers.pc16 import read_pc16
from warpgarment.training.readers.unpickle import read_pickle

SUFFIXES = [suffix for every in FORMATS for suffix in every if suffix]


@pytest.fixture
def pipe(tmp_path):
    """Makes a named pipe, at which a reader would wait for ever."""

    def make(name: str):
        os.mkfifo(tmp_path / name)
        return tmp_path / name

    return make


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_formats(pipe, suffix):
    """`simulate` would wait for ever for a garment or a body."""
    path = pipe(f"a{suffix}")
    for read in (read_mesh, read_motion):
        with pytest.raises(MeshError, match=r"is a pipe, not a plain file|cannot read \.pc2 as a mesh"):
            read(path)


def test_files_beside(pipe, tmp_path):
    """The file that is named is plain, and the one that it needs beside it is waited for."""
    pipe("a.obj")
    (tmp_path / "a.pc2").write_bytes(struct.pack("<12siiffi", SIGNATURE, 1, 1, 0, 1, 1) + bytes(12))
    pipe("b.bin")
    text = '{"asset": {"version": "2.0"}, "buffers": [{"uri": "b.bin", "byteLength": 4}]}'
    (tmp_path / "b.gltf").write_text(text)
    (tmp_path / "folder").mkdir()
    pipe("folder/c.obj")
    for name, message in (("a.pc2", "is a pipe"), ("folder", "is a pipe"), ("b.gltf", "is not in its folder")):
        with pytest.raises(MeshError, match=message):
            read_motion(tmp_path / name)


def test_readers_of_training(pipe, tmp_path):
    """`generate --motions`, `dataset import` or a page would wait for ever."""
    path = pipe("a.npz")
    readers = (read_amass, amass_length, read_bvh, bvh_length, read_pc16, read_pickle, RestBody.load, read_log, detect)
    for read in (*readers, lambda path: read_mat(path, ("poses",)), read_plain):
        with pytest.raises(MeshError, match="is a pipe, not a plain file"):
            read(path)
    with pytest.raises(CardError, match="is a pipe"):
        read_evaluation(path, {}, {})
    assert list_clips(tmp_path) == []


def test_checkpoints(pipe, tmp_path):
    """A folder of a network would be waited for: safetensors opens by name whatever is there."""
    pipe("a.safetensors")
    for path in (tmp_path, tmp_path / "a.safetensors"):
        with pytest.raises(CheckpointError, match=r"is a pipe|no such file"):
            checkpoint.load(path)
    pipe(shards.INDEX)
    with pytest.raises(CheckpointError, match=r"is a pipe|no such file"):
        checkpoint.load(tmp_path)
