"""If these failed, an MDD cache would be of other positions or times than its file says, or than others read in it."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest
from support.meshes import capsule

import warpgarment as wg
from warpgarment.cli import main
from warpgarment.io.obj import obj_text

BODY = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2)
FRAMES = BODY.vertices + np.arange(25, dtype=np.float32)[:, None, None] * np.float32([0, 0, 0.01])


def cache(path, times, frames=FRAMES):
    """An MDD file, written by hand from the format's description, and its mesh."""
    head = struct.pack(f">ii{len(times)}f", len(times), frames.shape[1], *times)
    path.write_bytes(head + frames[: len(times)].astype(">f4").tobytes())
    path.with_suffix(".obj").write_text(obj_text(BODY.vertices, BODY.faces))
    return path


@pytest.mark.parametrize("fps", [24000 / 1001, 24, 25, 30000 / 1001, 30, 60, 120, 90])
@pytest.mark.parametrize("number", [0, 1001, -3])
def test_times_are_the_frames(tmp_path, fps, number):
    """Rate and start would be off by the rounding of float32, and frame 1001 be 1000.9997. To 1e-12 of the rate."""
    body = wg.BodyMotion.load(cache(tmp_path / "m.mdd", [(number + k) / fps for k in range(25)]))
    assert body.fps == pytest.approx(fps, rel=1e-12)
    assert body.clock.number == number
    np.testing.assert_array_equal(body.vertices, FRAMES)


def test_what_other_programs_see(tmp_path):
    """The file would be readable here alone: its numbers, unpacked by hand."""
    wg.GarmentMotion(FRAMES, BODY.faces, 24, start=1001 / 24).save(tmp_path / "m.mdd")
    data = (tmp_path / "m.mdd").read_bytes()
    count = FRAMES.shape[1]
    assert struct.unpack_from(">ii", data) == (25, count)
    np.testing.assert_array_equal(np.frombuffer(data, ">f4", 25, 8), np.float32(np.arange(1001, 1026) / 24))
    np.testing.assert_array_equal(np.frombuffer(data, ">f4", offset=108).reshape(25, count, 3), FRAMES)
    assert len(data) == 8 + 4 * 25 + 12 * 25 * count


@pytest.mark.parametrize("load", [wg.BodyMotion.load, wg.GarmentMotion.load])
def test_times_that_are_none_are_said(tmp_path, load):
    """Uneven or shuffled times would be played as even ones, unsaid. A cache whose times are all zero has no rate."""
    for times in ([0, 0.1, 0.5, 0.6], [0, 0.2, 0.1, 0.3], [3, 2, 1, 0], [0, np.nan, 1, 2], [0, 1, 2, np.inf]):
        path = cache(tmp_path / "m.mdd", times)
        with pytest.warns(UserWarning, match="not evenly spaced in time") as said:
            assert load(path, fps=25).fps == 25
        assert len(said) == 1
    with pytest.warns(UserWarning, match="the file has no rate; 30 frames"):
        assert load(cache(tmp_path / "m.mdd", [0.0] * 4)).fps == 30
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load(cache(tmp_path / "m.mdd", [2.5])).start == 2.5


def test_damaged_headers_ask_for_no_memory(tmp_path):
    """A header of noise would ask for all memory there is, or for arrays of a negative size."""
    path = cache(tmp_path / "m.mdd", [0, 1])
    for frames, points in ((2**31 - 1, 2**31 - 1), (-1, 5), (5, -1), (0, 3), (3, 0), (-(2**31), -(2**31))):
        path.write_bytes(struct.pack(">ii", frames, points) + bytes(1000))
        with pytest.raises(wg.MeshError, match=r"m\.mdd: 1,008 bytes where .* is no MDD file, or it is damaged"):
            wg.BodyMotion.load(path)


def test_on_the_command_line(tmp_path, capsys):
    """A cache would be converted at another rate, or written over the mesh that is read."""
    path = cache(tmp_path / "m.mdd", [k / 60 for k in range(25)])
    assert main(["convert", str(path), str(tmp_path / "a.npz")]) == 0
    assert wg.BodyMotion.load(tmp_path / "a.npz").fps == 60
    assert main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.mdd")]) == 0
    assert (tmp_path / "b.mdd").read_bytes() == path.read_bytes()
    before = path.with_suffix(".obj").read_bytes()
    assert main(["convert", str(path.with_suffix(".obj")), str(path)]) == 2
    assert "the mesh of a .mdd, its first frame, would be written over it" in capsys.readouterr().err
    assert path.with_suffix(".obj").read_bytes() == before
