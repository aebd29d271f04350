"""VTO sequences: pickles in, recordings and plain .npz out, and nothing in them runs."""

from __future__ import annotations

import os
import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.files.readers import STRIP, TRIANGLES, moving, write_obj

from warpgarment.errors import MeshError
from warpgarment.objects.motion import GarmentMotion
from warpgarment.training.readers import PickleRefused, convert_vto, detect, read_recording, read_vto

FRAMES = 4
REST = STRIP * 0.75


def sequence(**changes) -> dict:
    """A sequence as the authors' code reads it."""
    pose = np.linspace(-1.0, 1.0, FRAMES * 72, dtype=np.float32).reshape(FRAMES, 72)
    translation = np.arange(FRAMES * 3, dtype=np.float32).reshape(FRAMES, 3)
    body = {"pose": pose, "translation": translation, "shape": np.tile(np.arange(10.0), (FRAMES, 1))}
    garment = {"vertices": moving(STRIP, FRAMES), "faces": TRIANGLES.astype(np.int64)}
    return (
        garment
        | body
        | {"sequence": "07_02", "subject": "07", "conf": {"frame_time": 0.033, "obstacles": []}}
        | changes
    )


def write(path, data: dict, protocol: int = 4):
    path.write_bytes(pickle.dumps({k: v for k, v in data.items() if v is not None}, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_sequences_are_read_without_running_them(tmp_path, protocol):
    """If this fails, positions, faces or poses of the data set are read wrongly."""
    path = write(tmp_path / "tshirt_shape00_07_02.pkl", sequence(), protocol)
    write_obj(tmp_path / "tshirt.obj", REST, TRIANGLES)
    recording = read_vto(path, rest=tmp_path / "tshirt.obj")
    garment, poses = recording.garments[0], recording.poses
    np.testing.assert_array_equal(garment.vertices, moving(STRIP, FRAMES).astype(np.float32))
    np.testing.assert_array_equal(garment.rest.faces, TRIANGLES)
    np.testing.assert_array_equal(garment.rest.vertices, REST.astype(np.float32))
    np.testing.assert_array_equal(poses.rotations.reshape(FRAMES, 72), sequence()["pose"])
    np.testing.assert_array_equal(poses.trans, sequence()["translation"])
    np.testing.assert_array_equal(poses.betas, np.arange(10.0))
    assert (poses.up, poses.centred, poses.gender, recording.fps) == ("y", False, "female", 30.0)
    assert garment.rest.name == "tshirt"
    assert recording.attributes == {"sequence": "07_02", "subject": "07", "motion": "07_02"}
    assert detect(path) == "vto"


def test_the_layout_of_the_description_is_understood(tmp_path):
    """If this fails, sequences as the data set's description has them (75 pose numbers) cannot be read."""
    given = sequence()
    poses = np.concatenate([given["pose"], given["translation"]], axis=1)
    data = sequence(pose=None, translation=None, shape=None) | {
        "poses": poses,
        "shapes": given["shape"] + [[0], [1], [2], [3]],
    }
    with pytest.warns(UserWarning, match=r"no rest shape: the first frame serves.*rest="):
        recording = read_vto(write(tmp_path / "dress_x.pkl", data))
    np.testing.assert_array_equal(recording.poses.trans, given["translation"])
    np.testing.assert_array_equal(recording.poses.rotations.reshape(FRAMES, 72), given["pose"])
    np.testing.assert_array_equal(recording.poses.betas[2], np.arange(10.0) + 2)  # a shape that changes is kept
    np.testing.assert_array_equal(recording.garments[0].rest.vertices, STRIP.astype(np.float32))


def test_a_converted_sequence_is_the_same_and_needs_no_pickle(tmp_path):
    """If this fails, converting loses or changes data, or leaves a file that needs pickle."""
    path = write(tmp_path / "tshirt_shape00_07_02.pkl", sequence())
    write_obj(tmp_path / "rest.obj", REST, TRIANGLES)
    output = convert_vto(path, tmp_path / "out" / "tshirt_shape00_07_02.npz", rest=tmp_path / "rest.obj")
    with np.load(output, allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["vertices"], moving(STRIP, FRAMES))
    motion = GarmentMotion.load(output)
    assert (motion.fps, motion.name, len(motion)) == (30.0, "tshirt", FRAMES)
    before, after = read_vto(path, rest=tmp_path / "rest.obj"), read_recording(output)
    assert detect(output) == "vto"
    np.testing.assert_array_equal(after.garments[0].vertices, before.garments[0].vertices)
    np.testing.assert_array_equal(after.garments[0].rest.vertices, before.garments[0].rest.vertices)
    np.testing.assert_array_equal(after.poses.rotations, before.poses.rotations)
    np.testing.assert_array_equal(after.poses.betas, before.poses.betas)
    assert after.attributes == before.attributes
    with pytest.raises(MeshError, match=r"a converted sequence is an \.npz file"):
        convert_vto(path, tmp_path / "out.pkl")


class Runs:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def test_a_sequence_with_a_command_in_it_is_refused(tmp_path):
    """If this fails, reading or converting somebody's data set runs their commands."""
    marker = tmp_path / "ran"
    path = write(tmp_path / "tshirt_evil.pkl", sequence(conf=Runs(marker)))
    assert detect(path) == "vto"
    for read in (read_vto, read_recording, lambda p: convert_vto(p, tmp_path / "out.npz")):
        with pytest.raises(PickleRefused, match=r"global '(posix|nt)\.system' at byte [\d,]+ refused"):
            read(path)
    assert not marker.exists()
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"vertices": None}, "no 'vertices' in it; this is not a VTO sequence. It holds conf, faces, pose"),
        ({"vertices": [[0.0, 1.0]]}, "vertices must be an array of numbers with 3 dimensions, it is list"),
        ({"vertices": np.zeros((0, 6, 3))}, "vertices hold no frame"),
        ({"vertices": moving(STRIP[:5], FRAMES)}, "1 of 4 faces name vertices that do not exist"),
        ({"faces": TRIANGLES * 0.5}, r"faces \[4, 3\] of float64; they must be"),
        ({"vertices": moving(STRIP, 3)}, r"3 frames of the garment, pose \[4, 72\] and translation \[4, 3\]"),
        ({"translation": None}, "pose has 72 columns and there is no 'translation'"),
        ({"vertices": moving(STRIP, FRAMES) * np.array([1, np.nan, 1])}, r"4 of 4 frames of tshirt hold NaN"),
        ({"pose": np.full((FRAMES, 72), np.inf)}, r"tshirt\.pkl: 4 of 4 frames have SMPL rotations that are NaN"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*no rest shape")
def test_damaged_sequences_are_named(tmp_path, changes, match):
    """If this fails, a damaged sequence becomes wrong training data, or an error that does not say what to do."""
    with pytest.raises(MeshError, match=match):
        read_vto(write(tmp_path / "tshirt.pkl", sequence(**changes)))


@pytest.mark.filterwarnings("ignore:.*no rest shape")
def test_sequences_that_do_not_fit_are_named(tmp_path):
    """If this fails, a rest shape of another garment or a pickle of something else is taken."""
    path = write(tmp_path / "tshirt.pkl", sequence())
    write_obj(tmp_path / "other.obj", STRIP[:4], TRIANGLES[:2])
    with pytest.raises(MeshError, match=r"other.obj has 4 vertices, the garment of tshirt.pkl 6"):
        read_vto(path, rest=tmp_path / "other.obj")
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(MeshError, match=r"a list, not a dictionary"):
        read_vto(tmp_path / "list.pkl")
    poseless = write(tmp_path / "bare.pkl", sequence(pose=None))
    assert read_vto(poseless).poses is None
    with pytest.raises(MeshError, match="No SMPL poses in the files to make a body of"):
        read_vto(poseless, body=lambda poses: None)


def test_poses_are_written_as_amass_has_them(tmp_path):
    """If this fails, motions taken from a data set fall over when used as clips: AMASS has Z up.

    The first rotation of VTO is in Y-up axes; in AMASS's it is turned by +90 degrees about X.
    """
    path = write(tmp_path / "tshirt.pkl", sequence())
    with pytest.warns(UserWarning, match="no rest shape"):
        recording = read_vto(path)
    recording.poses.save_amass(tmp_path / "clip.npz")
    assert detect(tmp_path / "clip.npz") == "amass"
    with pytest.raises(MeshError, match="AMASS motion: it moves a body and has no garment"):
        read_recording(tmp_path / "clip.npz")
    given = sequence()
    with np.load(tmp_path / "clip.npz", allow_pickle=False) as clip:
        assert clip["poses"].shape == (FRAMES, 156)
        np.testing.assert_array_equal(clip["poses"][:, 3:66], given["pose"][:, 3:66])
        assert not clip["poses"][:, 66:].any()
        x, y, z = given["translation"].T
        np.testing.assert_array_equal(clip["trans"], np.stack([x, -z, y], axis=1))
        quarter = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
        before, after = (Rotation.from_rotvec(p[:, :3]).as_matrix() for p in (given["pose"], clip["poses"]))
        np.testing.assert_allclose(after, quarter @ before, atol=1e-12)
        assert (float(clip["mocap_framerate"]), str(clip["gender"])) == (30.0, "female")
