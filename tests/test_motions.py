"""Motion clips, procedural motions and skeletons."""

from __future__ import annotations

import numpy as np
import pytest
from data_bodies import rest_body, write_bvh
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError
from warpgarment.skinning import linear_blend_skinning
from warpgarment.training import skeleton
from warpgarment.training.motions import read_bvh, retarget
from warpgarment.training.procedural import KINDS, procedural

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
    before, after = (
        skeleton.bone_transforms(body, p) for p in (poses, skeleton.arms_abducted(body, poses, 15.0))
    )
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        hand = body.bone(f"{side}Hand")
        place = body.joints[hand]
        x = [sign * (t[0, hand, :, :3] @ place + t[0, hand, :, 3])[0] for t in (before, after)]
        assert x[1] > x[0] + 0.05
