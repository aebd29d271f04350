"""If these failed, a result would lie beside its shot in time, and a picture show garment and body at two moments."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from PIL import Image
from pxr import Usd, UsdGeom
from support.meshes import capsule, skirt

import warpgarment as wg
from warpgarment.cli import main

BODY, CLOTH = capsule((0, 0.2, 0), (0, 1.5, 0), 0.18), skirt(16, 6)


def walk(mesh, frames, fps, speed=0.5, start=0.0):
    """A mesh on its way along X, and where it is depends on the time alone."""
    times = start + np.arange(frames) / fps
    moved = mesh.vertices + np.float32(times[:, None, None] * [speed, 0, 0])
    return wg.BodyMotion(moved, mesh.faces, fps, start=start)


@pytest.fixture
def shot(tmp_path):
    """A body at frames 1001 to 1007 of 24 a second, and a skirt."""
    wg.BodyMotion(walk(BODY, 7, 24).vertices, BODY.faces, 24, start=1001 / 24).save(tmp_path / "shot.usda")
    wg.Garment(CLOTH.vertices, CLOTH.faces).save(tmp_path / "skirt.obj")
    return tmp_path


def simulate(folder, out, *more):
    paths = [str(folder / "skirt.obj"), str(folder / "shot.usda"), "--out", str(folder / out)]
    return main(["simulate", *paths, "--device", "cpu", *more])


def test_a_result_lies_in_its_shot(shot, capsys):
    """Every format: one frame of garment for each of the shot's, at its time code, header, name or second."""
    assert simulate(shot, "out.usda") == 0
    assert "7 frames, 1001 to 1007 at 24 a second (41.708 to 41.958 s)" in capsys.readouterr().out
    stage = Usd.Stage.Open(str(shot / "out.usda"))
    mesh = next(p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    assert mesh.GetAttribute("points").GetTimeSamples() == [float(n) for n in range(1001, 1008)]
    assert stage.GetTimeCodesPerSecond() == 24
    assert simulate(shot, "out.pc2") == 0
    assert struct.unpack_from("<12siiffi", (shot / "out.pc2").read_bytes())[3:] == (1001.0, 1.0, 7)
    assert simulate(shot, "frames/") == 0
    assert sorted(p.name for p in (shot / "frames").iterdir()) == [f"frame_{n}.obj" for n in range(1001, 1008)]
    assert simulate(shot, "out.npz") == 0
    back = wg.GarmentMotion.load(shot / "out.npz")
    assert (back.frames, back.fps, back.start, len(back.status)) == (7, 24.0, 1001 / 24, 7)


@pytest.mark.parametrize(("said", "fps", "frames"), [
    ("body", 24, 7), ("24", 24, 7), ("network", 30, 9), ("30", 30, 9), ("48", 48, 13), ("23.976", 23.976, 7),
])  # fmt: skip
def test_rates_of_results(shot, said, fps, frames):
    """A rate that was asked for would not be had, or the end of the shot be cut: it ends at 0.25 s, 1007 of 24."""
    assert simulate(shot, "out.npz", "--out-fps", said) == 0
    back = wg.GarmentMotion.load(shot / "out.npz")
    assert (back.fps, back.frames, back.start) == (fps, frames, 1001 / 24)
    assert back.clock.end == pytest.approx(1007 / 24, abs=1e-9)


@pytest.mark.parametrize("rate", ["0", "-24", "nan", "inf"])
def test_rates_that_are_none(shot, capsys, rate):
    """A mistyped rate would end in a traceback, or after the simulation."""
    assert simulate(shot, "out.npz", f"--out-fps={rate}") == 2
    assert f"--out-fps {rate}: a positive number" in capsys.readouterr().err


def test_converting_keeps_the_time(shot, capsys):
    """A converted motion would begin at 0, or lose its end."""
    assert main(["convert", str(shot / "shot.usda"), str(shot / "a.npz"), "--fps", "30"]) == 0
    assert main(["convert", str(shot / "a.npz"), str(shot / "b.usda"), "--fps", "24"]) == 0
    first, back = wg.BodyMotion.load(shot / "shot.usda"), wg.BodyMotion.load(shot / "b.usda")
    assert np.array_equal(back.clock.times, first.clock.times)
    assert np.array_equal(back.vertices[[0, -1]], first.vertices[[0, -1]])
    assert main(["convert", str(shot / "a.npz"), str(shot / "c/")]) == 0
    assert "starts at frame 1251.25 of 30 a second" in capsys.readouterr().err


def picture(path):
    return np.asarray(Image.open(path).convert("RGB"), int)


def view(folder, out, garment, body, *more):
    arguments = ["view", str(folder / garment), "--body", str(folder / body), "--frames", "3", "--size", "200", "240"]
    return main([*arguments, "--out", str(folder / out), *more])


def test_view_shows_one_moment(tmp_path, capsys):
    """The dress would be metres behind its body: the sheet is the one of the same body at the garment's rate, whatever
    the rate and the start of the body. Less than 1 % of the pixels by more than a tenth of their range."""
    walk(CLOTH, 31, 30, 1.5).save(tmp_path / "skirt.npz")
    walk(BODY, 31, 30, 1.5).save(tmp_path / "same.npz")
    walk(BODY, 61, 60, 1.5).save(tmp_path / "fine.npz")
    walk(BODY, 25, 24, 1.5).save(tmp_path / "film.npz")
    walk(BODY, 91, 60, 1.5, start=-0.25).save(tmp_path / "early.npz")
    assert view(tmp_path, "same.png", "skirt.npz", "same.npz") == 0
    for name in ("fine", "film", "early"):
        assert view(tmp_path, f"{name}.png", "skirt.npz", f"{name}.npz") == 0
        off = np.abs(picture(tmp_path / f"{name}.png") - picture(tmp_path / "same.png")).max(axis=-1)
        assert (off > 25).mean() < 0.01, name
    assert "shown is what all have" not in capsys.readouterr().out


def test_view_shows_what_both_have(tmp_path, capsys):
    """A garment of the first frames would hang in the air while its body walks away. A body of a single frame stays."""
    walk(CLOTH, 31, 30, 1.5).save(tmp_path / "skirt.npz")
    walk(BODY, 61, 60, 1.5).save(tmp_path / "body.npz")
    walk(BODY, 40, 60, 1.5, start=0.5).save(tmp_path / "late.npz")
    walk(CLOTH, 16, 30, 1.5).save(tmp_path / "half.npz")
    walk(BODY, 16, 30, 1.5).save(tmp_path / "half_body.npz")
    assert view(tmp_path, "a.png", "half.npz", "body.npz") == 0
    assert view(tmp_path, "b.png", "half.npz", "half_body.npz") == 0
    assert (np.abs(picture(tmp_path / "a.png") - picture(tmp_path / "b.png")).max(axis=-1) > 25).mean() < 0.01
    capsys.readouterr()
    assert view(tmp_path, "c.png", "skirt.npz", "late.npz") == 0
    assert "16 frames, 15 to 30 at 30 a second (0.500 to 1.000 s), of 31 frames" in capsys.readouterr().out
    walk(BODY, 1, 30).save(tmp_path / "stays.npz")
    assert view(tmp_path, "d.png", "skirt.npz", "stays.npz") == 0
    assert picture(tmp_path / "d.png").shape == picture(tmp_path / "c.png").shape
    assert "shown is what all have" not in capsys.readouterr().out


def test_view_refuses_what_has_no_moment_in_common(tmp_path, capsys):
    """A garment of frame 1001 would be shown on a body of frame 0: the message names both, and what to say."""
    walk(CLOTH, 7, 30).save(tmp_path / "skirt.npz")
    wg.BodyMotion(walk(BODY, 7, 24).vertices, BODY.faces, 24, start=1001 / 24).save(tmp_path / "shot.usda")
    assert view(tmp_path, "a.png", "skirt.npz", "shot.usda") == 2
    said = capsys.readouterr().err
    assert "no frame in common: " in said
    assert "skirt.npz has 7 frames, 0 to 6 at 30 a second" in said
    assert "shot.usda has 7 frames, 1001 to 1007 at 24 a second (41.708 to 41.958 s)" in said
    assert "Are --fps, --start, --body-fps and --body-start right?" in said
    assert not (tmp_path / "a.png").exists()
    assert view(tmp_path, "a.png", "skirt.npz", "shot.usda", "--start", str(1001 / 24)) == 0
    assert view(tmp_path, "a.png", "skirt.npz", "shot.usda", "--body-start", "0") == 0
    assert view(tmp_path, "a.png", "skirt.npz", "shot.usda", "--body-start", "nan") == 2
