"""Limbs that are found in a mesh, limbs that follow a line, and bodies that become thin."""

from __future__ import annotations

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warpgarment as wg
from warpgarment.dressing.bend import Bend
from warpgarment.dressing.grow import thin_bodies
from warpgarment.dressing.limbs import edges_of, girth, limbs_of


@pytest.fixture(scope="module")
def body() -> tuple[np.ndarray, np.ndarray]:
    """The bundled body in its first frame, hands and all."""
    whole = wg.demo.assets().body
    return whole.vertices[0].astype(float), whole.faces


@pytest.mark.parametrize("turn", [0.0, 70.0, 190.0])
def test_limbs_are_where_a_person_sees_them(body, turn: float) -> None:
    """Arms would be looked for in the legs, or the front at the back, of a body that is turned. 5 cm, 5 degrees.

    Places were read off a picture of the body: it faces +Z, its shoulders are 1.41 m high and 0.35 m apart.
    """
    rotation = Rotation.from_euler("y", turn, degrees=True)
    found = limbs_of(rotation.apply(body[0]) + [3.0, 0.5, -2.0], body[1])
    assert found.height == pytest.approx(1.78, abs=0.01)
    np.testing.assert_allclose(found.forward, rotation.apply([0, 0, 1]), atol=np.radians(5))
    left, right = (rotation.inv().apply(arm.joint - [3.0, 0.5, -2.0]) for arm in found.arms)
    np.testing.assert_allclose(left, [0.175, 1.41, 0.0], atol=0.05)
    np.testing.assert_allclose(right, [-0.175, 1.41, 0.0], atol=0.05)
    assert len(found.legs) == 2
    assert rotation.inv().apply(found.head.joint - [3.0, 0.5, -2.0])[1] == pytest.approx(1.54, abs=0.05)


def test_a_tape_around_a_cylinder() -> None:
    """A unit would be guessed wrong by the girth of a limb. The perimeter of the polygon, by hand, to 1e-9."""
    angle = 2 * np.pi * np.arange(64) / 64
    rings = [np.stack([0.1 * np.cos(angle), np.full(64, y), 0.1 * np.sin(angle)], 1) for y in (0.0, 1.0)]
    k = np.arange(64)
    j = (k + 1) % 64
    faces = np.concatenate([np.stack([k, j, k + 64], 1), np.stack([j, j + 64, k + 64], 1)])
    found = girth(np.concatenate(rings), edges_of(faces), np.array([0.0, 0.5, 0.0]), np.array([0.0, 1.0, 0.0]), 0.3)
    assert found == pytest.approx(64 * 2 * 0.1 * np.sin(np.pi / 64), rel=2e-3)


def test_an_arm_follows_a_sleeve(body) -> None:
    """Arms would not lie in the sleeves of a garment in a T-pose. Distance of the arm from the line, beside its own
    radius at rest: 1 cm more; the rest of the body does not move, and no share of the turn changes nothing."""
    points, faces = body
    limbs = limbs_of(points, faces)
    arm = limbs.arms[0]
    bend = Bend(arm, np.stack([arm.joint, arm.joint + [0.3, 0.0, 0.0]]), limbs.height)
    np.testing.assert_array_equal(bend.at(0.0, points), points)
    moved = bend.at(1.0, points)
    far = arm.reach > arm.end + 0.1
    np.testing.assert_array_equal(moved[far], points[far])
    outer = (arm.reach < 0.6 * arm.end) & (arm.reach > 0.25 * arm.end)
    off = np.linalg.norm((moved - arm.joint)[outer][:, 1:], axis=1)
    assert off.max() < arm.radius.max() + 0.01
    assert moved[arm.tip, 0] - arm.joint[0] == pytest.approx(arm.end, abs=0.1)
    lengths = [np.linalg.norm(p[faces[:, 0]] - p[faces[:, 1]], axis=1) for p in (points, moved)]
    assert np.percentile(lengths[1] / lengths[0], 99) < 1.3


def test_a_thin_body_lies_inside(body) -> None:
    """The body would come through the garment while it is thin, or not become thin. libigl's signed distance: 95 % of
    the thinnest is inside the body, and it has a third of the volume."""
    points, faces = body
    thin = thin_bodies(points, faces, 1.78)
    np.testing.assert_array_equal(thin[0], points)

    def volume(at: np.ndarray) -> float:
        a, b, c = (at[faces[:, k]] for k in range(3))
        return float((a * np.cross(b, c)).sum() / 6)

    volumes = [volume(at) for at in thin]
    assert (np.diff(volumes) < 0).all()
    assert volumes[-1] < 0.5 * volumes[0]
    kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    inside = igl.signed_distance(thin[-1], points, faces.astype(np.int64), sign_type=kind)[0] < 0
    assert inside.mean() > 0.95
    assert np.linalg.norm(np.diff(thin, axis=0), axis=2).max() < 0.012  # so that cloth can follow
