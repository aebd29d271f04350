"""If these failed, a garment of panels would come back from a shot at other times, or with other polygons or texture
coordinates than its file's: quads with texture coordinates, whose seam is joined by --clean, on a body of 24 frames a
second from frame 1001 on. Files are read with USD's own functions and the readers of `support.dressed`."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from support import dressed
from support.dressed import AROUND, COLORS, DOUBLED, RINGS, UV, VERTICES, close, expected, ordered

import warpgarment as wg
from warpgarment.cli import main

FIRST, COUNT, FPS = 1001, 5, 24.0


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """Positions of the skirt without a seam in this shot, [5,60,3], and the file of the skirt with one."""
    folder = tmp_path_factory.mktemp("shot")
    box = trimesh.creation.box((0.4, 1.7, 0.3))
    sway = np.arange(COUNT)[:, None, None] * [0.004, 0.0, 0.002]
    body = wg.BodyMotion(box.vertices + [0, 0.85, 0] + sway, box.faces, FPS, start=FIRST / FPS)
    body.save(folder / "body.npz")
    skirt = wg.Garment.load(dressed.write_obj(folder / "whole.obj"))
    whole = wg.Simulator.from_pretrained("default", device="cpu").rollout(skirt, body, out_fps="body")
    panels = dressed.write_panels(folder / "skirt.obj")
    arguments = [str(panels), str(folder / "body.npz"), "--clean", "--device", "cpu", "--out"]
    assert main(["simulate", *arguments, str(folder / "out.usda")]) == 0
    return whole.vertices, folder / "out.usda"


def test_the_stage_has_the_times_and_the_polygons_of_the_file(shot):
    """Polygons would name joined vertices, or a frame of the shot be missing. Exact; positions as of the skirt without
    a seam, which is what is simulated: to 1e-6 m."""
    from pxr import Usd, UsdGeom

    whole, path = shot
    stage = Usd.Stage.Open(str(path))
    codes = list(range(FIRST, FIRST + COUNT))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (1001, 1005, FPS)
    mesh = next(UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh))
    assert mesh.GetPointsAttr().GetTimeSamples() == codes
    polygons = dressed.panel_corners()
    assert list(mesh.GetFaceVertexCountsAttr().Get()) == [len(p) for p in polygons]
    assert list(mesh.GetFaceVertexIndicesAttr().Get()) == [v for p in polygons for v, _ in p]
    pairs = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
    np.testing.assert_array_equal(np.array(pairs), UV[[t for p in polygons for _, t in p]])
    every = np.concatenate([np.arange(len(VERTICES)), DOUBLED])
    for code, positions in zip(codes, whole, strict=True):
        points = np.array(mesh.GetPointsAttr().Get(code))
        np.testing.assert_allclose(points, positions[every], rtol=0, atol=1e-6)
        np.testing.assert_array_equal(points[DOUBLED], points[len(VERTICES) :])
    assert np.ptp(whole, axis=0).max() > 0.005


@pytest.mark.parametrize("name", ["frames", "m.pc2", "m.glb", "m.npz"])
def test_other_formats_have_them_too(shot, tmp_path, name):
    """The shot would lose its times, polygons or texture coordinates on the way from a stage to another format."""
    whole, stage = shot
    path = tmp_path / name
    assert main(["convert", str(stage), str(path)]) == 0
    back = wg.GarmentMotion.load(path, fps=FPS)
    assert (back.frames, back.clock.number, back.fps) == (COUNT, FIRST, pytest.approx(FPS, abs=1e-3))
    last = expected(whole[-1])
    if name == "frames":
        assert sorted(p.name for p in path.glob("*.obj")) == [f"frame_{k}.obj" for k in range(1001, 1006)]
        found, colors, _ = dressed.read_obj(path / "frame_1005.obj")
    elif name == "m.pc2":
        assert np.frombuffer(path.read_bytes()[20:24], "<f4") == FIRST
        found, colors, _ = dressed.read_obj(path.with_suffix(".obj"))
        last = expected(whole[0])
    elif name == "m.glb":
        found, colors = dressed.read_gltf(path, (FIRST + COUNT - 1) / FPS)
        back.save(tmp_path / "again")
        assert close(ordered(found), ordered(dressed.read_obj(tmp_path / "again" / "frame_1005.obj")[0]))
        assert len(found) == 2 * AROUND * (RINGS - 1)
        corners = {corner for polygon, _ in last for corner in polygon}
        assert {tuple(np.round(np.concatenate(c), 4)) for p, _ in found for c in p} == {
            tuple(np.round(np.concatenate(c), 4)) for c in corners
        }
        last = found
    else:
        with np.load(path) as arrays:
            assert (float(arrays["start"]), float(arrays["fps"])) == (FIRST / FPS, FPS)
        back.save(tmp_path / "again")
        found, colors, _ = dressed.read_obj(tmp_path / "again" / "frame_1005.obj")
    assert close(found, last)
    assert colors.keys() == COLORS.keys()


def test_motions_made_of_others_keep_their_surface(tmp_path):
    """A result at another rate, or a body that is resampled or shown at another motion's frames, would be bare
    triangles; a part of a body would have polygons that name vertices of the whole."""
    path = dressed.write_obj(tmp_path / "skirt.obj")
    garment = wg.Garment.load(path)
    frames = np.stack([VERTICES, VERTICES + np.float32([0, 0.01, 0])])
    motion = wg.GarmentMotion(frames, garment.faces, FPS, start=FIRST / FPS, surface=garment.surface)
    motion.save(tmp_path / "m.npz")
    body = wg.BodyMotion.load(tmp_path / "m.npz")
    for one in (motion, body):
        for made in (one.resampled(60.0), one.resampled(60.0).resampled(FPS), one.on_clock(one.resampled(48.0).clock)):
            made.save(tmp_path / "made")
            first = sorted((tmp_path / "made").glob("*.obj"))[0]
            assert close(dressed.read_obj(first)[0], expected(VERTICES))
    part = body.submesh(np.arange(len(body.faces)) < 10)
    assert part.surface is None
    part.save(tmp_path / "part")
    assert len(dressed.read_obj(sorted((tmp_path / "part").glob("*.obj"))[0])[0]) == 10
