"""Where cloth is deep in a body, and whether the body leaves it room: capsules whose distances are known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from support.meshes import Mesh, joined

import warpgarment as wg
from warpgarment.geometry.depth import deep_place
from warpgarment.view.deep import depth_lines

RADIUS = 0.05


def _capsules(gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Two upright limbs of a radius of 5 cm side by side, `gap` apart [m]; negative: in each other."""
    both = joined(_limb(0.0), _limb(2 * RADIUS + gap))
    return both.vertices, both.faces


def _limb(x: float, around: int = 32, rings: int = 21) -> Mesh:
    """A closed cylinder of 40 cm, with vertices all over it."""
    angle = np.arange(around) * 2 * np.pi / around
    ring = np.stack([x + RADIUS * np.cos(angle), np.zeros(around), RADIUS * np.sin(angle)], axis=1)
    rows = [ring + [0, y, 0] for y in np.linspace(0.0, 0.4, rings)]
    vertices = np.concatenate([*rows, [[x, 0.0, 0.0], [x, 0.4, 0.0]]])
    faces, last = [], around * rings
    for r in range(rings - 1):
        for i in range(around):
            a, b = r * around + i, r * around + (i + 1) % around
            faces += [(a, a + around, b), (b, a + around, b + around)]
    for i in range(around):
        j, top = (i + 1) % around, around * (rings - 1)
        faces += [(last, i, j), (last + 1, top + j, top + i)]
    return Mesh(vertices.astype(np.float32), np.array(faces, np.int32))


def _strip(x: float) -> tuple[np.ndarray, np.ndarray]:
    """A small triangle in the plane at x [m], between the limbs."""
    points = np.array([[x, 0.2, 0], [x, 0.202, 0], [x, 0.2, 0.002]])
    return points, np.array([[0, 1, 2]])


@pytest.mark.parametrize(
    ("gap", "x", "parts", "free"),
    [(-0.03, RADIUS - 0.015, 2, False), (0.004, RADIUS - 0.003, 1, False), (0.1, RADIUS - 0.006, 1, True)],
    ids=["in each other", "close", "far"],
)
def test_room_is_that_of_the_limbs(gap, x, parts, free) -> None:
    """Cloth between two limbs that are in each other would be taken for a fault of the simulation, or a fault for want
    of room. Depth is that of the polygon of a circle (1 mm). What is hidden of a circle of 50 mm in another one 70 mm
    away is up to 39 mm from what is free, by Pythagoras (6 mm, the size of faces); room is the gap (2 mm)."""
    body, faces = _capsules(gap)
    found = deep_place(*_strip(x), body, faces)
    assert found.parts == parts
    np.testing.assert_allclose(found.depth, RADIUS - x, atol=1e-3)
    np.testing.assert_allclose(found.place[0], x, atol=1e-9)
    if gap < 0:
        np.testing.assert_allclose(found.through, np.hypot(0.015, np.sqrt(0.05**2 - 0.035**2)), atol=6e-3)
    else:
        assert found.through == 0.0
        np.testing.assert_allclose(found.room, gap, atol=2e-3)
    assert found.free(0.004) is free
    outside = deep_place(*_strip(-0.2), body, faces)
    assert (outside.depth, outside.parts) == (0.0, 0)


def _motion(depths: list[float], x: list[float]) -> wg.GarmentMotion:
    frames = np.stack([_strip(one)[0] for one in x]).astype(np.float32)
    status = [wg.RolloutStatus.judged(k, True, depth) for k, depth in enumerate(depths)]
    return wg.GarmentMotion(frames, _strip(0)[1], 30.0, status=status)


def test_a_rollout_says_where_the_body_leaves_no_room() -> None:
    """Somebody would look for a setting that helps cloth inside two limbs, or not learn which frames are meant."""
    body, faces = _capsules(-0.03)
    far, _ = _capsules(0.1)
    moving = wg.BodyMotion(np.stack([body, far, body]).astype(np.float32), faces, 30.0)
    lines = depth_lines(_motion([0.015, 0.006, 0.001], [RADIUS - 0.015, RADIUS - 0.006, RADIUS - 0.001]), moving, 0.004)
    assert len(lines) == 2
    assert "2 of 3 frames are deeper than 2 mm; all of them were looked at" in lines[0]
    assert "in frame 0, at (0.04, 0.20, 0.00) m, inside 2 parts of the body" in lines[0]
    assert "in 1 of these 2 frames (0) the body goes through itself" in lines[1]
    assert depth_lines(_motion([0.001, 0.001, 0.001], [0.04] * 3), moving, 0.004) == []
    only = depth_lines(_motion([0.0, 0.006, 0.0], [RADIUS - 0.006] * 3), moving, 0.004)
    assert len(only) == 1
    assert only[0].endswith("the body leaves room there.")
