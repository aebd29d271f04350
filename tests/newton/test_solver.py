"""The solver for Newton: a garment on the shapes of a model moves as the simulator moves it on the same mesh."""

from __future__ import annotations

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from support import scenes

import warpgarment as wg
from warpgarment.errors import UsageError
from warpgarment.newton import SolverNeuralGarment, add_garment

FPS = 30.0
NAMES = ("particle_q", "particle_qd")


def skirt() -> wg.Garment:
    """The skirt of the simulator's tests, in a size that the body below fits."""
    return scenes.skirt()


def builder(garments, axis: str = "Z") -> newton.ModelBuilder:
    """A world: a capsule that can move, upright, with a ball beside it that is no body of garments, and garments."""
    made = newton.ModelBuilder(up_axis=newton.Axis.from_any(axis))
    body = made.add_body(xform=wp.transform_identity())
    turn = {"Z": wp.quat_identity(), "Y": wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), -np.pi / 2)}[axis]
    made.add_shape_capsule(body, xform=wp.transform((0.0, 0.0, 0.0), turn), radius=0.15, half_height=0.4)
    made.add_shape_sphere(-1, xform=wp.transform((5.0, 0.0, 0.0), wp.quat_identity()), radius=0.5)
    for garment in garments:
        add_garment(made, garment)
    return made


def model_of(worlds: int = 1, garments=None, axis: str = "Z") -> newton.Model:
    """Equal worlds side by side."""
    root = newton.ModelBuilder(up_axis=newton.Axis.from_any(axis))
    for _ in range(worlds):
        root.add_world(builder(garments or [skirt()], axis))
    return root.finalize(device="cpu")


def pose(time: float, phase: float = 0.0) -> np.ndarray:
    """Position and quaternion of a body, Z up, that sways and turns."""
    place = [0.1 * np.sin(4 * time + phase) - 0.1 * np.sin(phase), 0.15 * time, 0.0]
    return np.concatenate([place, Rotation.from_rotvec([0.0, 0.0, 0.8 * time]).as_quat()]).astype(np.float32)


def moved(state: newton.State, *poses: np.ndarray) -> None:
    """Puts the bodies of all worlds somewhere."""
    state.body_q.assign(np.stack(poses))


def played(solver: SolverNeuralGarment, model: newton.Model, dt: float, steps: int, phases=(0.0,)) -> list[np.ndarray]:
    """Particles after each step, of bodies that the caller moves."""
    one, two = model.state(), model.state()
    shown = []
    for step in range(1, steps + 1):
        moved(two, *(pose(step * dt, phase) for phase in phases))
        solver.step(one, two, None, None, dt)
        shown.append(two.particle_q.numpy().copy())
        one, two = two, one
    return shown


def expected(simulator: wg.Simulator, frames: int, phase: float = 0.0) -> np.ndarray:
    """The same by the simulator, on a mesh that SciPy turns; Z up."""
    model = model_of()
    solver = SolverNeuralGarment(model, skirt(), simulator)
    rest = solver.collider.at(model).numpy()[:, [0, 2, 1]] * [1, -1, 1]  # Z up
    poses = [pose(frame / FPS, phase) for frame in range(frames + 1)]
    body = np.stack([Rotation.from_quat(p[3:]).apply(rest) + p[:3] for p in poses])[..., [0, 2, 1]] * [1, 1, -1]
    motion = simulator.rollout(skirt(), wg.BodyMotion(body, solver.collider.faces[0], FPS))
    return motion.vertices[..., [0, 2, 1]] * [1, -1, 1]


@pytest.fixture(scope="module")
def simulator() -> wg.Simulator:
    """A small network with random weights: it moves cloth somehow, which is enough to compare."""
    return scenes.simulator(scenes.network(residual=True))


def test_a_frame_is_one_of_the_simulator(simulator):
    """A garment in Newton would move otherwise than on the same body elsewhere: the features, the axes or the pose of
    the collider would be wrong. Beside `Simulator.rollout` on a mesh that SciPy moves, to 0.01 mm."""
    model = model_of()
    found = played(SolverNeuralGarment(model, skirt(), simulator), model, 1 / FPS, 5)
    np.testing.assert_allclose(np.stack(found), expected(simulator, 5)[1:], atol=1e-5)
    assert np.abs(found[4] - found[0]).max() > 0.01


def test_the_axis_of_the_model_does_not_matter(simulator):
    """In a model with Y up, cloth would lie on its side. The same scene with its axes changed, to 0.01 mm."""
    model = model_of(axis="Y")
    solver = SolverNeuralGarment(model, skirt(), simulator)
    one, two = model.state(), model.state()
    for step in range(1, 4):
        at = pose(step / FPS)
        x, y, z = Rotation.from_quat(at[3:]).as_rotvec()
        turn = Rotation.from_rotvec([x, z, -y]).as_quat()
        moved(two, np.concatenate([[at[0], at[2], -at[1]], turn]).astype(np.float32))
        solver.step(one, two, None, None, 1 / FPS)
        one, two = two, one
    found = one.particle_q.numpy()[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(found, expected(simulator, 3)[3], atol=1e-5)


def test_worlds_are_a_batch_and_do_not_meet(simulator):
    """A world would move with the body of another, or see its cloth. Two worlds at the same place with other motions,
    beside each alone: 0.05 mm, since small garments are padded together (docs/rounding.md)."""
    model = model_of(2)
    found = played(SolverNeuralGarment(model, skirt(), simulator), model, 1 / FPS, 4, phases=(0.0, 1.5))
    halves = np.split(found[-1], 2)
    for half, phase in zip(halves, (0.0, 1.5), strict=True):
        np.testing.assert_allclose(half, expected(simulator, 4, phase)[4], atol=5e-5)
    assert np.abs(halves[0] - halves[1]).max() > 0.01


def test_between_frames_particles_are_held(simulator):
    """Cloth would run four times as fast as its body in substeps, or change between frames. Of four steps to a frame
    the first three change nothing, bit for bit, and the fourth is the frame of one step: 0.1 mm, as bodies are taken
    from the same times."""
    model = model_of()
    found = played(SolverNeuralGarment(model, skirt(), simulator), model, 1 / (4 * FPS), 12)
    first = model.particle_q.numpy().copy()
    frames = expected(simulator, 3)
    for step, positions in enumerate(found, start=1):
        held = found[4 * (step // 4) - 1] if step >= 4 else first
        np.testing.assert_array_equal(positions, held)
    np.testing.assert_allclose(np.stack(found[3::4]), frames[1:], atol=1e-4)


def test_between_frames_particles_can_go_straight(simulator):
    """`between="interpolate"` would jump, or not be one frame late: a quarter of the way after each of four steps,
    to 1e-6 m; velocities are the way of a frame over its time."""
    model = model_of()
    solver = SolverNeuralGarment(model, skirt(), simulator, between="interpolate")
    found = played(solver, model, 1 / (4 * FPS), 11)
    held = played(SolverNeuralGarment(model, skirt(), simulator), model, 1 / (4 * FPS), 11)
    one, two = held[3], held[7]  # frames 1 and 2
    np.testing.assert_allclose(found[7], one, atol=1e-6)
    np.testing.assert_allclose(found[9], one + (two - one) / 2, atol=1e-6)
    state = model.state()
    solver.step(state, state, None, None, 0.0)
    np.testing.assert_allclose(state.particle_qd.numpy(), (two - one) * FPS, atol=1e-4)


def test_a_long_step_makes_all_of_its_frames(simulator):
    """A step of 100 ms would be one frame of a body three times as fast. Beside three frames of a body that goes on a
    straight line between the ends, 0.01 mm."""
    model = model_of()
    found = played(SolverNeuralGarment(model, skirt(), simulator), model, 3 / FPS, 1)
    solver = SolverNeuralGarment(model, skirt(), simulator)
    begin = model.state()
    end = model.state()
    moved(end, pose(3 / FPS))
    ends = [solver.collider.at(state).numpy() for state in (begin, end)]
    body = np.stack([ends[0] + (ends[1] - ends[0]) * share for share in (0, 1 / 3, 2 / 3, 1)])
    motion = simulator.rollout(skirt(), wg.BodyMotion(body, solver.collider.faces[0], FPS))
    np.testing.assert_allclose(found[0], motion.vertices[3][:, [0, 2, 1]] * [1, -1, 1], atol=1e-5)


def test_a_world_is_reset_and_others_go_on(simulator):
    """A reset of one world would change another, or leave speed and folds of the time before. The other world is as
    without, bit for bit; the one that is reset, on a body that was put elsewhere, goes on as a new solver there does,
    to 0.05 mm."""
    model = model_of(2)
    phases = (0.0, 1.5)
    solver, other = (SolverNeuralGarment(model, skirt(), simulator) for _ in range(2))
    played(solver, model, 1 / FPS, 3, phases)
    played(other, model, 1 / FPS, 3, phases)
    state, plain = model.state(), model.state()
    away = np.concatenate([[2.0, 1.0, 0.0], Rotation.from_rotvec([0, 0, 1.0]).as_quat()]).astype(np.float32)
    for each in (state, plain):
        moved(each, pose(3 / FPS, 0.0), away)
    solver.reset(state, wp.array([False, True, False], dtype=wp.bool, device="cpu"))
    turned = Rotation.from_quat(away[3:])
    rest = turned.apply(np.split(model.particle_q.numpy(), 2)[1]) + away[:3]
    np.testing.assert_allclose(np.split(state.particle_q.numpy(), 2)[1], rest, atol=1e-5)
    assert not np.split(state.particle_qd.numpy(), 2)[1].any()
    follow = model.state()
    for step in range(4, 6):
        at = pose(step / FPS)
        later = np.concatenate([turned.apply(at[:3]) + away[:3], (turned * Rotation.from_quat(at[3:])).as_quat()])
        moved(follow, at, later.astype(np.float32))
        solver.step(state, follow, None, None, 1 / FPS)
        moved(plain, at, pose(step / FPS, 1.5))
        other.step(plain, plain, None, None, 1 / FPS)
    np.testing.assert_array_equal(np.split(follow.particle_q.numpy(), 2)[0], np.split(plain.particle_q.numpy(), 2)[0])
    fresh = model_of()
    begin = fresh.state()
    moved(begin, away)
    begin.particle_q.assign(rest.astype(np.float32))
    new = SolverNeuralGarment(fresh, skirt(), simulator, state=begin)
    for step in range(4, 6):
        at = pose(step / FPS)
        later = np.concatenate([turned.apply(at[:3]) + away[:3], (turned * Rotation.from_quat(at[3:])).as_quat()])
        moved(begin, later.astype(np.float32))
        new.step(begin, begin, None, None, 1 / FPS)
    np.testing.assert_allclose(np.split(follow.particle_q.numpy(), 2)[1], begin.particle_q.numpy(), atol=5e-5)


def test_bodies_of_the_state_before(simulator):
    """With `bodies="in"` the bodies of `state_out` would stay where they were two steps ago."""
    model = model_of()
    solver = SolverNeuralGarment(model, skirt(), simulator, bodies="in")
    one, two = model.state(), model.state()
    for step in range(1, 4):
        moved(one, pose(step / FPS))
        solver.step(one, two, None, None, 1 / FPS)
        np.testing.assert_array_equal(two.body_q.numpy(), one.body_q.numpy())
        one, two = two, one
    np.testing.assert_allclose(one.particle_q.numpy(), expected(simulator, 3)[3], atol=1e-5)


def test_what_does_not_fit_is_said(simulator):
    """Particles of something else would be moved as cloth, or a slip end in an index error."""
    model = model_of(2)
    with pytest.raises(ValueError, match=r"world 0 has 112 particles, and its garments 224 vertices\. Add each"):
        SolverNeuralGarment(model, [skirt(), skirt()], simulator)
    with pytest.raises(ValueError, match="2 worlds and garments for 3"):
        SolverNeuralGarment(model, [[skirt()]] * 3, simulator)
    with pytest.raises(wg.MeshError, match="world 1 has no shape"):
        SolverNeuralGarment(model, skirt(), simulator, shapes=[0])
    with pytest.raises(UsageError, match='between "hold" or "interpolate"'):
        SolverNeuralGarment(model, skirt(), simulator, between="later")
    solver = SolverNeuralGarment(model, skirt(), simulator)
    with pytest.raises(ValueError, match="dt must be a time"):
        solver.step(model.state(), model.state(), None, None, -1.0)
    assert [status.finite for status in solver.status] == [True, True]
