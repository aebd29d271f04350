"""Velocities that teachers give with their frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cloth import flag, on_ball, sheet, still

from warpgarment.objects.garment import Garment
from warpgarment.training.generate.run import simulate
from warpgarment.training.teachers import ClothScene, TeacherError
from warpgarment.training.teachers.newton.settings import NewtonSettings
from warpgarment.training.teachers.newton.teacher import NewtonTeacher

FALL = NewtonSettings(substeps=5, iterations=4, drag=0.0, lift=0.0)


def moving(scene: ClothScene, settings: NewtonSettings) -> tuple[np.ndarray, np.ndarray]:
    frames = [worlds[0] for worlds in NewtonTeacher(settings).simulate_moving([scene])]
    return np.stack([f.vertices for f in frames]), np.stack([f.velocities for f in frames])


def test_a_velocity_is_the_last_substeps_in_the_axes_of_the_world():
    """Velocities lack that of the moving coordinates, are of another substep, or pins have none. With one substep a
    frame it is the difference of two frames; the body goes up to 1 m/s with a pinned cloth. 5e-4 m/s: float32."""
    path = still(8)
    path[:, 0] = np.cumsum(1.0 / 30 * np.clip(np.arange(8) / 4, 0, 1))
    cloth = sheet(0.3, 0.165, 6)
    held = replace(cloth, garment=Garment(cloth.garment.vertices, cloth.garment.faces, pins=np.array([24, 3])))
    vertices, velocities = moving(on_ball(path, held, settle=1), NewtonSettings(substeps=1, iterations=3))
    expected = np.diff(vertices.astype(np.float64), axis=0) * 30.0
    assert np.abs(expected).max() > 0.5
    assert velocities.dtype == np.float32
    np.testing.assert_allclose(velocities[1:], expected, atol=5e-4)


def test_free_fall_has_its_speed():
    """The velocity is the mean of a frame instead of that at its end: after n frames, settling ones included, a fall
    without air has speed g n / fps. 1e-3 m/s: float32."""
    scene = flag(3)
    free = replace(scene.cloths[0], garment=Garment(scene.cloths[0].garment.vertices, scene.cloths[0].garment.faces))
    vertices, velocities = moving(replace(scene, cloths=(free,)), FALL)
    fallen = scene.settle + np.arange(1, 4)
    expected = np.zeros(vertices.shape)
    expected[..., 1] = -9.81 * fallen[:, None] / scene.fps
    np.testing.assert_allclose(velocities, expected, atol=1e-3)


def test_positions_are_those_without_velocities():
    """A set would depend on whether velocities are recorded. Equal bits."""
    scene = on_ball(still(2), settle=1)
    vertices, _ = moving(scene, FALL)
    np.testing.assert_array_equal(vertices, np.stack(list(NewtonTeacher(FALL).simulate(scene))))


def test_a_teacher_without_velocities_is_refused():
    """Sequences would be made for hours and hold none."""
    from warpgarment.training.generate.run import Attempt

    class Still:
        name = "still"

    attempt = Attempt(plan=None)
    attempt.scene = flag(2)
    with pytest.raises(TeacherError, match="still gives no velocities"):
        simulate([attempt], Still(), velocities=True)
