"""The Warp teacher on small scenes: known answers, bodies, pins, layers, wind, convergence, and batches."""

from __future__ import annotations

import json
from dataclasses import replace

import igl
import numpy as np
import pytest
from support.cloth import flag, on_ball, outside, sheet, still

from warpgarment.errors import UsageError
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.training.teachers import ClothScene, TeacherError, make_teacher
from warpgarment.training.teachers.checks import hanging_strip, run_checks
from warpgarment.training.teachers.warp.settings import WarpSettings
from warpgarment.training.teachers.warp.teacher import WarpTeacher

FAST = WarpSettings(substeps=5, iterations=10)
CONVERGED = WarpSettings(iterations=150, tolerance=1e-7)


def simulated(scene: ClothScene, settings: WarpSettings = FAST) -> np.ndarray:
    """All frames, [T, V, 3]."""
    return np.stack(list(WarpTeacher(settings).simulate(scene)))


def test_known_answers():
    """A strip would hang too long, a sheet would swing too slowly, or cloth would sink into a sphere or never rest."""
    for result in run_checks(WarpTeacher()):
        assert result.passed, str(result)


def test_the_material_counts():
    """A stiff strip would hang as long as a soft one, as it does where iterations stop before they converge."""
    soft, stiff = (Material(density=1.0, stretch=k, shear=k, bend=1e-4) for k in (100.0, 2000.0))
    for material in (soft, stiff):
        result = hanging_strip(WarpTeacher(), material)
        assert result.error < 0.1, str(result)


def test_friction_carries_cloth_along():
    """Friction would not act, or would act on a ball that does not move under the cloth."""
    path = still(20)
    path[:, 0] = np.cumsum(np.linspace(0, 0.012, 20))
    gone = []
    for friction in (0.0, 0.8):
        frames = simulated(on_ball(path, sheet(0.2, 0.165, 6, friction=friction), settle=4))
        gone.append(path[-1, 0] - frames[-1, :, 0].mean())
    assert gone[1] < 0.6 * gone[0]


def test_few_iterations_come_near_to_many():
    """The default would be another cloth than the converged one, as with solvers that stop early."""
    scene = flag(12, gravity=(0.0, 0.0, -9.81))
    best, default, few = (simulated(scene, s) for s in (CONVERGED, WarpSettings(), WarpSettings(iterations=3)))
    near, far = (np.linalg.norm(f - best, axis=2).mean() for f in (default, few))
    assert near < 3e-4  # of a tip that falls by 20 cm; 0.1 mm of noise on the start makes 0.2 mm
    assert far > 4 * near, "iterations make no difference: the test shows nothing"


def test_pins_without_a_body_stay_and_gravity_is_the_scenes():
    """A flag would fall off its pole, or fall the wrong way."""
    pulls = ((0.0, -9.81, 0.0), (0.0, 0.0, 5.0), (0.0, 0.0, 0.0))
    down, aside, none = (simulated(flag(4, gravity=gravity)) for gravity in pulls)
    scene = flag(4)
    rest, pins = scene.cloths[0].garment.vertices, scene.cloths[0].garment.pins
    for frames in (down, aside, none):
        np.testing.assert_array_equal(frames[:, pins], np.broadcast_to(rest[pins], (4, len(pins), 3)))
    assert down[-1, :, 1].mean() < rest[:, 1].mean() - 5e-5  # it hangs in its own plane, which is stiff
    assert aside[-1, :, 2].mean() > 0.02
    np.testing.assert_allclose(none[-1], rest, atol=1e-5)  # rounding only: nothing acts on it


def test_free_fall_is_free():
    """Cloth that touches nothing would be slowed by the solver: a metre of fall in a vacuum, by the formula."""
    scene = replace(flag(14), cloths=(replace(sheet(0.2, 5.0, 4)),))
    frames = simulated(scene, replace(FAST, drag=0.0, lift=0.0))
    step = 1.0 / 30 / FAST.substeps
    count = 14 * FAST.substeps
    fallen = 9.81 * step**2 * count * (count + 1) / 2  # implicit Euler's own sum of g t
    assert 5.0 - frames[-1, :, 1] == pytest.approx(fallen, abs=1e-4)


def test_layers_do_not_pass_through_each_other():
    """An outer garment would sink into the one below, or float above it."""
    import ipctk

    inner, outer = sheet(0.44, 0.166, 9), sheet(0.4, 0.19, 8, density=0.8, stretch=500.0)
    scene = on_ball(still(8), inner, outer, settle=4)
    frames = simulated(scene, replace(FAST, substeps=10))
    split = int(scene.starts[1])
    faces = np.concatenate([inner.garment.faces, outer.garment.faces + split])

    def cross(points: np.ndarray) -> bool:
        edges = ipctk.edges(faces)
        mesh = ipctk.CollisionMesh(points.astype(np.float64), edges, faces)
        return bool(ipctk.has_intersections(mesh, points.astype(np.float64)))

    assert not cross(frames[-1])
    below, above = frames[-1, :split], frames[-1, split:]
    near = igl.point_mesh_squared_distance(above.astype(float), below.astype(float), inner.garment.faces)[0]
    assert np.sqrt(near.min()) < 0.008, "they do not touch: the test shows nothing"
    assert outside(frames[-1], scene.body_frames[-1]) > 0
    # the check has teeth: pressed down by 2 cm, the outer one crosses
    assert cross(np.concatenate([below, above - [0, 0.02, 0]]))


def test_layers_rub_against_each_other():
    """An outer layer would slide on an inner one as on ice: a sheet on another that is held, on a slope of 17 degrees.

    Without friction it slides as on a slope, by the formula; with a coefficient above the slope's 0.3 it hardly moves.
    """
    gone = []
    for friction in (0.0, 0.9):
        inner = sheet(0.3, 0.0, 6, friction=friction)
        held = Garment(inner.garment.vertices, inner.garment.faces, pins=np.arange(len(inner.garment.vertices)))
        small = sheet(0.2, 0.0038, 4, friction=friction)
        scene = ClothScene((replace(inner, garment=held), small), frames=6, settle=0, gravity=(2.9, -9.4, 0.0))
        frames = simulated(scene, replace(FAST, drag=0.0, lift=0.0, substeps=10))
        gone.append((frames[-1] - frames[0])[len(inner.garment.vertices) :, 0].mean())
    slid = 0.5 * 2.9 * ((6 / 30) ** 2 - (1 / 30) ** 2)  # between the first frame and the last one
    assert gone[0] == pytest.approx(slid, rel=0.05)
    assert gone[1] < 0.2 * gone[0]


def test_wind_blows_a_flag_downwind_and_changes_from_frame_to_frame():
    """Wind would act in another direction, at another time, or not at all."""
    settings = dict(gravity=(0.0, 0.0, 0.0))
    with_it, against = (simulated(flag(5, (0.0, 0.0, z), **settings)) for z in (5.0, -5.0))
    assert with_it[-1, :, 2].mean() > 0.03
    np.testing.assert_allclose(with_it[:, :, 2], -against[:, :, 2], atol=2e-3)  # triangles have a direction
    late = np.zeros((5, 3))
    late[3:, 2] = 5.0
    frames = simulated(flag(5, late, **settings))
    assert np.abs(frames[2, :, 2]).max() < 1e-5  # the wind of frame 3 blows from frame 2 on
    assert frames[4, :, 2].mean() > 1e-3


def test_many_scenes_give_what_each_gives_alone():
    """A sequence would depend on which others were simulated beside it."""
    moving = still(4)
    moving[:, 0] = 0.02 * np.arange(4) ** 2
    wind = np.tile([4.0, 0.0, 1.0], (2, 1))
    scenes = [
        flag(5, (0.0, 0.0, 6.0), settle=1),
        on_ball(moving),
        on_ball(still(2), sheet(0.4, 0.17, 8, density=0.5), wind=wind),
        on_ball(still(4), sheet(0.4, 0.166, 8), sheet(0.36, 0.19, 8, stretch=400.0)),
        replace(on_ball(still(3)), fps=60.0),
    ]
    teacher = WarpTeacher(FAST)
    together = list(teacher.simulate_many(scenes))
    assert len(together) == 5
    for number, scene in enumerate(scenes):
        mine, alone = [frame[number] for frame in together], list(teacher.simulate(scene))
        assert all(vertices is None for vertices in mine[len(scene) :])
        np.testing.assert_array_equal(np.stack(mine[: len(scene)]), np.stack(alone))


def test_velocities_are_those_of_the_last_step():
    """A restart would go on with another motion: with one step a frame, the difference of two frames."""
    scene = flag(5, gravity=(0.0, 0.0, -9.81))
    frames = [one[0] for one in WarpTeacher(replace(FAST, substeps=1)).simulate_moving([scene])]
    positions, velocities = (np.stack([getattr(f, name) for f in frames]) for name in ("vertices", "velocities"))
    expected = np.diff(positions.astype(np.float64), axis=0) * 30.0
    assert np.abs(expected).max() > 0.4
    np.testing.assert_allclose(velocities[1:], expected, atol=1e-5)  # float32 positions of 0.3 m
    assert (velocities[:, scene.cloths[0].garment.pins] == 0).all()


def test_bdf2_keeps_more_of_a_swing():
    """The second scheme would be the first one: a sheet that swings loses less of its height."""
    scene = flag(30, gravity=(0.0, 0.0, -9.81))
    tops = []
    for scheme in ("euler", "bdf2"):
        frames = simulated(scene, replace(FAST, scheme=scheme, drag=0.0, lift=0.0, bend_damping=0.0))
        tip = frames[:, frames[0, :, 0].argmax()]
        tops.append(np.linalg.norm(np.diff(tip, axis=0), axis=1)[-15:].max())
    assert tops[1] > 1.02 * tops[0]


def test_faults_are_named():
    """A wrong device or scene would end in a traceback of another library."""
    with pytest.raises(UsageError, match="no device"):
        make_teacher("warp", device="cuda:7")
    with pytest.raises(TeacherError, match="no cloth"):
        list(WarpTeacher().simulate(ClothScene((), frames=2)))


def test_settings_are_plain():
    """A manifest could not be written, or would not say what the frames depend on."""
    settings = WarpTeacher(FAST).settings()
    assert json.loads(json.dumps(settings)) == settings
    assert settings["teacher"] == "warp"
    assert settings["substeps"] == 5
