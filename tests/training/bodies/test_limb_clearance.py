"""Clearance between limbs and torso: restored where it is missing, by little, smoothly, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bodies import rest_body

from warpgarment.bodies import skeleton
from warpgarment.training.bodies.limb_clearance import resolve_clearance
from warpgarment.training.motions.procedural import procedural

GAP = 0.02
FRAMES, PRESSED = 80, slice(24, 56)
# Tubes stand for limbs and vertices for the rest: sampling, and skin that folds at the shoulder, cost some millimetres.
MODEL_ERROR = 0.008


def turned_limbs(turns: dict[str, tuple[float, float, float]], frames: int = FRAMES) -> skeleton.PoseSequence:
    """The rest pose, with limbs turned by rotation vectors [degrees] and back between the frames PRESSED."""
    body = rest_body()
    rotations = np.tile(np.eye(3), (frames, len(body.bone_names), 1, 1))
    time = np.arange(PRESSED.start, PRESSED.stop)
    share = np.sin(np.pi * (time - PRESSED.start + 0.5) / len(time)) ** 2
    for limb, vector in turns.items():
        turn = Rotation.from_rotvec(np.radians(np.outer(share, vector))).as_matrix()
        for bone in body.chain(limb):
            rotations[time, bone] = turn @ rotations[time, bone]
    return skeleton.PoseSequence(rotations, np.tile(body.joints[0], (frames, 1)))


def true_gaps(poses: skeleton.PoseSequence, limb: tuple[str, str], others: np.ndarray, every: int = 4) -> np.ndarray:
    """Least distance from a limb's middle part to the surface of other vertices [m], by libigl, in some frames."""
    body = rest_body()
    head, tail = (body.joint(name) for name in limb)
    along = (body.vertices - head) @ (tail - head) / ((tail - head) @ (tail - head))
    own = (body.weight_of(limb[0]) - body.weight_of(limb[1]) > 0.5) & (along > 0.4) & (along < 0.9)
    faces = body.faces[others[body.faces].all(1)].astype(np.int64)
    posed, _ = skeleton.posed(body, poses[::every])
    sign = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    return np.array([igl.signed_distance(v[own], v, faces, sign_type=sign)[0].min() for v in posed.astype(float)])


def trunk() -> np.ndarray:
    body = rest_body()
    return body.weight_of("LeftArm", "RightArm", "LeftUpLeg", "RightUpLeg") < 0.05


@pytest.mark.parametrize(
    "turn", [(0.0, 0.0, -52.0), (-25.0, 30.0, -60.0)], ids=["pressed to the side", "crossed over the chest"]
)
def test_an_arm_pressed_into_the_torso_is_lifted_off_it(turn):
    """If this fails, sleeves are crushed between arm and torso, and the simulation is rejected."""
    pressed = turned_limbs({"LeftArm": turn})
    cleared = resolve_clearance(rest_body(), pressed, GAP)
    arm = ("LeftArm", "LeftForeArm")
    assert true_gaps(pressed, arm, trunk()).min() < 0.0
    assert true_gaps(cleared.poses, arm, trunk()).min() > GAP - MODEL_ERROR
    assert not cleared.unresolved.any()
    assert cleared.gap_before.min() < 0.0
    assert cleared.gap_after.min() > GAP - 1.1e-3  # the tolerance of a millimetre, and rounding


def test_what_touches_nothing_is_left_alone_bit_by_bit():
    """If this fails, motions are changed that had no need of it."""
    body = rest_body()
    lifted = skeleton.arms_abducted(body, procedural(body, "arms", 40, seed=1), 20.0)
    cleared = resolve_clearance(body, lifted, GAP)
    np.testing.assert_array_equal(cleared.poses.rotations, lifted.rotations)
    assert not cleared.unresolved.any()
    assert not cleared.turned.any()

    pressed = turned_limbs({"LeftArm": (0.0, 0.0, -52.0)})
    cleared = resolve_clearance(body, pressed, GAP)
    changed = (cleared.poses.rotations != pressed.rotations).any((2, 3))
    assert set(np.flatnonzero(changed.any(0))) == set(body.chain("LeftArm"))
    still = np.r_[0 : PRESSED.start - 17, PRESSED.stop + 17 : FRAMES]  # twice 8 frames of easing at 30 fps
    np.testing.assert_array_equal(cleared.poses.rotations[still], pressed.rotations[still])
    np.testing.assert_array_equal(cleared.poses.root, pressed.root)


def test_limbs_turn_by_the_least_and_smoothly():
    """If this fails, arms are thrown up more than clothes need, or jerk where the contact begins."""
    body = rest_body()
    pressed = turned_limbs({"LeftArm": (0.0, 0.0, -52.0)})
    cleared = resolve_clearance(body, pressed, GAP)
    deepest = int(cleared.gap_before.argmin())
    assert cleared.gap_after[deepest] < GAP + 0.006  # linear interpolation between 12 angles, and easing in time
    assert 5.0 < cleared.turned.max() < 40.0
    arm = cleared.poses.rotations[:, body.bone("LeftArm")]
    speed = np.degrees(Rotation.from_matrix(arm[1:] @ arm[:-1].transpose(0, 2, 1)).magnitude())
    given = pressed.rotations[:, body.bone("LeftArm")]
    usual = np.degrees(Rotation.from_matrix(given[1:] @ given[:-1].transpose(0, 2, 1)).magnitude())
    assert speed.max() <= usual.max()  # lifting off takes from the motion into the torso
    assert np.abs(np.diff(cleared.turned)).max() < 4.0
    assert np.abs(np.diff(cleared.turned, n=2)).max() < 1.5


def test_legs_that_cross_are_spread_evenly():
    """If this fails, trousers and skirts are caught between the thighs."""
    body = rest_body()
    crossed = turned_limbs({"LeftUpLeg": (0.0, 0.0, -13.0), "RightUpLeg": (0.0, 0.0, 13.0)})
    cleared = resolve_clearance(body, crossed, GAP)
    other = body.weight_of("RightUpLeg") > 0.95
    assert true_gaps(crossed, ("LeftUpLeg", "LeftLeg"), other).min() < 0.0
    assert true_gaps(cleared.poses, ("LeftUpLeg", "LeftLeg"), other).min() > GAP - MODEL_ERROR
    assert not cleared.unresolved.any()
    angles = [
        Rotation.from_matrix(cleared.poses.rotations[:, body.bone(name)]).as_rotvec()
        - Rotation.from_matrix(crossed.rotations[:, body.bone(name)]).as_rotvec()
        for name in ("LeftUpLeg", "RightUpLeg")
    ]
    left, right = (np.linalg.norm(a, axis=1).max() for a in angles)
    assert left == pytest.approx(right, rel=0.05)  # the body is not quite symmetric


def test_frames_that_cannot_be_resolved_are_named():
    """If this fails, hopeless frames go into the simulation instead of being cut out."""
    pressed = turned_limbs({"LeftArm": (0.0, 0.0, -52.0)})
    cleared = resolve_clearance(rest_body(), pressed, GAP, limit=4.0)
    assert cleared.turned.max() <= 4.0 + 1e-4
    middle = (PRESSED.start + PRESSED.stop) // 2
    assert cleared.unresolved[middle - 4 : middle + 4].all()
    assert not cleared.unresolved[: PRESSED.start].any()
    np.testing.assert_array_equal(cleared.unresolved, cleared.gap_after < GAP - 1e-3)
    kept = cleared.longest
    assert not cleared.unresolved[kept].any()
    assert kept.start == 0 or kept.stop == FRAMES
    assert kept.stop - kept.start >= PRESSED.start


def test_clearance_turns_with_the_body_and_needs_frames():
    """If this fails, the result depends on where the body stands and which way it faces, or nonsense is accepted."""
    body = rest_body()
    pressed = turned_limbs({"RightArm": (0.0, 0.0, 52.0)})[20:60]
    there = skeleton.turned(pressed, 2.0)
    there = replace(there, root=there.root + np.array([1.0, 0.0, -2.0]))
    here, away = (resolve_clearance(body, p, GAP) for p in (pressed, there))
    np.testing.assert_allclose(away.gap_after, here.gap_after, atol=1e-4)  # float32 skinning
    np.testing.assert_allclose(away.turned, here.turned, atol=0.2)
    with pytest.raises(ValueError, match="0 frames"):
        resolve_clearance(body, pressed[:0], GAP)
    with pytest.raises(ValueError, match="positive gap"):
        resolve_clearance(body, pressed, 0.0)


def test_the_longest_run_of_good_frames():
    """If this fails, the wrong part of a motion is kept."""
    bad = np.array([True, False, False, True, False, False, False, True])
    assert skeleton.longest_run(bad) == slice(4, 7)
    assert skeleton.longest_run(np.zeros(3, bool)) == slice(0, 3)
    assert skeleton.longest_run(np.ones(3, bool)) == slice(0, 0)
