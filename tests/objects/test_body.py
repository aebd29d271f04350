"""If these failed, bodies would be posed wrongly, or broken ones reach the distance queries, which check nothing."""

import re

import numpy as np
import pytest
import torch
import trimesh

import warpgarment as wg
from warpgarment.geometry.skinning import linear_blend_skinning


def body(frames=4):
    mesh = trimesh.creation.icosphere(1)
    drift = np.linspace(0, 1, frames)[:, None, None] * np.array([1.0, 0.5, -0.25])
    return (mesh.vertices[None] + drift).astype(np.float32), np.array(mesh.faces)


def rotations(count, seed=0):
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))[0]
    return q * np.sign(np.linalg.det(q))[:, None, None]


def test_what_is_given_comes_back():
    """Frames, vertices or the rate would change on the way in."""
    vertices, faces = body()
    motion = wg.BodyMotion(torch.tensor(vertices), faces, 24)
    np.testing.assert_array_equal(motion.vertices, vertices)
    np.testing.assert_array_equal(motion.faces, faces)
    assert (motion.vertices.dtype, motion.faces.dtype) == (np.float32, np.int32)
    assert (motion.frames, len(motion), motion.fps) == (4, 4, 24.0)


def _broken():
    vertices, faces = body()
    nan = vertices.copy()
    nan[2, 5, 1] = np.nan
    return {
        "single frame": (vertices[0], faces, 30, "[T,V,3]"),
        "nan": (nan, faces, 30, "1 of 4 frames hold NaN or infinite positions (first: frame 2, vertex 5)"),
        "range": (vertices, faces + 1, 30, "name vertices that do not exist"),
        "negative": (vertices, faces - 1, 30, "name vertices that do not exist"),
        "no faces": (vertices, faces[:0], 30, "no faces"),
        "no frames": (vertices[:0], faces, 30, "empty"),
        "quads": (vertices, faces[:, [0, 1, 2, 2]], 30, "[F,3]"),
        "all flat": (vertices * 0, faces, 30, "80 of 80 faces have no area"),
        "rate": (vertices, faces, 0, "fps"),
        "rate nan": (vertices, faces, np.nan, "fps"),
    }


@pytest.mark.parametrize("case", _broken())
def test_bad_bodies_are_refused(case):
    """Warp would accept NaN, missing vertices or no faces, and crash or answer nonsense."""
    vertices, faces, fps, message = _broken()[case]
    with pytest.raises(wg.MeshError, match=re.escape(message)):
        wg.BodyMotion(vertices, faces, fps)


def test_some_flat_faces_and_open_parts_are_fine():
    """Ordinary scans and characters would be refused."""
    vertices, faces = body()
    motion = wg.BodyMotion(vertices, np.r_[faces[:30], [[0, 0, 1]], faces[30:40, ::-1]])
    assert motion.degenerate_faces == 1


def test_resampling_is_linear_in_time():
    """Speeds would change with the rate: a linear motion stays linear, to float32 rounding."""
    vertices, faces = body(31)
    motion = wg.BodyMotion(vertices, faces, 30)
    for fps, frames in ((60, 61), (24, 25), (7.5, 9), (50, 51), (30, 31)):
        again = motion.resampled(fps)
        assert (again.frames, again.fps) == (frames, fps)
        times = np.minimum(np.arange(frames) / fps, 1)  # of 7.5 frames, the last one holds the end
        expected = vertices[0] + times[:, None, None] * (vertices[-1] - vertices[0])
        np.testing.assert_allclose(again.vertices, expected, atol=5e-7)
    bent = vertices + (np.arange(31)[:, None, None] % 2).astype(np.float32)
    np.testing.assert_allclose(
        wg.BodyMotion(bent, faces, 30).resampled(60).vertices[1], bent[:2].mean(axis=0), atol=5e-7
    )
    assert wg.BodyMotion(vertices[:1], faces, 30).resampled(60).frames == 1
    with pytest.raises(wg.MeshError, match="fps"):
        motion.resampled(-1)


def test_submesh_keeps_the_chosen_faces_in_place():
    """Dropping the hands would move or reconnect the rest."""
    vertices, faces = body()
    motion = wg.BodyMotion(vertices, faces, 25)
    mask = faces.max(axis=1) < 30
    part = motion.submesh(mask)
    np.testing.assert_array_equal(part.vertices[:, part.faces], vertices[:, faces[mask]])
    assert part.vertices.shape[1] == len(np.unique(faces[mask]))
    assert part.fps == 25
    for bad in (mask[:-1], np.zeros(80, dtype=bool), np.arange(80)):
        with pytest.raises(wg.MeshError, match="face_mask"):
            motion.submesh(bad)


def skinned(frames=3, bones=4):
    random = np.random.default_rng(1)
    vertices, faces = body(1)
    weights = random.random((len(vertices[0]), 3))
    transforms = np.concatenate(
        [rotations(frames * bones).reshape(frames, bones, 3, 3), random.normal(size=(frames, bones, 3, 1))], 3
    )
    return {
        "rest_vertices": vertices[0],
        "faces": faces,
        "bone_indices": random.integers(0, bones, weights.shape).astype(np.uint8),
        "bone_weights": (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32),
        "bone_transforms": transforms.astype(np.float32),
        "fps": 60.0,
    }


def test_skinning_is_the_weighted_sum_of_bone_transforms():
    """Bodies stored as bones would be posed wrongly: compared with the plain loop in float64, to float32 rounding."""
    data = skinned()
    posed = linear_blend_skinning(
        *(data[k] for k in ("rest_vertices", "bone_indices", "bone_weights", "bone_transforms"))
    )
    assert posed.dtype == np.float32
    for t, frame in enumerate(data["bone_transforms"].astype(float)):
        for v, rest in enumerate(data["rest_vertices"].astype(float)):
            bones = zip(data["bone_indices"][v], data["bone_weights"][v].astype(float), strict=True)
            expected = sum(w * (frame[b, :, :3] @ rest + frame[b, :, 3]) for b, w in bones)
            np.testing.assert_allclose(posed[t, v], expected, atol=1e-6)


def test_skinning_in_blocks_of_frames(monkeypatch):
    """Long motions, computed block by block, would have frames missing or misplaced."""
    data = skinned(frames=7)
    args = [data[k] for k in ("rest_vertices", "bone_indices", "bone_weights")]
    single = [linear_blend_skinning(*args, data["bone_transforms"][t : t + 1])[0] for t in range(7)]
    many = np.concatenate([data["bone_transforms"]] * 2000)[:9000]
    posed = linear_blend_skinning(*args, many)
    for t in (0, 3, 6, 7, 7935, 7936, 8999):
        np.testing.assert_array_equal(posed[t], single[t % 7])


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("bone_weights", lambda a: a[:-1], "V = 42"),
        ("bone_indices", lambda a: a[:, :2], "bone_indices"),
        ("bone_indices", lambda a: a + 3, "beyond the 4"),
        ("bone_weights", lambda a: a * 0.5, "do not sum to 1"),
        ("bone_weights", lambda a: a * np.nan, "do not sum to 1"),
        ("bone_transforms", lambda a: a[0], "bone_transforms"),
        ("bone_transforms", lambda a: a * np.inf, "NaN or infinite"),
        ("rest_vertices", lambda a: a[:-2], "V = 40"),
        ("faces", lambda a: a + 40, "do not exist"),
    ],
)
def test_skinned_files_whose_arrays_do_not_fit_are_refused(tmp_path, key, change, message):
    """Mismatched arrays would broadcast or index into nonsense; the message must name the file."""
    data = skinned()
    with np.errstate(invalid="ignore"):
        data[key] = change(data[key])
    np.savez(tmp_path / "b.npz", **data)
    with pytest.raises(wg.MeshError, match=re.escape(message)) as caught:
        wg.BodyMotion.load(tmp_path / "b.npz")
    assert "b.npz" in str(caught.value)


def test_skinned_files_and_their_collider(tmp_path):
    """Hands marked as no collider would push the garment, or the whole body could not be had."""
    data = skinned()
    np.savez(tmp_path / "b.npz", **data)
    motion = wg.BodyMotion.load(tmp_path / "b.npz")
    assert (motion.frames, motion.fps) == (3, 60.0)
    mask = np.arange(80) < 50
    np.savez(tmp_path / "c.npz", **data, collider_faces=mask)
    part, whole = (wg.BodyMotion.load(tmp_path / "c.npz", collider=c) for c in (True, False))
    np.testing.assert_array_equal(whole.vertices, motion.vertices)
    np.testing.assert_array_equal(part.vertices[:, part.faces], motion.vertices[:, data["faces"][mask]])
    assert wg.BodyMotion.load(tmp_path / "b.npz", fps=50).fps == 50


def test_pickles_are_never_loaded(tmp_path):
    """A downloaded motion could run code."""
    np.savez(tmp_path / "p.npz", vertices=np.array([{"a": 1}], dtype=object), faces=np.zeros((1, 3), dtype=int))
    with pytest.raises(wg.MeshError, match=r"p\.npz"):
        wg.BodyMotion.load(tmp_path / "p.npz")
    np.savez(tmp_path / "q.npz", points=np.zeros(3))
    with pytest.raises(wg.MeshError, match="points"):
        wg.BodyMotion.load(tmp_path / "q.npz")
