"""Manifests that others wrote: entries of another kind are named, by every command that reads them."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from warpgarment.errors import MeshError
from warpgarment.training.data.schema import MOST_PLANNED, SEQUENCE, SET, faults
from warpgarment.training.data.sequence import list_sequences, read_array, read_manifest
from warpgarment.training.data.set_manifest import planned_numbers, read_set_manifest
from warpgarment.training.data.verify import check_sequence, verify

GOOD = {
    "status": "good", "reason": None, "split": "test", "motion": "walk", "garment": "skirt", "category": "skirt",
    "body": {"kind": "anny", "age": 0.4, "scale": None}, "seed": 3, "number": 12, "fps": 29.97, "frames": 4,
    "figures": {"step_max": 0.25}, "versions": {"numpy": "2.0", "bpy": None}, "checksums": {"pins.npy": "ab"},
    "garments": [{"name": "a", "category": "b", "material": {"bend": 1e-5, "name": "silk"}}],
    "rejected_attempts": [{"status": "rejected", "reason": "frame 3", "figures": {"step_max": float("nan")}}],
}  # fmt: skip


def test_what_is_written_is_right():
    """A manifest as `generate` writes it would be refused."""
    assert faults(GOOD, SEQUENCE) == {}
    common = {
        "configuration": {"recipe": "a", "seed": 1, "held_out": ["b"]},
        "teacher": {"x": [1]},
        "numbers": [[0, 4]],
    }
    assert faults(common, SET) == {}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("status", ["good"]), ("split", {"train": 1}), ("split", "dev"), ("motion", None), ("garment", 4),
        ("category", ["x"]), ("body", 7), ("body", {"kind": ["x"]}), ("seed", [1]), ("seed", True), ("number", 1.5),
        ("number", "12"), ("fps", 0), ("fps", float("inf")), ("fps", 10**400), ("fps", True), ("frames", -1),
        ("frames", 10**12), ("frames", 4.0), ("figures", "none"), ("figures", {"a": [1]}), ("versions", {"a": 3}),
        ("garments", {"a": 1}), ("garments", [{"name": 3}]), ("garments", [{"material": {"bend": {}}}]),
        ("rejected_attempts", {}), ("rejected_attempts", [{"figures": 3}]), ("checksums", {"../x.npy": "ab"}),
        ("checksums", {"pins.npy": 3}), ("checksums", []),
    ],
)  # fmt: skip
def test_entries_of_another_kind(tmp_path, key, value):
    """A card, a training run or an evaluation would end in a TypeError in the middle."""
    folder = tmp_path / "set" / "a"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps(GOOD | {key: value}))
    with pytest.raises(MeshError, match=rf"manifest.json: says .* for {key}, which must be "):
        read_manifest(folder)
    with pytest.raises(MeshError, match=f"for {key}"):
        list_sequences(tmp_path / "set")
    told = [problem.what for problem in check_sequence(folder).problems]
    assert any(key in what for what in told)


@pytest.mark.parametrize(
    "content",
    [
        {"configuration": 4}, {"configuration": {"recipe": ["x"]}}, {"configuration": {"seed": "3"}},
        {"configuration": {"held_out": [{}]}}, {"configuration": {"teacher": {}}}, {"teacher": "newton"},
        {"versions": {"numpy": [2]}}, {"command": ["x"]}, {"numbers": {}}, {"numbers": [[1, 2, 3]]},
        {"numbers": [[3, 1]]}, {"numbers": [[-4, 1]]}, {"numbers": [[0.0, 1.0]]}, {"numbers": [[0, MOST_PLANNED]]},
        {"numbers": [[0, MOST_PLANNED // 2], [0, MOST_PLANNED // 2]]}, {"numbers": [[True, True]]},
    ],
)  # fmt: skip
def test_set_manifest(tmp_path, content):
    """`verify` would end in an error of Python, or list a thousand million numbers."""
    (tmp_path / "set.json").write_text(json.dumps(content))
    with pytest.raises(MeshError, match=f"set.json: says .* for {next(iter(content))}"):
        read_set_manifest(tmp_path)
    assert next(problem.where for problem in verify(tmp_path).problems) == "set.json"


def test_planned_numbers(tmp_path):
    """A set of the largest size would be refused. Exact."""
    (tmp_path / "set.json").write_text(json.dumps({"numbers": [[0, 9], [20, MOST_PLANNED + 9]]}))
    assert len(planned_numbers(read_set_manifest(tmp_path))) == MOST_PLANNED


def test_manifests_that_are_no_files(tmp_path):
    """A pipe in the place of a manifest would be waited for."""
    (tmp_path / "a").mkdir()
    os.mkfifo(tmp_path / "a" / "manifest.json")
    os.mkfifo(tmp_path / "set.json")
    assert sorted(problem.where for problem in verify(tmp_path).problems) == ["a", "set.json"]


def test_arrays_of_another_size(tmp_path):
    """An array with bytes behind its end, or 2 GB that are a hole in the disk, would be read."""
    np.save(tmp_path / "pins.npy", np.zeros(3, np.int32))
    with open(tmp_path / "pins.npy", "ab") as file:
        file.write(b"more")
    with pytest.raises(MeshError, match=r"pins.npy cannot be read \(it has 144 bytes, its header says 140\)"):
        read_array(tmp_path, "pins")
    shape = (1 << 29, 3)
    with open(tmp_path / "pins.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<i4", "fortran_order": False, "shape": shape})
        file.truncate(file.tell() + 12 * shape[0])
    with pytest.raises(MeshError, match=r"pins\.npy has 6,442,450,944 bytes, at most 1,073,741,824"):
        read_array(tmp_path, "pins")
