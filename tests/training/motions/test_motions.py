"""Motion clips, procedural motions and skeletons."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bodies import rest_body, write_amass, write_bvh

from warpgarment.errors import MeshError
from warpgarment.geometry.skinning import linear_blend_skinning
from warpgarment.training.bodies import skeleton
from warpgarment.training.motions.amass import read_amass
from warpgarment.training.motions.bvh import read_bvh
from warpgarment.training.motions.clip import Clip, resampled
from warpgarment.training.motions.clips import clip_frames, jumps, list_clips, read_clip, retarget
from warpgarment.training.motions.procedural import KINDS, procedural

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


@pytest.mark.parametrize("kind", KINDS)
def test_procedural_motions_are_rotations_and_smooth(kind):
    """If this fails, a formula tears the body: no rotation matrices, or jumps between frames."""
    body = rest_body()
    poses = procedural(body, kind, 90, seed=3)
    identity = poses.rotations @ poses.rotations.transpose(0, 1, 3, 2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-9)
    step = Rotation.from_matrix((poses.rotations[1:] @ poses.rotations[:-1].transpose(0, 1, 3, 2)).reshape(-1, 3, 3))
    assert np.degrees(step.magnitude()).max() < 35.0  # a run's shin swings at about 900 degrees a second
    assert np.abs(np.diff(poses.root, axis=0)).max() < 0.2
    again = procedural(body, kind, 90, seed=3)
    np.testing.assert_array_equal(poses.rotations, again.rotations)


def test_rest_pose_leaves_the_body_as_it_is():
    """If this fails, bone transforms move a body that should stand in its rest pose."""
    body = rest_body()
    rest = skeleton.PoseSequence(np.tile(np.eye(3), (2, len(body.bone_names), 1, 1)), np.tile(body.joints[0], (2, 1)))
    transforms = skeleton.bone_transforms(body, rest)
    posed = linear_blend_skinning(body.vertices, body.bone_indices, body.bone_weights, transforms)
    np.testing.assert_allclose(posed[1], body.vertices, atol=2e-6)  # float32


def test_blending_in_starts_at_rest_and_ends_at_the_motion():
    """If this fails, garments made on the rest pose do not fit the first frame, or the motion jumps after the blend."""
    body = rest_body()
    motion = procedural(body, "walk", 40, seed=1)[20:]
    blended = skeleton.blended_in(body, skeleton.facing_forward(motion), 30)
    np.testing.assert_allclose(blended.rotations[0], np.broadcast_to(np.eye(3), blended.rotations[0].shape), atol=1e-9)
    gap = np.abs(blended.rotations[30] - blended.rotations[29]).max()
    usual = np.abs(np.diff(blended.rotations[5:25], axis=0)).max()
    assert gap <= usual
    assert len(blended) == 50


def test_mirroring_twice_is_nothing_and_once_swaps_sides():
    """If this fails, mirrored motions are not mirror images."""
    body = rest_body()
    poses = procedural(body, "walk", 30, seed=5)
    once = skeleton.mirrored(body, poses)
    np.testing.assert_allclose(skeleton.mirrored(body, once).rotations, poses.rotations, atol=1e-12)
    left, right = body.bone("LeftLeg"), body.bone("RightLeg")
    flip = np.diag([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(once.rotations[:, left], flip @ poses.rotations[:, right] @ flip, atol=1e-12)


def test_abducted_arms_move_away_from_the_torso():
    """If this fails, arms are pressed into the torso instead of lifted off it."""
    body = rest_body()
    poses = procedural(body, "bend", 5, seed=0)
    before, after = (skeleton.bone_transforms(body, p) for p in (poses, skeleton.arms_abducted(body, poses, 15.0)))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        hand = body.bone(f"{side}Hand")
        place = body.joints[hand]
        x = [sign * (t[0, hand, :, :3] @ place + t[0, hand, :, 3])[0] for t in (before, after)]
        assert x[1] > x[0] + 0.05


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


def test_joints_of_the_mirrored_motion_are_mirror_images():
    """If this fails, mirrored motions are not what a mirror shows. Twin: the joints' positions, reflected."""
    body = rest_body()
    poses = skeleton.arms_abducted(body, procedural(body, "turn", 40, seed=5), 10.0)

    def joints(of: skeleton.PoseSequence) -> np.ndarray:
        transforms = skeleton.bone_transforms(body, of).astype(np.float64)
        return np.einsum("tbij,bj->tbi", transforms[..., :3], body.joints) + transforms[..., 3]

    swap = {"Left": "Right", "Right": "Left", "LHip": "RHip", "RHip": "LHip", "LThumb": "RThumb", "RThumb": "LThumb"}
    twins = [
        next((swap[s] + name[len(s) :] for s in swap if name.startswith(s)), name) for name in body.bone_names
    ]  # fmt: skip
    expected = joints(poses)[:, [body.bone(name) for name in twins]] * np.array([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(joints(skeleton.mirrored(body, poses)), expected, atol=1e-3)  # the rest pose is, to this


def test_halfway_through_the_blend_joints_are_half_turned():
    """If this fails, the transition from the rest pose is not the shortest one. Twin: half of each joint's angle."""
    body = rest_body()
    motion = skeleton.facing_forward(procedural(body, "jump", 60, seed=2)[40:])
    blended = skeleton.blended_in(body, motion, 20)
    for name in ("LeftArm", "RightForeArm", "LeftUpLeg", "RightLeg", "Spine1"):
        bone, parent = body.bone(name), body.bone_parents[body.bone(name)]
        half, full = (blended.rotations[k, parent].T @ blended.rotations[k, bone] for k in (10, 20))
        np.testing.assert_allclose(half @ half, full, atol=1e-9)
    np.testing.assert_allclose(blended.root[10, 1], 0.5 * (body.joints[0, 1] + motion.root[0, 1]))


@pytest.mark.parametrize("kind", KINDS)
def test_procedural_feet_stay_on_the_floor(kind):
    """If this fails, bodies float or wade: skirts and trousers then move as on nobody."""
    body = rest_body()
    frames, _ = skeleton.posed(body, procedural(body, kind, 90, seed=4))
    lowest = frames[:, :, 1].min(1)
    assert lowest.min() > -0.03
    airborne = {"run": 0.09, "jump": 0.35}.get(kind, 0.03)  # heights of the flights, and smoothing by 50 ms
    assert lowest.max() < airborne
    assert np.median(lowest) < 0.05
