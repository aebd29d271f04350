"""The Newton teacher on small scenes: bodies, pins, layers, wind, and many worlds at once."""

from __future__ import annotations

import json
from dataclasses import replace

import igl
import numpy as np
import pytest
import warp as wp
from support.cloth import BALL, flag, on_ball, outside, sheet, still, stretch

from warpgarment.objects.garment import Garment
from warpgarment.training.teachers import ClothScene, TeacherError, make_teacher
from warpgarment.training.teachers.newton.settings import NewtonSettings
from warpgarment.training.teachers.newton.teacher import NewtonTeacher
from warpgarment.training.teachers.newton.worlds import Worlds
from warpgarment.training.teachers.scenes import MovingFrame

FAST = NewtonSettings(substeps=5, iterations=4)
place = Worlds.place


def simulated(scene: ClothScene, settings: NewtonSettings = FAST) -> np.ndarray:
    """All frames, [T, V, 3]."""
    return np.stack(list(NewtonTeacher(settings).simulate(scene)))


def test_a_fast_body_does_not_leave_its_garment_behind():
    """Self-contact caps the speed of a vertex at 2 m/s here; a garment on a body at 4 m/s would be torn off it."""
    path = still(14)
    path[:, 0] = np.cumsum(4.0 / 30 * np.clip(np.arange(14) / 8, 0, 1))
    cloth = sheet(0.3, 0.165, 6)
    top = np.flatnonzero(np.abs(cloth.garment.vertices[:, [0, 2]]).max(1) < 0.06)
    held = Garment(cloth.garment.vertices, cloth.garment.faces, pins=top)
    frames = simulated(on_ball(path, replace(cloth, garment=held), settle=2))
    assert np.abs(stretch(held, frames[-1])).max() < 0.1
    assert np.abs(frames[-1, :, 0] - path[-1, 0]).max() < 0.25


def test_pins_without_a_body_stay_and_gravity_is_the_scenes():
    """A flag would fall off its pole, or fall the wrong way."""
    down, aside, none = (simulated(flag(4, gravity=g)) for g in ((0.0, -9.81, 0.0), (0.0, 0.0, 5.0), (0.0, 0.0, 0.0)))
    scene = flag(4)
    rest, pins = scene.cloths[0].garment.vertices, scene.cloths[0].garment.pins
    for frames in (down, aside, none):
        np.testing.assert_array_equal(frames[:, pins], np.broadcast_to(rest[pins], (4, len(pins), 3)))
    assert down[-1, :, 1].mean() < rest[:, 1].mean() - 0.02
    assert aside[-1, :, 2].mean() > 0.02
    np.testing.assert_allclose(none[-1], rest, atol=1e-5)  # rounding only: nothing acts on it


def test_the_rest_mesh_is_not_where_cloth_starts():
    """A garment placed on a posed body would take that pose for its rest shape."""
    scene = flag(16, gravity=(0.0, 0.0, 0.0))
    cloth = scene.cloths[0]
    pulled = replace(cloth, start=(cloth.garment.vertices * [1.06, 1.0, 1.0]).astype(np.float32))
    frames = simulated(replace(scene, cloths=(pulled,)), NewtonSettings(substeps=5, iterations=10))
    assert frames.shape[0] == 16
    assert stretch(cloth.garment, pulled.start).max() > 0.05
    assert np.abs(stretch(cloth.garment, frames[-1])).mean() < 0.005


def crossings(edges: np.ndarray, triangles: np.ndarray) -> int:
    """How many of segments [E, 2, 3] go through triangles [F, 3, 3]: signs of volumes of tetrahedra."""

    def volume(p, q, r, s):
        return np.einsum("...i,...i", np.cross(q - p, r - p), s - p)

    p, q = (edges[:, None, i].astype(np.float64) for i in range(2))
    a, b, c = (triangles[None, :, i].astype(np.float64) for i in range(3))
    through = volume(a, b, c, p) * volume(a, b, c, q) < 0
    one, two, three = volume(p, q, a, b), volume(p, q, b, c), volume(p, q, c, a)
    inside = ((one > 0) & (two > 0) & (three > 0)) | ((one < 0) & (two < 0) & (three < 0))
    return int((through & inside).sum())


def test_layers_do_not_pass_through_each_other():
    """An outer garment would sink into the one below."""
    inner, outer = sheet(0.44, 0.166, 9), sheet(0.4, 0.19, 8, density=0.8, stretch=500.0)
    scene = on_ball(still(8), inner, outer, settle=4)
    frames = simulated(scene, NewtonSettings(substeps=10, iterations=4))
    split = int(scene.starts[1])
    below, above = frames[-1, :split], frames[-1, split:]
    for one, other, a, b in ((below, above, inner, outer), (above, below, outer, inner)):
        assert crossings(one[a.garment.edges], other[b.garment.faces]) == 0
    distance = np.sqrt(
        igl.point_mesh_squared_distance(above.astype(float), below.astype(float), inner.garment.faces)[0]
    )
    assert distance.min() > 0.001
    assert distance.min() < 0.008, "they do not touch: the test shows nothing"
    assert outside(frames[-1], scene.body_frames[-1]) > 0
    # the other check has teeth: pressed down by 2 cm, the outer one crosses
    assert crossings((above - [0, 0.02, 0])[outer.garment.edges], below[inner.garment.faces]) > 0


def test_wind_blows_a_flag_downwind_and_changes_from_frame_to_frame():
    """Wind would act in another direction, at another time, or not at all."""
    settings = dict(gravity=(0.0, 0.0, 0.0))
    with_it, against = (simulated(flag(5, (0.0, 0.0, z), **settings)) for z in (5.0, -5.0))
    assert with_it[-1, :, 2].mean() > 0.03
    np.testing.assert_allclose(with_it[:, :, 2], -against[:, :, 2], atol=2e-3)  # not bit for bit: triangles differ
    late = np.zeros((5, 3))
    late[3:, 2] = 5.0
    frames = simulated(flag(5, late, **settings))
    assert np.abs(frames[2, :, 2]).max() < 1e-5  # the wind of frame 3 blows from frame 2 on
    assert frames[4, :, 2].mean() > 1e-3
    still_air = simulated(replace(flag(3, **settings), wind=None))
    np.testing.assert_array_equal(still_air, simulated(flag(3, (0.0, 0.0, 0.0), **settings)))


def test_air_drag_acts_in_still_air():
    """A falling sheet would not be slowed by the air it moves through."""
    lying = replace(flag(6, gravity=(0.0, 0.0, -9.81)), wind=None)
    vacuum, air = (simulated(lying, replace(FAST, drag=drag, lift=0.0))[-1, :, 2].mean() for drag in (0.0, 1.2))
    assert vacuum < air - 5e-4  # at 1 m/s drag takes off 3.7 m/s^2, but in 0.2 s the flag hardly gets there


def worlds() -> list[ClothScene]:
    """Scenes that differ in everything but frame rate, settling time and friction; three with the same ball."""
    moving = still(4)
    moving[:, 0] = 0.02 * np.arange(4) ** 2
    wind = np.tile([4.0, 0.0, 1.0], (2, 1))
    return [
        flag(5, (0.0, 0.0, 6.0), settle=1),
        on_ball(moving),
        on_ball(still(2), sheet(0.4, 0.17, 8, density=0.5), wind=wind),
        on_ball(still(4), sheet(0.4, 0.166, 8), sheet(0.36, 0.19, 8, stretch=400.0)),
    ]


def test_many_worlds_give_what_each_gives_alone():
    """A sequence would depend on which others were simulated beside it."""
    scenes, teacher = worlds(), NewtonTeacher(FAST)
    together = list(teacher.simulate_many(scenes))
    assert len(together) == 5
    for w, scene in enumerate(scenes):
        mine, alone = [frame[w] for frame in together], list(teacher.simulate(scene))
        assert all(vertices is None for vertices in mine[len(scene) :])
        if w < 3:  # Newton adds up contact forces between cloths in an order that depends on the world's place
            np.testing.assert_array_equal(np.stack(mine[: len(scene)]), np.stack(alone))
        else:
            np.testing.assert_allclose(np.stack(mine[: len(scene)]), np.stack(alone), atol=1e-5)


def test_scenes_that_cannot_share_a_model_run_beside_each_other():
    """Two friction coefficients or frame rates would become one."""
    one = on_ball(still(2), sheet(0.3, 0.165, 5))
    other = on_ball(still(3), sheet(0.3, 0.165, 5, friction=0.9))
    fast = replace(one, fps=60.0)
    teacher = NewtonTeacher(FAST)
    together = list(teacher.simulate_many([one, other, fast]))
    for w, scene in enumerate((one, other, fast)):
        alone = np.stack(list(teacher.simulate(scene)))
        np.testing.assert_array_equal(np.stack([f[w] for f in together[: len(scene)]]), alone)
    assert together[2][0] is None


def test_with_one_friction_between_layers_all_materials_share_a_model(monkeypatch):
    """Sampled materials would put every world into a model of its own, or slide on the body like layers do."""
    built = []
    monkeypatch.setattr(Worlds, "place", lambda self, *states: built.append(len(self.scenes)) or place(self, *states))
    slopes = [
        on_ball(still(4), sheet(0.2, 0.165, 4, friction=mu), settle=0, gravity=(6.0, -7.0, 0.0)) for mu in (0.05, 0.9)
    ]
    teacher = NewtonTeacher(replace(FAST, layer_friction=0.2, drag=0.0, lift=0.0))
    slid, held = (np.stack(frames) for frames in zip(*teacher.simulate_many(slopes), strict=True))
    assert built == [2]
    assert slid[-1, :, 0].mean() > held[-1, :, 0].mean() + 1e-3
    alone = NewtonTeacher(replace(FAST, drag=0.0, lift=0.0))
    np.testing.assert_allclose(slid, np.stack(list(alone.simulate(slopes[0]))), atol=1e-6)  # layers do not touch here


def test_launches_do_not_grow_with_the_number_of_worlds(monkeypatch):
    """A thousand worlds would spend their time in launches."""
    launched: list[str] = []
    launch, begin_frame = wp.launch, Worlds.begin_frame

    def counted(kernel, *args, **kwargs):
        launched.append(kernel.key)
        return launch(kernel, *args, **kwargs)

    def begun(*args):
        launched.clear()  # what was launched to build the model
        begin_frame(*args)

    monkeypatch.setattr(wp, "launch", counted)
    monkeypatch.setattr(Worlds, "begin_frame", begun)
    scene, found = on_ball(still(1), sheet(0.3, 0.165, 4), settle=0), []
    for number in (1, 3):
        list(NewtonTeacher(FAST).simulate_many([scene] * number))
        found.append(list(launched))
    assert found[0] == found[1]
    assert found[0].count("set_bodies_kernel") == found[0].count("air_force_kernel") == FAST.substeps
    assert found[0].count("forward_step") == 3  # one outright, one for each of the two graphs that are replayed later


def test_a_world_that_becomes_nan_harms_no_other():
    """One bad scene would spoil a batch."""
    wind = np.zeros((4, 3))
    wind[1] = np.nan
    scenes = [flag(4, wind), flag(4, (0.0, 0.0, 3.0))]
    teacher = NewtonTeacher(FAST)
    bad, good = (np.stack(frames) for frames in zip(*teacher.simulate_many(scenes), strict=True))
    assert np.isfinite(bad[0]).all()
    assert np.isnan(bad[1:]).all()
    np.testing.assert_array_equal(good, np.stack(list(teacher.simulate(scenes[1]))))


def test_frames_of_reference_follow_the_body():
    """The body would run out of the frame that was to follow it, or shake it."""
    time = np.arange(60) / 30
    centre = np.stack([1.5 * time**2, 0.02 * np.sin(20 * time), 0 * time], 1)
    frames = (BALL.vertices[None] + centre[:, None]).astype(np.float32)
    path = MovingFrame(frames, settle=5)
    at = 6.0 + np.arange(60)  # frame t is reached at time settle + t + 1
    reached = path.origin(at)
    assert np.abs(reached[8:-8, 0] - centre[8:-8, 0]).max() < 0.01
    assert np.abs(reached[8:-8, 1]).max() < 0.015  # steps of the gait are smoothed
    np.testing.assert_allclose(path.origin(np.array([-3.0, 0.0, 1.0])), path.origin(1.0)[None].repeat(3, 0))
    assert not MovingFrame(np.zeros((4, 0, 3), np.float32), 2).origin(np.ones(3)).any()


def test_scenes_that_make_no_sense_are_refused():
    """A wrong index would be read outside of its array by a kernel."""
    good = on_ball(still(3))
    cloth = good.cloths[0]
    faces = BALL.faces.copy()
    faces[5, 1] = 999
    bad_body = good.body_frames.copy()
    bad_body[2, 7] = np.nan
    for scene, message in (
        (replace(good, cloths=()), "there is no cloth"),
        (replace(good, body_faces=faces), "body faces name vertices 0 to 999, the body has 162"),
        (replace(good, body_frames=bad_body), r"1 of 3 body frames are not finite \(first: 2\)"),
        (replace(good, body_faces=None), "both body_frames and body_faces"),
        (replace(good, wind=np.zeros((2, 3))), r"wind has shape \[2, 3\], needed is \[3, 3\]"),
        (replace(good, cloths=(replace(cloth, start=cloth.garment.vertices[:9]),)), r"starts from shape \[9, 3\]"),
        (replace(good, cloths=(replace(cloth, edge=0.0),)), "edge length must be positive"),
        (ClothScene((cloth,)), "set `frames` where there is no body"),
    ):
        with pytest.raises(TeacherError, match=message):
            next(iter(NewtonTeacher(FAST).simulate(scene)))
    with pytest.raises(TeacherError, match="scene 1: there is no cloth"):
        next(iter(NewtonTeacher(FAST).simulate_many([good, replace(good, cloths=())])))


def test_settings_are_plain_values():
    """A manifest could not say what a sequence was made with."""
    settings = make_teacher("newton").settings()
    assert json.loads(json.dumps(settings)) == settings
    assert settings["teacher"] == "newton"
    assert {"newton", "warp-lang", "substeps", "iterations", "drag"} <= set(settings)
