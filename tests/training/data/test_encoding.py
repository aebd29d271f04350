"""Compact numbers: bounded errors against the floats, and the same numbers again however often they are written."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.bodies import rest_body

from warpgarment.errors import MeshError
from warpgarment.training.data import encoding


def _rotations() -> np.ndarray:
    """Random rotations, small ones, and those whose quaternions have equal components, [N,3,3]."""
    rng = np.random.default_rng(0)
    turns = Rotation.random(400, random_state=rng)
    small = Rotation.from_rotvec(1e-3 * rng.standard_normal((100, 3)))
    quarter = Rotation.create_group("O")  # the cube's: quaternions of 1, of two and of four equal components
    nearly = quarter * Rotation.from_rotvec(1e-6 * rng.standard_normal((24, 3)))
    return np.concatenate([r.as_matrix() for r in (turns, small, quarter, nearly)])


def test_positions_are_within_half_a_step():
    """If this fails, folds are moved by more than the box's size over 131,070. Against the float64 positions; float32
    itself rounds by 2.4e-7 m at 2 to 4 m."""
    rng = np.random.default_rng(1)
    positions = rng.uniform(-1, 1, (4, 50, 3)) * [0.7, 0.4, 0.1] + [1.0, 1.2, -3.0]
    codes, boxes = encoding.boxed(positions)
    assert codes.dtype == np.uint16
    assert boxes.shape == (4, 2, 3)
    half = np.ptp(positions, axis=1, keepdims=True) / 65535 / 2
    assert (np.abs(encoding.unboxed(codes, boxes) - positions) <= half + 2.4e-7).all()
    again = encoding.boxed(encoding.unboxed(codes, boxes))
    np.testing.assert_array_equal(again[0], codes)
    np.testing.assert_array_equal(again[1], boxes)


def test_flat_and_broken_frames():
    """If this fails, a frame without extent divides by zero, or one NaN spreads to other frames or is hidden."""
    positions = np.full((3, 4, 3), 0.25, np.float32)
    positions[1, 2, 0] = np.nan
    positions[2, 2, 0] = 3.0
    read = encoding.unboxed(*encoding.boxed(positions))
    np.testing.assert_array_equal(read[0], positions[0])
    assert np.isnan(read[1]).all()
    np.testing.assert_array_equal(read[2], positions[2])


def test_rotations_are_close_and_stay_the_same():
    """If this fails, hands are off by more than 0.01 mm, or the stored body is not the one that was simulated on. The
    angle between R and R' from their distance, |R - R'|_F = 2 sqrt(2) sin(angle / 2), in float64."""
    matrices = _rotations()
    codes = encoding.packed_rotations(matrices)
    assert codes.dtype == np.uint64
    read = encoding.unpacked_rotations(codes)
    angle = 2 * np.arcsin(np.linalg.norm(read - matrices, axis=(1, 2)) / np.sqrt(8))
    assert angle.max() < 4e-6
    first = read.astype(np.float32)
    second = encoding.unpacked_rotations(encoding.packed_rotations(first)).astype(np.float32)
    np.testing.assert_array_equal(second, first)


def test_rotations_keep_their_bits():
    """If this fails, data sets that exist are read as other motions. Written out by hand: a turn by 2 atan(1/2) about z
    is the quaternion (0, 0, 1, 2) up to its length: w is the largest (3), the ratios are 0, 0 and 1/2."""
    cos, sin = (4 - 1) / 5, 4 / 5
    code = encoding.packed_rotations(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]))
    half = 2**19
    assert int(code) == 3 | half << 2 | half << 22 | (half + 262144) << 42  # round(524287 / 2) to even
    assert int(encoding.packed_rotations(np.eye(3))) == 3 | half << 2 | half << 22 | half << 42
    np.testing.assert_array_equal(encoding.unpacked_rotations(encoding.packed_rotations(np.eye(3))), np.eye(3))


@pytest.mark.parametrize("far", [0.0, 100.0, 5000.0])
def test_translations_are_close_and_stay_the_same(far):
    """If this fails, the body jitters, most of all far from the origin. Half of 2^-17 m against the float32 input."""
    moves = (np.random.default_rng(2).uniform(-1.5, 1.5, (6, 31, 3)) + far).astype(np.float32)
    read = encoding.unpacked_translations(*encoding.packed_translations(moves))
    assert np.abs(read - moves).max() <= 2.0**-18
    again = encoding.unpacked_translations(*encoding.packed_translations(read.astype(np.float32)))
    np.testing.assert_array_equal(again.astype(np.float32), read.astype(np.float32))
    codes, origins = encoding.packed_translations(moves)
    assert int(codes[0, 3]) & (2**21 - 1) == round((float(moves[0, 3, 0]) - float(origins[0, 0])) * 2**17)


def test_bones_too_far_apart_are_refused():
    """If this fails, a body in centimetres is cut off without a word."""
    moves = np.zeros((2, 3, 3))
    moves[1, 2, 1] = 180.0
    with pytest.raises(MeshError, match=r"180 m apart \(frame 1\), more than 16 m"):
        encoding.packed_translations(moves)


def test_weights_sum_to_one():
    """If this fails, the body swells or shrinks. 1/65,535 per weight; sums to 1e-6 (float32)."""
    rng = np.random.default_rng(3)
    weights = rng.dirichlet([0.3] * 4, 500)
    weights[:5] = [[1, 0, 0, 0], [0, 0, 0, 1], [0.25] * 4, [0.5, 0.5, 0, 0], [1 / 3, 1 / 3, 1 / 3, 0]]
    codes = encoding.packed_weights(weights)
    assert codes.shape == (500, 3)
    read = encoding.unpacked_weights(codes)
    assert np.abs(read - weights).max() < 1.6e-5
    np.testing.assert_allclose(read.sum(1), 1.0, atol=1e-6)
    assert (read >= 0).all()
    np.testing.assert_array_equal(encoding.packed_weights(read), codes)
    np.testing.assert_array_equal(encoding.unpacked_weights(encoding.packed_weights(np.ones((7, 1)))), np.ones((7, 1)))
    for bad in ([[-0.1, 1.1]], [[np.nan, 1.0]], [[0.0, 0.0]]):
        with pytest.raises(MeshError, match=r"1 of 1 vertices .* \(first: vertex 0\)"):
            encoding.packed_weights(np.array(bad))


def test_indices_take_the_smallest_type():
    """If this fails, faces take twice the room, or indices wrap around."""
    for highest, name in ((255, "uint8"), (256, "uint16"), (65535, "uint16"), (65536, "int32")):
        packed = encoding.packed_indices(np.array([0, highest]))
        assert packed.dtype.name == name
        assert int(packed[1]) == highest
    assert encoding.packed_indices(np.array([-1, 3])).tolist() == [-1, 3]  # refused later, by name


@pytest.mark.parametrize("damage", [lambda t: t * 1.01, lambda t: t * [[-1, 1, 1, 1]], lambda t: t + np.nan])
def test_transforms_that_are_not_rigid_are_refused(damage):
    """If this fails, a scaled, mirrored or missing bone is stored as another one."""
    transforms = np.tile(np.eye(3, 4), (5, 7, 1, 1))
    transforms[3, 2] = damage(transforms[3, 2])
    with pytest.raises(MeshError, match=r"1 of 35 bone_transforms .* \(first: frame 3, bone 2\)"):
        encoding.packed_transforms(transforms)


def test_a_stored_body_is_close_and_stays_the_same():
    """If this fails, the body that is read back is not the one cloth was simulated on, or 0.05 mm from what was asked
    for. Skinning by a dense float64 sum; head and hands are up to 1.8 m from the origin that bones turn about."""
    body = rest_body()
    rng = np.random.default_rng(4)
    transforms = np.zeros((6, len(body.bone_names), 3, 4))
    transforms[..., :3] = Rotation.from_rotvec(0.6 * rng.standard_normal((6 * 31, 3))).as_matrix().reshape(6, 31, 3, 3)
    transforms[..., 3] = rng.uniform(-1, 1, (6, 31, 3)) + [4.0, 0.0, -7.0]

    def skinned(rest, bones, weights, moves):
        dense = np.zeros((len(rest), moves.shape[1]))
        np.add.at(dense, (np.arange(len(rest))[:, None], bones), np.asarray(weights, np.float64))
        homogeneous = np.concatenate([rest, np.ones((len(rest), 1))], axis=1)
        return np.einsum("vb,tbij,vj->tvi", dense, moves, homogeneous, optimize=True)

    stored = encoding.stored_body(body.vertices, body.bone_indices, body.bone_weights)
    moves = encoding.stored_transforms(transforms)
    weights = body.bone_weights / body.bone_weights.sum(1, keepdims=True)
    expected = skinned(body.vertices, body.bone_indices, weights, transforms)
    assert np.linalg.norm(skinned(*stored, moves) - expected, axis=-1).max() < 5e-5
    again = (*encoding.stored_body(*stored), encoding.stored_transforms(moves))
    for once, twice in zip((*stored, moves), again, strict=True):
        np.testing.assert_array_equal(once, twice)
    np.testing.assert_array_equal(encoding.stored_transforms(transforms[2:4]), moves[2:4])
