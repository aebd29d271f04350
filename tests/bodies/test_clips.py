"""Motion clips: BVH and AMASS, in time, and on another body."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bodies import rest_body, write_amass, write_bvh

from warpgarment.bodies import skeleton
from warpgarment.bodies.amass import read_amass
from warpgarment.bodies.bvh import read_bvh
from warpgarment.bodies.clip import Clip, resampled
from warpgarment.bodies.clips import clip_frames, jumps, list_clips, read_clip, retarget
from warpgarment.errors import MeshError
from warpgarment.training.motions.procedural import procedural

ARM = [("Hips", None, (0.0, 0.0, 0.0)), ("Spine", "Hips", (0.0, 2.0, 0.0)), ("Head", "Spine", (0.0, 3.0, 0.0))]

ONE_JOINT = "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 3 Zrotation Xrotation Yrotation } "


def test_bvh_rotations_are_the_products_of_its_channels(tmp_path):
    """If this fails, every clip is read with wrong joint rotations. Twin: SciPy's Euler products, written out."""
    frame = [1.0, 5.0, -2.0, 10.0, 20.0, 30.0, -40.0, 5.0, 15.0, 0.0, 50.0, -25.0]
    clip = read_bvh(write_bvh(tmp_path / "a.bvh", ARM, [frame, frame], fps=60.0))

    def turn(z, x, y):
        def about(axis, angle):
            return Rotation.from_euler(axis, angle, degrees=True).as_matrix()

        return about("z", z) @ about("x", x) @ about("y", y)

    hips = turn(10, 20, 30)
    spine = hips @ turn(-40, 5, 15)
    np.testing.assert_allclose(clip.rotations[0, 0], hips, atol=1e-9)
    np.testing.assert_allclose(clip.rotations[1, 1], spine, atol=1e-9)
    np.testing.assert_allclose(clip.rotations[0, 2], spine @ turn(0, 50, -25), atol=1e-9)
    np.testing.assert_allclose(clip.root[0], [1, 5, -2])
    assert clip.fps == pytest.approx(60.0, rel=1e-4)


def test_a_z_up_clip_is_turned_y_up(tmp_path):
    """If this fails, clips of Z-up files lie on their backs."""
    lying = [(n, p, (x, -z, y)) for n, p, (x, y, z) in ARM]
    frame = [1.0, 2.0, 7.0] + [0.0] * 9
    clip = read_bvh(write_bvh(tmp_path / "z.bvh", lying, [frame, frame]))
    np.testing.assert_allclose(clip.offsets, [o for _, _, o in ARM], atol=1e-9)
    np.testing.assert_allclose(clip.root[0], [1.0, 7.0, -2.0], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not a motion", "is not a BVH file"),
        (ONE_JOINT + "MOTION Frames: 2 Frame Time: 0.03 1 2", "2 frames of 3 channels announced, 2 numbers"),
        (ONE_JOINT + "MOTION Frames: 1 Frame Time: 0.03 1 2 x", "not a number"),
        (ONE_JOINT + "MOTION Frames: 2 Frame Time: 0.03 1 2 3 4 nan 6", r"1 of 2 frames hold NaN .*first: frame 1"),
        (ONE_JOINT + "MOTION Frames: 1 Frame Time: 1e-9 1 2 3", "no frame rate"),
        ("HIERARCHY ROOT a { OFFSET 0 x 0 } MOTION Frames: 1 Frame Time: 0.03 1", "HIERARCHY section is incomplete"),
    ],
)
def test_a_damaged_clip_is_refused(tmp_path, text, message):
    """If this fails, a damaged clip becomes a damaged data set."""
    path = tmp_path / "bad.bvh"
    path.write_text(text)
    with pytest.raises(MeshError, match=message):
        read_bvh(path)


def test_retargeted_limbs_point_where_the_clip_points(tmp_path):
    """If this fails, retargeting bends limbs. The clip is a T-pose: arms must come out along X, legs along -Y."""
    body = rest_body()
    offsets = {
        "LeftUpLeg": (0.1, -0.1, 0), "LeftLeg": (0, -4, 0), "LeftFoot": (0, -4, 0),
        "RightUpLeg": (-0.1, -0.1, 0), "RightLeg": (0, -4, 0), "RightFoot": (0, -4, 0),
        "Head": (0, 5, 0), "LeftArm": (1, 4, 0), "LeftForeArm": (3, 0, 0), "LeftHand": (3, 0, 0),
        "RightArm": (-1, 4, 0), "RightForeArm": (-3, 0, 0), "RightHand": (-3, 0, 0),
    }  # fmt: skip
    above = {
        "LeftLeg": "LeftUpLeg", "LeftFoot": "LeftLeg", "RightLeg": "RightUpLeg", "RightFoot": "RightLeg",
        "LeftForeArm": "LeftArm", "LeftHand": "LeftForeArm", "RightForeArm": "RightArm", "RightHand": "RightForeArm",
    }  # fmt: skip
    joints = [("Hips", None, (0.0, 0.0, 0.0))] + [(n, above.get(n, "Hips"), o) for n, o in offsets.items()]
    frame = [0.0, 8.0, 0.0] + [0.0] * (3 * len(joints))
    poses = retarget(read_bvh(write_bvh(tmp_path / "t.bvh", joints, [frame] * 3)), body)
    transforms = skeleton.bone_transforms(body, poses)
    for bone, child, direction in (
        ("LeftArm", "LeftForeArm", (1, 0, 0)),
        ("RightForeArm", "RightHand", (-1, 0, 0)),
        ("LeftUpLeg", "LeftLeg", (0, -1, 0)),
        ("RightLeg", "RightFoot", (0, -1, 0)),
    ):
        a, b = (
            transforms[0, body.bone(n), :, :3] @ body.joint(n) + transforms[0, body.bone(n), :, 3]
            for n in (bone, child)
        )
        np.testing.assert_allclose((b - a) / np.linalg.norm(b - a), direction, atol=1e-5)  # float32 transforms
    hip, knee, ankle = (body.joint(n) for n in ("LeftUpLeg", "LeftLeg", "LeftFoot"))
    leg = np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee)
    np.testing.assert_allclose(poses.root[0], [0, 8.0 * leg / 8.0, 0], atol=1e-9)


def test_a_clip_with_foreign_joint_names_says_so(tmp_path):
    """If this fails, a clip with unknown joints gives a body that stands still."""
    clip = read_bvh(write_bvh(tmp_path / "f.bvh", ARM, [[0.0] * 12] * 2))
    with pytest.raises(MeshError, match="8 bones have no joint in the clip"):
        retarget(clip, rest_body())


def test_resampling_a_constant_rotation_is_exact():
    """If this fails, clips at 120 fps stutter at 30, or limbs shrink between frames. Twin: the rotation by formula."""
    axis = np.array([0.6, 0.0, 0.8])
    for rate, fps in ((120.0, 30.0), (100.0, 30.0), (24.0, 30.0), (59.94, 30.0)):
        time = np.arange(37) / rate
        turn = Rotation.from_rotvec(np.outer(4.0 * time, axis)).as_matrix()
        clip = Clip(("Hips",), np.zeros((1, 3)), turn[:, None], np.outer(time, [1.0, 2.0, 3.0]), rate)
        at = resampled(clip, fps)
        wanted = np.arange(len(at)) / fps
        assert wanted[-1] <= time[-1] + 1e-9 < wanted[-1] + 1 / fps + 1e-9  # all that the clip holds, and no more
        exact = Rotation.from_rotvec(np.outer(4.0 * wanted, axis)).as_matrix()
        np.testing.assert_allclose(at.rotations[:, 0], exact, atol=1e-12)
        np.testing.assert_allclose(at.root, np.outer(wanted, [1.0, 2.0, 3.0]), atol=1e-12)


T_POSE = {
    "Hips": (None, (0, 0, 0)), "LeftUpLeg": ("Hips", (0.1, -0.1, 0)), "LeftLeg": ("LeftUpLeg", (0, -0.4, 0)),
    "LeftFoot": ("LeftLeg", (0, -0.4, 0)), "RightUpLeg": ("Hips", (-0.1, -0.1, 0)),
    "RightLeg": ("RightUpLeg", (0, -0.4, 0)), "RightFoot": ("RightLeg", (0, -0.4, 0)),
    "Spine1": ("Hips", (0, 0.3, 0)), "Head": ("Spine1", (0, 0.3, 0)),
    "LeftArm": ("Spine1", (0.2, 0.1, 0)), "LeftForeArm": ("LeftArm", (0.26, 0, 0)),
    "LeftHand": ("LeftForeArm", (0.25, 0, 0)), "RightArm": ("Spine1", (-0.2, 0.1, 0)),
    "RightForeArm": ("RightArm", (-0.26, 0, 0)), "RightHand": ("RightForeArm", (-0.25, 0, 0)),
}  # fmt: skip


def test_an_amass_motion_equals_the_same_motion_in_bvh(tmp_path):
    """If this fails, AMASS motions lie on their sides, or limbs turn about the wrong axes.

    The same joint angles are written as axis-angles, Z up, in SMPL's order, and as Euler angles, Y up, in a BVH file
    whose T-pose has limbs along the axes; SMPL's are a few degrees off (its offsets are rounded), hence directions are
    compared relative to the first frame, the T-pose.
    """
    rng = np.random.default_rng(4)
    frames, body = 5, rest_body()
    twins = {"Hips": "pelvis", "LeftUpLeg": "left_hip", "RightLeg": "right_knee", "Spine1": "spine3",
             "LeftArm": "left_shoulder", "RightForeArm": "right_elbow"}  # fmt: skip
    turns = {name: Rotation.from_rotvec(rng.normal(0, 0.4, (frames, 3)) * (np.arange(frames)[:, None] > 0))
             for name in twins}  # fmt: skip
    travel = rng.normal(0, 1, (frames, 3)) * np.array([1.0, 0.1, 1.0])
    z_up = Rotation.from_euler("x", 90, degrees=True)
    amass = {twins[name]: (z_up * turn if name == "Hips" else turn).as_rotvec() for name, turn in turns.items()}
    write_amass(tmp_path / "m.npz", amass, frames, 30.0, trans=z_up.apply(travel))
    joints = [(name, parent, offset) for name, (parent, offset) in T_POSE.items()]
    order = ["Hips"]
    for name in order:  # depth first, as BVH files are written
        at = order.index(name) + 1
        order[at:at] = [child for child, (parent, _) in T_POSE.items() if parent == name]
    still = Rotation.identity(frames)
    angles = np.concatenate([turns.get(name, still).as_euler("ZXY", degrees=True) for name in order], axis=1)
    write_bvh(tmp_path / "m.bvh", joints, np.concatenate([travel, angles], axis=1))
    ours, theirs = (retarget(read_clip(tmp_path / f"m{suffix}"), body) for suffix in (".npz", ".bvh"))
    for name in T_POSE:
        bone = body.bone(name)
        a, b = (p.rotations[1:, bone] @ p.rotations[0, bone].T for p in (ours, theirs))
        np.testing.assert_allclose(a, b, atol=1e-6, err_msg=name)  # BVH is written with six decimals
        apart = Rotation.from_matrix(ours.rotations[0, bone].T @ theirs.rotations[0, bone]).magnitude()
        assert np.degrees(apart) < 10.0, name
    ratio = 0.78 / 0.8  # of the lengths of the legs
    moved = [np.diff(p.root, axis=0) for p in (ours, theirs)]
    np.testing.assert_allclose(moved[0] * ratio, moved[1], rtol=0.03, atol=1e-5)


def test_headers_tell_the_length_of_clips(tmp_path):
    """If this fails, windows are planned that clips do not have."""
    body = rest_body()
    joints = [(name, parent, offset) for name, (parent, offset) in T_POSE.items()]
    frame = [0.0, 1.0, 0.0] + [0.0] * 3 * len(joints)
    for frames, rate in ((1, 30.0), (121, 120.0), (50, 24.0), (61, 59.94)):
        write_bvh(tmp_path / "b.bvh", joints, [frame] * frames, rate)
        write_amass(tmp_path / "a.npz", {}, frames, rate)
        for path in list_clips(tmp_path):
            assert clip_frames(path) == len(retarget(read_clip(path), body)), (path.name, frames, rate)
    write_amass(tmp_path / "A.NPZ.npz", {}, 10, None, mocap_frame_rate=np.array(60))  # as newer releases name it
    assert clip_frames(tmp_path / "A.NPZ.npz") == 5
    (tmp_path / "notes.txt").write_text("no clip")
    (tmp_path / "folder.bvh").mkdir()
    assert [p.name for p in list_clips(tmp_path)] == ["A.NPZ.npz", "a.npz", "b.bvh"]
    with pytest.raises(MeshError, match=r"not from '\.txt'"):
        clip_frames(tmp_path / "notes.txt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": None}, "it lacks poses"),
        ({"mocap_framerate": None}, "it lacks mocap_framerate"),
        ({"mocap_framerate": np.array(0.0)}, "0 frames per second is no frame rate"),
        ({"mocap_framerate": np.array([30.0, 60.0])}, "mocap_framerate must be one number"),
        ({"poses": np.zeros((4, 150))}, r"poses must be numbers \[T,D\].*float64 \[4, 150\]"),
        ({"poses": np.zeros((0, 156))}, r"float64 \[0, 156\]"),
        ({"trans": np.zeros((3, 3))}, r"trans must be \[T,3\], T = 4 as in poses, got \[3, 3\]"),
        ({"trans": np.array([[0.0] * 3, [np.nan] * 3, [0.0] * 3, [np.inf] * 3])}, r"2 of 4 frames.*first: frame 1"),
        ({"poses": np.array([{}] * 4, dtype=object)}, "not an .npz file of plain arrays"),
    ],
)
def test_a_damaged_amass_motion_is_refused(tmp_path, change, message):
    """If this fails, a damaged motion becomes a damaged data set, or code in a file is run."""
    path = write_amass(tmp_path / "bad.npz", {}, 4, **change)
    with pytest.raises(MeshError, match=message):
        read_amass(path)
    (tmp_path / "text.npz").write_text("no archive")
    for read in (read_amass, clip_frames):
        with pytest.raises(MeshError, match=r"text\.npz is not an \.npz file"):
            read(tmp_path / "text.npz")


def test_smpl_and_smplx_motions_read_alike(tmp_path):
    """If this fails, only one of the releases of AMASS can be read."""
    turns = np.random.default_rng(0).normal(0, 0.3, (3, 66))
    clips = []
    for width in (66, 72, 156, 165):
        poses = np.zeros((3, width))
        poses[:, :66] = turns
        clips.append(read_amass(write_amass(tmp_path / "m.npz", {}, 3, poses=poses)))
    for clip in clips[1:]:
        np.testing.assert_array_equal(clip.rotations, clips[0].rotations)


def test_frames_to_which_nobody_moves_are_named():
    """If this fails, lost markers throw the body about and the cloth after it."""
    body = rest_body()
    poses = procedural(body, "run", 40, seed=1)
    assert not jumps(body, poses).any()
    broken = poses.rotations.copy()
    for bone in body.chain("LeftLeg"):
        broken[10, bone] = Rotation.from_euler("y", 80, degrees=True).as_matrix() @ broken[10, bone]
    root = poses.root + np.where(np.arange(40)[:, None] >= 20, [0.0, 0.0, 1.0], 0.0)
    named = jumps(body, skeleton.PoseSequence(broken, root))
    np.testing.assert_array_equal(np.flatnonzero(named), [10, 11, 20])
