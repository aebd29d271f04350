"""If these failed, results would be written half, read back changed, or open wrongly in other programs."""

import os
import re
import struct

import numpy as np
import pytest
import trimesh

import warpgarment as wg
from warpgarment.io import obj
from warpgarment.io.disk import atomic
from warpgarment.io.usd import read_usd, write_usd


def motion(frames=5, fps=24.0, name="shirt"):
    mesh = trimesh.creation.icosphere(1)
    vertices = mesh.vertices[None] / 3 + np.random.default_rng(0).normal(0, 0.1, (frames, 42, 3))
    status = [wg.RolloutStatus.judged(t, t < 4, 0.004 * t, 10 + t, 20 + t) for t in range(frames)]
    return wg.GarmentMotion(vertices, mesh.faces, fps, status, name)


def test_verdicts_follow_from_the_figures_and_name_a_remedy():
    """A frame that went wrong would be called fine."""
    verdicts = [s.verdict for s in motion().status]
    assert verdicts == [wg.Verdict.OK] * 3 + [wg.Verdict.PENETRATING, wg.Verdict.NOT_FINITE]
    assert "wg.fit" in wg.Verdict.PENETRATING.message
    assert "wg.dress" in wg.Verdict.PENETRATING.message
    assert motion().status[4].message.startswith("Frame 4: ")


def test_npz_gives_everything_back(tmp_path):
    """Positions, status or the rate would be lost between a rollout and its evaluation."""
    result = motion()
    result.vertices[4] = np.nan
    result.save(tmp_path / "deep" / "r.npz")
    back = wg.GarmentMotion.load(tmp_path / "deep" / "r.npz")
    np.testing.assert_array_equal(back.vertices, result.vertices)
    np.testing.assert_array_equal(back.faces, result.faces)
    assert (back.fps, back.status, back.name) == (24.0, result.status, "shirt")
    bare = wg.GarmentMotion(result.vertices, result.faces)
    bare.save(tmp_path / "bare.npz")
    assert wg.GarmentMotion.load(tmp_path / "bare.npz").status == []


@pytest.mark.parametrize("target", ["m.npz", "m.usd", "m.usda", "m.usdc", "m.pc2", "m.mdd", "m.abc", "folder"])
def test_every_format_reads_back_bit_for_bit(tmp_path, target):
    """Float32 positions would be rounded or reordered in a format."""
    result = motion(frames=12)
    result.save(tmp_path / target)
    result.save(tmp_path / target)  # a second time: replaces the first
    back = wg.BodyMotion.load(tmp_path / target)
    np.testing.assert_array_equal(back.vertices, result.vertices)
    np.testing.assert_array_equal(back.faces, result.faces)
    assert back.fps == (24.0 if target not in ("m.pc2", "folder") else 30.0)
    wg.BodyMotion(back.vertices, back.faces, 24.0).save(tmp_path / f"again_{target}")
    assert not [p for p in tmp_path.rglob("*") if "partial" in p.name]


@pytest.mark.parametrize("target", ["m.npz", "m.usd", "m.usda", "m.usdc", "m.pc2", "m.mdd", "m.abc", "folder"])
def test_a_garment_motion_reads_back_what_it_saved(tmp_path, target):
    """A result that was written for another program cannot be measured any more: bit for bit, with the rate where the
    format has one, and in another unit or at another rate where asked."""
    result = motion(frames=12)
    result.save(tmp_path / target)
    back = wg.GarmentMotion.load(tmp_path / target)
    np.testing.assert_array_equal(back.vertices, result.vertices)
    np.testing.assert_array_equal(back.faces, result.faces)
    assert back.fps == (24.0 if target not in ("m.pc2", "folder") else 30.0)
    kept = (result.status, "shirt") if target == "m.npz" else ([], target.partition(".")[0])
    assert (back.status, back.name) == kept
    back.save(tmp_path / f"again_{target}")
    small = wg.GarmentMotion.load(tmp_path / target, unit="cm", fps=12)
    np.testing.assert_allclose(small.vertices, result.vertices / 100, rtol=1e-6)
    assert small.fps == 12.0


@pytest.mark.parametrize("target", ["m.npz", "m.usdc", "m.pc2", "m.mdd", "m.abc", "folder"])
def test_a_rollout_that_failed_reads_back(tmp_path, target):
    """A result that ends in NaN, as one that went wrong does, can be written but not read."""
    result = motion()
    result.vertices[4] = np.nan
    result.save(tmp_path / target)
    np.testing.assert_array_equal(wg.GarmentMotion.load(tmp_path / target).vertices, result.vertices)


def test_what_is_no_motion_is_named(tmp_path):
    """A wrong path ends in another library's traceback."""
    (tmp_path / "m.pc2").write_bytes(b"POINTCACHE2")
    (tmp_path / "m.txt").write_text("")
    for name, error in (("m.pc2", wg.MeshError), ("m.txt", wg.MeshError), ("none.usd", FileNotFoundError)):
        with pytest.raises(error, match=name.replace(".", r"\.")):
            wg.GarmentMotion.load(tmp_path / name)


def test_pc2_bytes_are_those_of_the_format(tmp_path):
    """Blender would not read the cache: signature, version, counts and order, unpacked by hand."""
    result = motion()
    result.save(tmp_path / "m.pc2")
    data = (tmp_path / "m.pc2").read_bytes()
    assert struct.unpack("<12siiffi", data[:32]) == (b"POINTCACHE2\0", 1, 42, 0.0, 1.0, 5)
    np.testing.assert_array_equal(np.frombuffer(data[32:], "<f4").reshape(5, 42, 3), result.vertices)
    np.testing.assert_array_equal(wg.Garment.load(tmp_path / "m.obj").vertices, result.vertices[0])
    for broken in (data[:-4], data[:20], b"x" + data[1:], data + b"1234"):
        (tmp_path / "m.pc2").write_bytes(broken)
        with pytest.raises(wg.MeshError, match=r"m\.pc2"):
            wg.BodyMotion.load(tmp_path / "m.pc2")
    (tmp_path / "m.pc2").write_bytes(data)
    (tmp_path / "m.obj").unlink()
    with pytest.raises(wg.MeshError, match=r"m\.obj"):
        wg.BodyMotion.load(tmp_path / "m.pc2")


def test_usd_says_what_other_programs_need_to_know(tmp_path):
    """A viewer would show the garment lying down, a hundred times too large, subdivided, or at another speed."""
    from pxr import Usd, UsdGeom

    result = motion()
    body = np.zeros((5, 3, 3)) + np.eye(3)
    write_usd(tmp_path / "m.usda", [("my shirt", result.vertices, result.faces), ("body", body, [[0, 1, 2]])], 24.0)
    stage = Usd.Stage.Open(str(tmp_path / "m.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (24.0, 0.0, 4.0)
    meshes = {p.GetName(): UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)}
    assert set(meshes) == {"my_shirt", "body"}
    shirt = meshes["my_shirt"]
    assert shirt.GetSubdivisionSchemeAttr().Get() == "none"
    assert shirt.GetPointsAttr().GetTimeSamples() == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(shirt.GetFaceVertexIndicesAttr().Get(), result.faces.ravel())
    assert set(shirt.GetFaceVertexCountsAttr().Get()) == {3}
    for t in range(5):
        np.testing.assert_array_equal(shirt.GetPointsAttr().Get(t), result.vertices[t])
        low, high = result.vertices[t].min(axis=0), result.vertices[t].max(axis=0)
        np.testing.assert_array_equal(shirt.GetExtentAttr().Get(t), [low, high])
    with pytest.raises(wg.MeshError, match="my_shirt"):
        wg.BodyMotion.load(tmp_path / "m.usda")
    assert wg.BodyMotion.load(tmp_path / "m.usda", mesh="body").vertices.shape == (5, 3, 3)
    with pytest.raises(wg.MeshError, match="same number"):
        write_usd(tmp_path / "n.usda", [("a", result.vertices, result.faces), ("b", body[:2], [[0, 1, 2]])], 24.0)


def test_usd_of_other_programs_is_converted(tmp_path):
    """A Z-up stage in centimetres, with a moved parent, quads and left-handed faces, would come in as it stands."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "z.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    parent = UsdGeom.Xform.Define(stage, "/a")
    parent.AddTranslateOp().Set(Gf.Vec3d(100, 0, 0))
    mesh = UsdGeom.Mesh.Define(stage, "/a/b")
    mesh.CreatePointsAttr([(0, 0, 0), (0, 0, 100), (0, 100, 100), (0, 100, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateOrientationAttr("leftHanded")
    stage.GetRootLayer().Save()
    garment = wg.Garment.load(tmp_path / "z.usda")
    np.testing.assert_allclose(garment.vertices, [[1, 0, 0], [1, 1, 0], [1, 1, -1], [1, 0, -1]], atol=1e-6)
    np.testing.assert_array_equal(garment.faces, [[2, 1, 0], [3, 2, 0]])
    raw = read_usd(tmp_path / "z.usda", convert=False)
    np.testing.assert_allclose(raw.vertices[0], 100 * garment.vertices, atol=1e-4)


def _fail(*args, **kwargs):
    raise OSError("disk full")


@pytest.mark.parametrize("target", ["m.npz", "m.usdc", "m.pc2", "m.mdd", "m.abc", "folder"])
@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_write_that_fails_leaves_the_old_result_and_no_rubbish(tmp_path, monkeypatch, target, broken):
    """A full disk would leave half a file that looks like a result."""
    old, new = motion(3), motion(4)
    old.save(tmp_path / target)
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    if broken == "fsync":
        real, calls = os.fsync, []
        monkeypatch.setattr(os, "fsync", lambda fd: _fail() if calls else (calls.append(fd), real(fd)))
        if target in ("m.npz", "m.usdc", "m.abc"):
            calls.append(0)  # a single file: the first flush fails
    else:
        monkeypatch.setattr(os, "replace", _fail)
    with pytest.raises(OSError, match="disk full"):
        new.save(tmp_path / target)
    monkeypatch.undo()
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    np.testing.assert_array_equal(wg.BodyMotion.load(tmp_path / target).vertices, old.vertices)


def test_a_write_that_stops_midway_leaves_nothing(tmp_path, monkeypatch):
    """The first frames of a folder, or the .obj without its .pc2, would look like a finished result."""
    real, calls = obj.obj_text, []

    def text(*args):
        calls.append(1)
        return _fail() if len(calls) == 3 else real(*args)

    monkeypatch.setattr("warpgarment.io.folder.obj_text", text)
    with pytest.raises(OSError, match="disk full"):
        motion().save(tmp_path / "folder")
    monkeypatch.setattr("warpgarment.io.pc2.write_pc2_to", _fail)
    with pytest.raises(OSError, match="disk full"):
        motion().save(tmp_path / "m.pc2")
    monkeypatch.setattr(np, "savez", _fail)
    with pytest.raises(OSError, match="disk full"):
        motion().save(tmp_path / "m.npz")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_exchange_of_folders_puts_the_old_one_back(tmp_path, monkeypatch):
    """The old folder would be gone when only the last rename fails."""
    motion(3).save(tmp_path / "folder")
    real = os.replace
    moves = []

    def replace(a, b):
        moves.append(1)
        return _fail() if len(moves) == 2 else real(a, b)

    monkeypatch.setattr(atomic.os, "replace", replace)
    with pytest.raises(OSError, match="disk full"):
        motion(4).save(tmp_path / "folder")
    assert wg.BodyMotion.load(tmp_path / "folder").frames == 3
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_other_peoples_folders_are_not_replaced(tmp_path):
    """Saving to an existing folder of other files would delete them."""
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "thesis.txt").write_text("years of work")
    with pytest.raises(FileExistsError, match=r"thesis\.txt"):
        motion().save(tmp_path / "notes")
    assert (tmp_path / "notes" / "thesis.txt").read_text() == "years of work"
    with pytest.raises(ValueError, match=r"\.xyz"):
        motion().save(tmp_path / "m.xyz")


def test_folders_of_frames_must_agree(tmp_path):
    """A frame of another topology would be read as if it were the same garment."""
    motion(11).save(tmp_path / "f")
    path = tmp_path / "f" / "frame_0007.obj"
    path.write_text(re.sub(r"\nf .*\n$", "\n", path.read_text()))
    with pytest.raises(wg.MeshError, match="frame_0007"):
        wg.BodyMotion.load(tmp_path / "f")
    (tmp_path / "empty").mkdir()
    with pytest.raises(wg.MeshError, match=r"no \.obj"):
        wg.BodyMotion.load(tmp_path / "empty")


def test_frames_are_ordered_by_number(tmp_path):
    """Frame 10 would come before frame 2."""
    vertices, faces = np.eye(3), np.array([[0, 1, 2]])
    for t in (8, 9, 10, 11):
        wg.Garment(vertices + t, faces).save(tmp_path / "f" / f"shirt{t}.obj")
    np.testing.assert_array_equal(wg.BodyMotion.load(tmp_path / "f").vertices[:, 0, 1], [8, 9, 10, 11])


@pytest.mark.parametrize("change", [lambda d: d.pop("fps"), lambda d: d.update(status_verdict=np.array(["great"] * 5))])
def test_foreign_archives_are_named(tmp_path, change):
    """An archive of something else would raise a KeyError that says nothing."""
    motion().save(tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as archive:
        data = dict(archive)
    change(data)
    np.savez(tmp_path / "m.npz", **data)
    with pytest.raises(wg.MeshError, match=r"m\.npz"):
        wg.GarmentMotion.load(tmp_path / "m.npz")


def test_statuses_must_be_one_a_frame():
    """A status would be read as that of another frame."""
    with pytest.raises(wg.MeshError, match="4 statuses for 5 frames"):
        wg.GarmentMotion(motion().vertices, motion().faces, 30, motion().status[:4])
