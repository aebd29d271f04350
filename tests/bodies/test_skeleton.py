"""Skeletons: poses, their mirror images, blending and lifted arms."""

from __future__ import annotations

import numpy as np
from support.bodies import rest_body

from warpgarment.bodies import skeleton
from warpgarment.geometry.skinning import linear_blend_skinning
from warpgarment.training.motions.procedural import procedural


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
