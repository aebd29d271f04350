"""If these failed, a shot of frames 1001 to 1025 would come back at frames 0 to 24, or at another speed."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from support.meshes import capsule

import warpgarment as wg
from warpgarment.io.obj import obj_text
from warpgarment.io.usd import read_usd

BODY = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2)
FRAMES = BODY.vertices + np.arange(25, dtype=np.float32)[:, None, None] * np.float32([0, 0, 0.01])
RATES = (23.976, 24, 25, 29.97, 30, 59.94, 60, 120)
kinds = pytest.mark.parametrize("kind", [wg.BodyMotion, wg.GarmentMotion])


@kinds
@pytest.mark.parametrize("name", ["m.npz", "m.usda", "m.usdc", "m.abc", "m.pc2", "folder"])
@pytest.mark.parametrize("fps", RATES)
def test_every_format_says_when_the_motion_starts(tmp_path, kind, name, fps):
    """Frame 1001 would be frame 0 of the next program. In seconds, to a hundredth of a frame."""
    motion = kind(FRAMES[:4], BODY.faces, fps, start=1001 / fps)
    motion.save(tmp_path / name)
    back = kind.load(tmp_path / name, fps=fps if name in ("m.pc2", "folder") else None)
    assert (back.frames, back.fps) == (4, pytest.approx(fps, rel=1e-9))
    np.testing.assert_allclose(back.clock.times, motion.clock.times, atol=0.01 / fps)
    back.save(tmp_path / f"again_{name}")
    again = kind.load(tmp_path / f"again_{name}", fps=fps if name in ("m.pc2", "folder") else None)
    assert again.start == pytest.approx(back.start, abs=1e-9)


def test_what_other_programs_see(tmp_path):
    """Only this project would find the start where it wrote it: read by USD, by hand from the header of a point cache,
    and from the names of files."""
    motion = wg.GarmentMotion(FRAMES, BODY.faces, 24, start=1001 / 24)
    motion.save(tmp_path / "m.usda")
    stage = Usd.Stage.Open(str(tmp_path / "m.usda"))
    mesh = next(p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    assert mesh.GetAttribute("points").GetTimeSamples() == [float(n) for n in range(1001, 1026)]
    assert mesh.GetAttribute("extent").GetTimeSamples() == [float(n) for n in range(1001, 1026)]
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (1001, 1025, 24)
    motion.save(tmp_path / "m.pc2")
    assert struct.unpack_from("<12siiffi", (tmp_path / "m.pc2").read_bytes())[3:] == (1001.0, 1.0, 25)
    motion.save(tmp_path / "folder")
    names = sorted(p.name for p in (tmp_path / "folder").iterdir())
    assert (names[0], names[-1], len(names)) == ("frame_1001.obj", "frame_1025.obj", 25)
    motion.save(tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as arrays:
        assert (float(arrays["start"]), float(arrays["fps"])) == (1001 / 24, 24.0)
    wg.GarmentMotion(FRAMES[:3], BODY.faces).save(tmp_path / "zero")
    assert sorted(p.name for p in (tmp_path / "zero").iterdir())[0] == "frame_0000.obj"


def test_between_the_frames_of_a_rate(tmp_path):
    """A result at the network's rate begins between two of its frames: USD and point caches say so, files have whole
    numbers, and the difference would go unsaid."""
    motion = wg.GarmentMotion(FRAMES, BODY.faces, 24, start=1001 / 24).resampled(30)
    for name in ("m.usda", "m.pc2"):
        motion.save(tmp_path / name)
        assert wg.BodyMotion.load(tmp_path / name, fps=30).start == pytest.approx(1001 / 24, abs=1e-6)
    with pytest.warns(UserWarning, match=r"starts at frame 1251\.25 of 30 a second; files have whole numbers"):
        motion.save(tmp_path / "folder")
    assert (tmp_path / "folder" / "frame_1251.obj").exists()
    before = wg.GarmentMotion(FRAMES, BODY.faces, 24, start=-2 / 24)
    with pytest.warns(UserWarning, match="starts at frame -2 of 24"):
        before.save(tmp_path / "before")
    assert (tmp_path / "before" / "frame_0000.obj").exists()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before.save(tmp_path / "before.usda")
        before.save(tmp_path / "before.pc2")
    assert wg.BodyMotion.load(tmp_path / "before.usda").start == pytest.approx(-2 / 24)
    assert wg.BodyMotion.load(tmp_path / "before.pc2", fps=24).start == pytest.approx(-2 / 24)


@kinds
def test_an_archive_keeps_the_end_between_two_frames(tmp_path, kind):
    """24 frames would be 25 after a result was written at 30 frames a second and read again."""
    motion = kind(FRAMES[:24], BODY.faces, 24, start=3.25)
    motion.resampled(30).save(tmp_path / "m.npz")
    back = kind.load(tmp_path / "m.npz")
    assert (back.frames, back.start, back.last) == (30, 3.25, pytest.approx(28.75))
    assert back.resampled(24).frames == 24
    assert np.array_equal(back.resampled(24).vertices[-1], FRAMES[23])


def test_frames_keep_their_numbers_at_a_rate_that_is_given(tmp_path):
    """With --body-fps, frame 1001 of a file would become another one: numbers are frames, `start` is seconds."""
    motion = wg.BodyMotion(FRAMES, BODY.faces, 24, start=1001 / 24)
    for name in ("m.usda", "m.pc2", "folder"):
        motion.save(tmp_path / name)
        assert wg.BodyMotion.load(tmp_path / name, fps=25).clock.number == 1001
    motion.save(tmp_path / "m.npz")
    assert wg.BodyMotion.load(tmp_path / "m.npz", fps=25).start == 1001 / 24
    np.savez(tmp_path / "n.npz", vertices=FRAMES, faces=BODY.faces, start_frame=1001, fps=24)
    assert wg.BodyMotion.load(tmp_path / "n.npz").start == 1001 / 24


def test_a_cache_of_every_second_frame_starts_where_it_says(tmp_path):
    """Start and sampling of a point cache would be mixed up: frame 1001 of 24 a second, samples two frames apart."""
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, FRAMES.shape[1], 1001.0, 2.0, len(FRAMES))
    (tmp_path / "m.pc2").write_bytes(head + FRAMES.astype("<f4").tobytes())
    (tmp_path / "m.obj").write_text(obj_text(BODY.vertices, BODY.faces))
    body = wg.BodyMotion.load(tmp_path / "m.pc2", fps=24)
    np.testing.assert_allclose(body.clock.times, np.arange(1001, 1051, 2) / 24, atol=1e-9)


def test_a_single_frame_has_its_time(tmp_path):
    """A pose at frame 1001 of a stage would be one at 0."""
    wg.BodyMotion(FRAMES[:1], BODY.faces, 24, start=1001 / 24).save(tmp_path / "m.usda")
    assert read_usd(tmp_path / "m.usda").fps is None
    assert wg.BodyMotion.load(tmp_path / "m.usda").start == pytest.approx(1001 / 24)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, "soon", [1.0, 2.0]])
def test_starts_that_are_none(tmp_path, value):
    """A damaged file would be a motion at no time."""
    np.savez(tmp_path / "m.npz", vertices=FRAMES, faces=BODY.faces, fps=24.0, start=value)
    with pytest.raises(wg.MeshError, match=r"m\.npz: start must be"):
        wg.BodyMotion.load(tmp_path / "m.npz")
    with pytest.raises(wg.MeshError, match=r"m\.npz: start must be"):
        wg.GarmentMotion.load(tmp_path / "m.npz")
