"""If these failed, a motion would be played at another speed than it was recorded at, or another way up, unsaid."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest
from support.meshes import capsule

import warpgarment as wg
from warpgarment.io.files import read_motion
from warpgarment.io.obj import obj_text

BODY = capsule((0, 0.2, 0), (0, 1.5, 0), 0.2)
FRAMES = BODY.vertices + np.arange(7, dtype=np.float32)[:, None, None] * np.float32([0, 0, 0.01])


def cache(path, frames=FRAMES, start=0.0, sampling=1.0):
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, frames.shape[1], start, sampling, len(frames))
    path.write_bytes(head + np.ascontiguousarray(frames, dtype="<f4").tobytes())
    path.with_suffix(".obj").write_text(obj_text(BODY.vertices, BODY.faces))
    return path


@pytest.mark.parametrize("key", [
    "fps", "FPS", "mocap_framerate", "mocap_frame_rate", "frame_rate", "framerate", "frameRate", "frames_per_second",
    "target_fps", "sampling_rate",
])  # fmt: skip
def test_rates_under_the_names_people_use(tmp_path, key):
    """120 frames a second would be read as 30: four times too slow."""
    np.savez(tmp_path / "m.npz", vertices=FRAMES, faces=BODY.faces, **{key: 120.0})
    assert wg.BodyMotion.load(tmp_path / "m.npz").fps == 120
    assert wg.BodyMotion.load(tmp_path / "m.npz", fps=60).fps == 60
    np.savez(tmp_path / "m.npz", vertices=FRAMES, faces=BODY.faces, **{key: np.array([[25]])})
    assert wg.BodyMotion.load(tmp_path / "m.npz").fps == 25


def test_rates_that_differ_are_refused(tmp_path):
    """One of two rates would be taken."""
    np.savez(tmp_path / "m.npz", vertices=FRAMES, faces=BODY.faces, fps=30.0, mocap_framerate=120.0)
    with pytest.raises(wg.MeshError, match="rates that differ: fps 30, mocap_framerate 120"):
        wg.BodyMotion.load(tmp_path / "m.npz")
    np.savez(tmp_path / "m.npz", vertices=FRAMES, faces=BODY.faces, fps=[30.0, 60.0])
    with pytest.raises(wg.MeshError, match="fps must be a single number"):
        wg.BodyMotion.load(tmp_path / "m.npz")


@pytest.mark.parametrize("load", [wg.BodyMotion.load, wg.GarmentMotion.load])
def test_a_rate_that_is_a_guess_is_said(tmp_path, load):
    """A dance of one second at 60 frames would take two, unsaid."""
    path = cache(tmp_path / "m.pc2")
    with pytest.warns(UserWarning, match=r"m\.pc2: the file has no rate; 30 frames a second are assumed"):
        assert load(path).fps == 30
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load(path, fps=60).fps == 60
        load(cache(tmp_path / "one.pc2", FRAMES[:1]))  # a single frame has no speed


@pytest.mark.parametrize(("sampling", "fps"), [(1.0, 24), (2.0, 12), (0.5, 48), (0.25, 96)])
def test_the_sampling_of_a_point_cache_counts(tmp_path, sampling, fps):
    """A cache of every second frame would run twice as fast."""
    path = cache(tmp_path / "m.pc2", start=10, sampling=sampling)
    body = wg.BodyMotion.load(path, fps=24)
    assert (body.frames, body.fps) == (7, fps)
    data = read_motion(path)
    assert (data.start / body.fps, data.step) == (pytest.approx(10 / 24), sampling)  # begins at frame 10 of 24 a second


@pytest.mark.parametrize("sampling", [0.0, -1.0, float("nan"), 1e30])
def test_a_sampling_that_is_none_is_refused(tmp_path, sampling):
    """A header of zeros would be a division by zero, or a motion of no duration."""
    with pytest.raises(wg.MeshError, match=r"m\.pc2: the header says that samples are"):
        wg.BodyMotion.load(cache(tmp_path / "m.pc2", sampling=sampling))


def test_a_cache_in_another_order_than_its_mesh_is_said(tmp_path):
    """Faces would join vertices from anywhere: a body of spikes. A mesh in centimetres, or stretched, is in order."""
    path, order = cache(tmp_path / "m.pc2"), np.random.default_rng(0).permutation(len(BODY.vertices))
    path.with_suffix(".obj").write_text(obj_text(BODY.vertices[order], np.argsort(order)[BODY.faces]))
    with pytest.warns(UserWarning, match="vertices seem to be in another order"):
        wg.BodyMotion.load(path, fps=30)
    bent = 100 * BODY.vertices * np.float32([1.3, 0.9, 1.2])
    path.with_suffix(".obj").write_text(obj_text(bent, BODY.faces))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wg.BodyMotion.load(path, fps=30)


@pytest.mark.parametrize("name", ["m.npz", "m.pc2", "m.ply", "m.obj", "m.usda"])
def test_z_up_files_are_turned(tmp_path, name):
    """A standing body would lie on its back: (x, y, z) with Z up is (x, z, -y) with Y up."""
    lying = np.stack([FRAMES[..., 0], -FRAMES[..., 2], FRAMES[..., 1]], axis=-1)
    path = tmp_path / name
    if name in ("m.ply", "m.obj"):
        wg.Garment(lying[0], BODY.faces).save(path)
    else:
        wg.BodyMotion(lying, BODY.faces, 30).save(path)
    found = wg.BodyMotion.load(path, up="z", fps=30).vertices
    np.testing.assert_array_equal(found, FRAMES[: len(found)])
    np.testing.assert_array_equal(wg.BodyMotion.load(path, up="y", fps=30).vertices, lying[: len(found)])
    if name not in ("m.pc2", "m.npz"):
        np.testing.assert_array_equal(wg.Garment.load(path, up="z").vertices, FRAMES[0])
    np.testing.assert_allclose(wg.BodyMotion.load(path, up="z", unit="cm", fps=30).vertices, found / 100, rtol=1e-6)
    with pytest.raises(ValueError, match='up must be "y" or "z"'):
        wg.BodyMotion.load(path, up="x")
