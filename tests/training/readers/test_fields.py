"""Fields of recordings: finite numbers, or an error that names the file and the field."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from warpgarment.errors import MeshError
from warpgarment.training.readers.dlayers import MOST_FRAMES, read_dlayers
from warpgarment.training.readers.fields import betas, number, numbers
from warpgarment.training.readers.vto import read_vto


@pytest.mark.parametrize(
    "value", ["1", b"1", None, {}, [], [[1], [1, 2]], [1, "a"], [10**400], np.zeros((2, 2, 2)), np.array([{}]), [True]]
)
def test_no_numbers(value):
    """What is no array of numbers would be an error of NumPy, without file and field."""
    with pytest.raises(MeshError, match=r"^a\.pkl: pose must be numbers"):
        numbers("a.pkl: pose", value, (1, 2))


def test_numbers():
    """Good fields would be refused. Exact."""
    assert numbers("a", [1, 2.5]).tolist() == [1.0, 2.5]
    assert betas("a", np.ones((4, 10)), 4).shape == (10,)
    assert betas("a", np.arange(8).reshape(4, 2), 4).shape == (4, 2)
    assert number("a", 3) == 3.0
    with pytest.raises(MeshError, match=r"^a holds NaN"):
        numbers("a", [1.0, np.nan])
    with pytest.raises(MeshError, match="T = 4"):
        betas("a", np.ones((3, 10)), 4)
    for value in (10**500, "3", None, True, float("nan"), -1e300):
        with pytest.raises(MeshError, match=r"^a must be a number"):
            number("a", value)


@pytest.fixture
def sample(tmp_path):
    """A D-LAYERS sample of one triangle in three frames: its folder, and a function that writes its description."""
    folder = tmp_path / "data" / "7"
    folder.mkdir(parents=True)
    (tmp_path / "motion").mkdir()
    shape = np.array([[0.0, 0, 0], [5, 0, 0], [0, 5, 0]])
    garment = {"vertices": np.repeat(shape[None], 3, 0), "faces": np.array([[0, 1, 2]]), "tpose": shape}
    (folder / "top.pkl").write_bytes(pickle.dumps(garment))
    (tmp_path / "motion" / "a.pkl").write_bytes(pickle.dumps({"poses": np.zeros((1, 72)), "trans": np.zeros((1, 3))}))
    human = {"motion_path": "motion/a.pkl", "seq_start": 0, "seq_end": 3, "frame_start": 0, "scale": 10}

    def write(wind=(), **changes):
        meta = {"human": human | changes, "garment": [{"name": "top"}], "wind": list(wind)}
        (folder / "meta.json").write_text(json.dumps(meta))
        return folder

    return write


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motion_path": "motion/../../b.pkl"}, "human.motion_path is .* leads out of"),
        ({"motion_path": "/etc/hostname"}, "human.motion_path is .* absolute"),
        ({"motion_path": ["a"]}, "human.motion_path must be the name of a file"),
        ({"betas": {"a": 1}}, "human.betas must be numbers"),
        ({"betas": [float("nan")]}, "human.betas holds NaN"),
        ({"seq_end": 10**300}, "human.seq_end must be a number"),
        ({"seq_end": MOST_FRAMES + 1}, "frames 0 to 100,001: at most 100,000"),
        ({"wind": [{"pivot_list": [3]}]}, "'wind' must have a 'pivot_list'"),
        ({"wind": [{"pivot_list": [{"frame_start": "1"}]}]}, r"pivot_list\[0\].frame_start must be a number"),
        (
            {"wind": [{"pivot_list": [{"frame_start": 1, "rotation_quaternion": [0, 0, 0, 0], "strength": 1}]}]},
            r"pivot_list\[0\].rotation_quaternion must be four",
        ),
    ],
)
def test_dlayers_fields(sample, changes, message):
    """A field of another kind would be an error of Python, or a file elsewhere on the disk be opened."""
    assert len(read_dlayers(sample()).garments) == 1
    with pytest.raises(MeshError, match=rf"meta\.json.*{message}"):
        read_dlayers(sample(**changes))


def test_dlayers_array_named_many_times(sample):
    """One array that a file names 30,000 times would be as many copies in memory."""
    folder = sample()
    data = {"vertices": [np.zeros((2000, 3))] * 30_000, "faces": np.array([[0, 1, 2]]), "tpose": np.zeros((2000, 3))}
    (folder / "top.pkl").write_bytes(pickle.dumps(data))
    with pytest.raises(MeshError, match="'vertices' is a list of 1,440,000,000 bytes"):
        read_dlayers(folder)


def test_dlayers_link_out_of_the_set(sample, tmp_path_factory):
    """A link in a data set would open a file elsewhere on the disk."""
    folder = sample(motion_path="motion/b.pkl")
    other = tmp_path_factory.mktemp("other") / "b.pkl"
    other.write_bytes(b"")
    (folder.parent.parent / "motion" / "b.pkl").symlink_to(other)
    with pytest.raises(MeshError, match="leads out of"):
        read_dlayers(folder)


def test_vto_fields(tmp_path):
    """A rest shape or shape that is no array of numbers would be an error of NumPy."""
    shape = np.array([[0.0, 0, 0], [5, 0, 0], [0, 5, 0]])
    good = {"vertices": shape[None], "faces": np.array([[0, 1, 2]]), "pose": np.zeros((1, 72)), "rest_vertices": shape}
    good["translation"] = np.zeros((1, 3))
    for key, value in (("shape", [["a"]]), ("shapes", np.zeros((2, 10))), ("rest_vertices", "x")):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(good | {key: value}))
        with pytest.raises(MeshError, match=rf"a\.pkl: {key} must be"):
            read_vto(tmp_path / "a.pkl")
