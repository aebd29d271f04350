"""CLOTH3D samples, from files that the tests write byte by byte."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.files.readers import QUADS, STRIP, TRIANGLES, mat_file, moving, write_obj, write_point_cache

from warpgarment.errors import MeshError
from warpgarment.objects.body import BodyMotion
from warpgarment.training.readers import detect, read_cloth3d, read_pc16, read_recording
from warpgarment.training.readers.matlab import read_mat

FRAMES = 5
TRANS = np.arange(3 * FRAMES, dtype=np.float64).reshape(3, FRAMES) / 4.0
POSES = np.zeros((72, FRAMES))
POSES[0] = np.pi / 2  # upright, in the data set's axes
POSES[3:6, 1] = (0.1, 0.2, 0.3)


def info(**changes) -> dict:
    """The variables of info.mat, turned by a quarter."""
    outfit = {"Top": {"fabric": "cotton", "texture": {"type": "color", "data": [0.1, 0.2, 0.3]}}}
    outfit["Trousers"] = {"fabric": "denim"}
    variables = {"poses": POSES, "trans": TRANS, "shape": np.arange(10) / 10.0, "gender": 1, "zrot": np.pi / 2}
    return variables | {"outfit": outfit, "tightness": [0.5, -1.0], "camLoc": [4.0, 0.0, 1.0]} | changes


def write_sample(folder: Path, variables: dict | None = None) -> Path:
    folder.mkdir()
    (folder / "info.mat").write_bytes(mat_file(variables or info()))
    for shift, name in enumerate(("Top", "Trousers")):
        write_obj(folder / f"{name}.obj", STRIP + [shift, 0.5, 0.25], QUADS)
        write_point_cache(folder / f"{name}.pc16", moving(STRIP + [shift, 0.5, 0.25], FRAMES), "e")
    return folder


def test_garments_stand_where_the_data_set_puts_them(tmp_path):
    """If this fails, garments are turned, shifted or mirrored against the body, or the order of vertices changes.

    Expected by hand: turned by 90 degrees, (x, y, z) goes to (-y, x, z), and with Y up to (-y, z, -x); the rest shape
    is turned back, (x, y, z) to (y, -x, z), and with Y up to (y, z, x). Tolerance: float32 of a quarter turn.
    """
    recording = read_cloth3d(write_sample(tmp_path / "135_02_s8"))
    assert [g.rest.name for g in recording.garments] == ["Top", "Trousers"]
    for shift, garment in enumerate(recording.garments):
        start = STRIP + [shift, 0.5, 0.25]
        x, y, z = np.moveaxis(moving(start, FRAMES) + TRANS.T[:, None], -1, 0)
        np.testing.assert_allclose(garment.vertices, np.stack([-y, z, -x], axis=-1), atol=1e-6)
        np.testing.assert_allclose(garment.rest.vertices, start[:, [1, 2, 0]], atol=1e-6)
        np.testing.assert_array_equal(garment.rest.faces, TRIANGLES)
        assert garment.vertices.dtype == np.float32
    assert (recording.fps, len(recording), recording.body) == (30.0, FRAMES, None)
    assert recording.attributes == {
        "motion": "135_02",
        "garments": {"Top": {"fabric": "cotton"}, "Trousers": {"fabric": "denim"}},
        "tightness": [0.5, -1.0],
    }
    assert recording.materials == (None, None)


def test_a_body_made_of_the_poses_wears_the_garments(tmp_path):
    """If this fails, users who bring an SMPL model get a body beside the clothes or facing another way.

    The "body" here is a triangle on the pelvis that follows the first rotation, as SMPL's pelvis does.
    """
    seen = []
    faces = np.array([[0, 1, 2]])
    local = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # SMPL's own axes, Y up

    def body(poses):
        seen.append(poses)
        turned = Rotation.from_rotvec(poses.rotations[:, 0]).as_matrix() @ local.T
        return turned.transpose(0, 2, 1) + poses.trans[:, None], faces

    recording = read_cloth3d(write_sample(tmp_path / "01_01_s0"), body=body)
    poses = seen[0]
    assert recording.poses is poses
    assert (poses.gender, poses.up, poses.centred, len(poses)) == ("male", "z", True, FRAMES)
    np.testing.assert_allclose(poses.betas, np.arange(10) / 10.0)
    np.testing.assert_allclose(poses.rotations[1, 1], [0.1, 0.2, 0.3])
    x, y, z = TRANS
    pelvis = np.stack([-y, z, -x], axis=-1)
    vertices = recording.body.vertices
    np.testing.assert_allclose(vertices[:, 0], pelvis, atol=1e-6)
    np.testing.assert_allclose(vertices[:, 2] - vertices[:, 0], np.tile([0.0, 1.0, 0.0], (FRAMES, 1)), atol=1e-6)
    # SMPL's +X, upright and turned by a quarter about the vertical, is the world's -Z
    np.testing.assert_allclose(vertices[:, 1] - vertices[:, 0], np.tile([0.0, 0.0, -1.0], (FRAMES, 1)), atol=1e-6)


def test_a_body_motion_or_its_file_is_taken_as_it_is(tmp_path):
    """If this fails, a body that the user has made is moved, or accepted with other frames."""
    folder = write_sample(tmp_path / "01_01_s0")
    vertices = np.random.default_rng(0).normal(size=(FRAMES, 4, 3)).astype(np.float32)
    motion = BodyMotion(vertices, [[0, 1, 2], [0, 2, 3]], 30.0)
    motion.save(tmp_path / "body.npz")
    for body in (motion, tmp_path / "body.npz"):
        np.testing.assert_array_equal(read_cloth3d(folder, body=body).body.vertices, vertices)
    with pytest.raises(MeshError, match="numbers of frames differ: garment Top 5, garment Trousers 5, body 3, poses 5"):
        read_cloth3d(folder, body=BodyMotion(vertices[:3], motion.faces, 30.0))
    with pytest.raises(MeshError, match="garments run at 30 fps, the body at 25"):
        read_cloth3d(folder, body=BodyMotion(vertices, motion.faces, 25.0))
    with pytest.raises(MeshError, match=r"body\(poses\) returned vertices of shape \[4, 3\] for 5 frames"):
        read_cloth3d(folder, body=lambda poses: (vertices[0], motion.faces))


def test_samples_of_one_frame_have_vectors(tmp_path):
    """If this fails, the data set's static samples cannot be read."""
    folder = write_sample(tmp_path / "s", info(poses=POSES[:, :1], trans=TRANS[:, :1], zrot=0.0))
    for name in ("Top", "Trousers"):
        write_point_cache(folder / f"{name}.pc16", STRIP[None], "e")
    assert len(read_cloth3d(folder)) == 1


def test_a_sample_is_recognised_by_content(tmp_path):
    """If this fails, `read_recording` needs to be told the format."""
    folder = write_sample(tmp_path / "anything")
    assert detect(folder) == "cloth3d"
    assert read_recording(folder).source == "CLOTH3D anything"
    for name in ("info.mat", "Top.pc16"):
        with pytest.raises(MeshError, match=r"CLOTH3D sample\. Give the folder"):
            detect(folder / name)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda f: (f / "Top.pc16").unlink(), r"1 of 4 files of the outfit are missing: Top\.pc16"),
        (lambda f: [p.unlink() for p in f.glob("*.obj")], r"2 of 4 files .* missing: Top\.obj, Trousers\.obj"),
        (lambda f: (f / "info.mat").unlink(), r"holds no info\.mat"),
        (lambda f: cut(f / "Top.pc16", 7), "205 bytes where 5 samples of 6 points need 212. .* cut short"),
        (lambda f: cut(f / "Top.pc16", 190), "does not start with POINTCACHE2; .* cut short"),
        (lambda f: write_point_cache(f / "Top.pc16", moving(STRIP, 5), "e", version=2), "only version 1 is known"),
        (lambda f: write_point_cache(f / "Top.pc16", moving(STRIP, 5), "f"), "32-bit floats.*name it Top.pc2"),
        (lambda f: write_point_cache(f / "Top.pc16", moving(STRIP[:4], 5), "e"), "4 points and Top.obj 6 vertices"),
        (lambda f: write_point_cache(f / "Top.pc16", moving(STRIP, 4), "e"), "4 frames and info.mat 5"),
        (lambda f: break_frames(f / "Top.pc16"), r"2 of 5 frames of Top hold NaN or infinity \(frames 1, 3\)"),
        (lambda f: (f / "info.mat").write_bytes(mat_file(info(poses=POSES[:69]))), r"poses has shape \[69, 5\]"),
        (lambda f: (f / "info.mat").write_bytes(mat_file(info(trans="no"))), "trans has shape .* must hold numbers"),
        (lambda f: (f / "info.mat").write_bytes(mat_file(info(trans=TRANS[:, :4]))), "5 poses and 4 translations"),
        (lambda f: (f / "info.mat").write_bytes(mat_file(info(zrot=[1.0, 2.0]))), "zrot must be one finite number"),
        (lambda f: (f / "info.mat").write_bytes(mat_file(info(poses=POSES * np.nan))), "5 of 5 frames have SMPL rot"),
        (lambda f: (f / "info.mat").write_bytes(mat_file({"trans": TRANS})), "no variable named 'poses'; .* trans"),
        (lambda f: (f / "info.mat").write_bytes(mat_file(info())[:3000]), "not a readable MATLAB 5 file"),
        (lambda f: (f / "info.mat").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(600)), "not a readable MATLAB 5 file"),
        (lambda f: write_obj(f / "Top.obj", STRIP, (*QUADS, QUADS[0])), r"Top.pc16: 2 of .* called with clean=True"),
    ],
)
def test_damaged_samples_are_named(tmp_path, spoil, match):
    """If this fails, a damaged sample becomes wrong training data, or an error that does not say what to do."""
    folder = write_sample(tmp_path / "01_01_s0")
    spoil(folder)
    with pytest.raises(MeshError, match=match):
        read_cloth3d(folder)


def cut(path: Path, count: int) -> None:
    path.write_bytes(path.read_bytes()[:-count])


def break_frames(path: Path) -> None:
    frames = moving(STRIP, FRAMES)
    frames[1, 2, 0], frames[3, 0, 1] = np.nan, np.inf
    write_point_cache(path, frames, "e")


def test_repaired_rest_meshes_keep_their_motion(tmp_path):
    """If this fails, `clean=True` mixes up which vertex moves where. The spare vertex is at the front of the file."""
    folder = write_sample(tmp_path / "01_01_s0")
    spare = np.concatenate([[[9.0, 9.0, 9.0]], STRIP + [0, 0.5, 0.25]])
    write_obj(folder / "Top.obj", spare, [[i + 1 for i in quad] for quad in (*QUADS, QUADS[0])])
    whole = read_cloth3d(write_sample(tmp_path / "01_01_s1"))
    write_point_cache(folder / "Top.pc16", np.insert(moving(STRIP + [0, 0.5, 0.25], FRAMES), 0, np.nan, axis=1), "e")
    repaired = read_cloth3d(folder, clean=True)
    np.testing.assert_array_equal(repaired.garments[0].vertices, whole.garments[0].vertices)
    np.testing.assert_array_equal(repaired.garments[0].rest.vertices, whole.garments[0].rest.vertices)


def test_point_caches_of_16_bits_are_exact(tmp_path):
    """If this fails, frames or axes of a cache are shuffled, or its numbers rounded twice."""
    values = np.random.default_rng(1).normal(size=(3, 7, 3)).astype(np.float16)
    write_point_cache(tmp_path / "a.pc16", values.astype(np.float64), "e")
    read = read_pc16(tmp_path / "a.pc16")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, values.astype(np.float32))
    (tmp_path / "b.pc16").write_bytes(struct.pack("<12siiffi", b"POINTCACHE2\0", 1, -7, 0.0, 1.0, 3))
    with pytest.raises(MeshError, match="version 1 with -7 points"):
        read_pc16(tmp_path / "b.pc16")


def test_a_text_whose_dimensions_lie_is_refused(tmp_path):
    """A size that lies ends the process in SciPy's reader: every number of the dimensions of a text takes others."""
    data = (write_sample(tmp_path / "a") / "info.mat").read_bytes()
    path = tmp_path / "info.mat"
    at = data.index("cotton".encode("utf-16-le")) - 8  # its tag; before that name, dimensions
    refused = 0
    for place in range(at - 40, at + 8, 4):
        for value in (0, 1, 3, 7, 2**31 - 1, 2**31):
            if data[place : place + 4] != struct.pack("<I", value):
                path.write_bytes(data[:place] + struct.pack("<I", value) + data[place + 4 :])
                try:
                    read_mat(path, ("outfit",))
                except MeshError:
                    refused += 1
    assert refused > 30
    path.write_bytes(data)
    assert read_mat(path, ("outfit",))["outfit"]["Top"]["fabric"] == "cotton"
