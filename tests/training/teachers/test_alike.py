"""What must hold for every teacher that runs in this process: bodies, pins, repeatability."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.cloth import BALL, on_ball, outside, sheet, still, stretch

from warpgarment.objects.garment import Garment
from warpgarment.training.teachers import ClothScene, TeacherError
from warpgarment.training.teachers.newton.settings import NewtonSettings
from warpgarment.training.teachers.newton.teacher import NewtonTeacher
from warpgarment.training.teachers.warp.settings import WarpSettings
from warpgarment.training.teachers.warp.teacher import WarpTeacher

TEACHERS = [
    (NewtonTeacher(NewtonSettings(substeps=5, iterations=4)), 0.05),
    (WarpTeacher(WarpSettings(substeps=5, iterations=10)), 0.01),
]


@pytest.fixture(params=TEACHERS, ids=lambda found: found[0].name)
def teacher(request):
    """A teacher, and the mean stretch that its quick settings stay below."""
    return request.param


def simulated(teacher, scene: ClothScene) -> np.ndarray:
    """All frames, [T, V, 3]."""
    return np.stack(list(teacher[0].simulate(scene)))


def test_cloth_drapes_over_a_moving_ball_and_stays_outside(teacher):
    """If this fails, the teacher lets cloth through, stretches it, or leaves a moving body behind."""
    path = still(12)
    path[:, 0] = np.cumsum(np.linspace(0, 0.02, 12))
    scene = on_ball(path, settle=2)
    frames = simulated(teacher, scene)
    assert frames.shape == (12, 121, 3)
    assert frames.dtype == np.float32
    assert outside(frames[-1], scene.body_frames[-1]) > 0.0
    garment = scene.cloths[0].garment
    corner = np.linalg.norm(garment.vertices[:, [0, 2]], axis=1).argmax()
    assert frames[-1, corner, 1] < frames[0, corner, 1] - 0.05, "the corners do not fall"
    assert (frames[-1] - frames[0]).mean(0)[0] == pytest.approx(path[-1, 0], abs=0.06)
    assert np.abs(stretch(garment, frames[-1])).mean() < teacher[1]


def test_the_same_scene_gives_the_same_frames(teacher):
    """If this fails, a sequence is no function of its seed."""
    scene = on_ball(still(2), sheet(0.4, 0.17), sheet(0.4, 0.195))
    np.testing.assert_array_equal(simulated(teacher, scene), simulated(teacher, scene))


def test_pins_keep_their_place_on_a_turning_body(teacher):
    """A waistband would slide around its body."""
    turns = Rotation.from_rotvec(np.linspace(0, 0.6, 5)[:, None] * [0.3, 1.0, 0.2]).as_matrix()
    shift = np.linspace(0, 0.05, 5)[:, None] * [1.0, 0.5, 0.0]
    body = np.einsum("tij,vj->tvi", turns, BALL.vertices) + shift[:, None]
    cloth = sheet(0.3, 0.165, 6)
    pins = np.array([24, 3, 45])
    held = replace(cloth, garment=Garment(cloth.garment.vertices, cloth.garment.faces, pins=pins))
    frames = simulated(teacher, ClothScene((held,), body.astype(np.float32), BALL.faces, settle=1))
    expected = np.einsum("tij,vj->tvi", turns, cloth.garment.vertices[np.sort(pins)]) + shift[:, None]
    # float32 positions of half a metre, heights above a face of up to 10 cm
    np.testing.assert_allclose(frames[:, np.sort(pins)], expected, atol=2e-6)


def test_a_scene_goes_on_from_positions_and_velocities(teacher):
    """A restart begins with the start itself; over the next frames it leaves the whole simulation by less than a tenth
    of what a restart without velocities does. The body speeds up, so that velocities matter. It cannot be closer: the
    Warp teacher's solver begins without what it has learned in earlier steps, and friction multiplies the difference
    of its few iterations."""
    path = still(10)
    path[:, 0] = 0.004 * np.arange(10) ** 2
    scene = on_ball(path, settle=2)
    whole = [worlds[0] for worlds in teacher[0].simulate_moving([scene])]
    rest = scene.body_frames[4:]

    def again(velocity: np.ndarray | None) -> np.ndarray:
        cloth = replace(scene.cloths[0], start=whole[4].vertices, velocity=velocity)
        return simulated(teacher, replace(scene, cloths=(cloth,), body_frames=rest, settle=0))

    found, slow = again(whole[4].velocities), again(np.zeros_like(whole[4].velocities))
    expected = np.stack([frame.vertices for frame in whole[4:]])
    np.testing.assert_array_equal(found[0], whole[4].vertices)
    off, without = (np.linalg.norm(frames - expected, axis=-1).mean(axis=1)[1:] for frames in (found, slow))
    assert without.min() > 2e-3
    assert (off[:3] < 0.1 * without[:3]).all()


def test_a_scene_that_cannot_go_on_is_refused(teacher):
    """Velocities of some cloths would be ignored, or settled away, without a word."""
    scene = on_ball(still(2), sheet(0.4, 0.17), sheet(0.4, 0.195), settle=0)
    cloth = scene.cloths[0]
    going = replace(cloth, velocity=np.zeros_like(cloth.first))
    wrong = {
        "velocities of all its cloths": replace(scene, cloths=(going, scene.cloths[1])),
        "settle 0": replace(scene, cloths=(going, replace(going, start=scene.cloths[1].first)), settle=1),
        r"shape \[3, 3\]": replace(scene, cloths=(replace(cloth, velocity=np.zeros((3, 3))),)),
        "121 velocities are not finite": replace(scene, cloths=(replace(going, velocity=going.velocity * np.nan),)),
    }
    for says, faulty in wrong.items():
        with pytest.raises(TeacherError, match=says):
            list(teacher[0].simulate(faulty))
