"""The force of the air against a NumPy twin in float64 and against what is known of a plate; and the wind itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference import wind as reference
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels.wind import air_forces
from warpgarment.training.generate.wind import Wind, sampled_wind, speed_of_strength, strength_of_speed

GARMENTS = meshes.garments()


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def moving(name: str, scale: float = 1.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A deformed garment whose vertices move at some 2 m/s: float32 vertices, velocities, int32 faces."""
    mesh = meshes.moved(GARMENTS[name].scaled(scale), seed)
    velocities = np.random.default_rng(seed).normal(scale=1.2, size=mesh.vertices.shape).astype(np.float32)
    return mesh.vertices, velocities, mesh.faces


def forces(vertices, velocities, faces, air, **options) -> np.ndarray:
    """The launcher, with arrays in and out."""
    return air_forces(*(torch.as_tensor(np.asarray(a)) for a in (vertices, velocities, faces, air)), **options).numpy()


@pytest.mark.parametrize("scale", meshes.SCALES)
@pytest.mark.parametrize("name", GARMENTS)
def test_agrees_with_float64(name, scale, poisoned):
    """Cloth would be blown the wrong way, or by the wrong force."""
    vertices, velocities, faces = moving(name, scale)
    air = np.array([[3.0, -0.5, 1.5]], np.float32)
    found = forces(vertices, velocities, faces, air, drag=1.1, lift=0.7, density=1.3)
    expected = reference.air_forces(vertices, velocities, faces, air, drag=1.1, lift=0.7, density=1.3)
    assert len(poisoned) == 1
    # edges carry a relative error of 1e-7 times size over edge length (up to 60 here), areas twice that
    assert np.abs(found - expected).max() <= 2e-5 * np.abs(expected).max()


def test_worlds_do_not_share_their_air():
    """In a batch, a garment in still air would feel the wind of another."""
    parts = [moving(name, seed=i) for i, name in enumerate(GARMENTS)]
    starts = np.cumsum([0] + [len(p[0]) for p in parts])
    air = np.random.default_rng(1).normal(scale=4, size=(len(parts), 3)).astype(np.float32)
    world = np.repeat(np.arange(len(parts), dtype=np.int32), np.diff(starts))
    packed = [
        np.concatenate([p[0] for p in parts]),
        np.concatenate([p[1] for p in parts]),
        np.concatenate([p[2] + s for p, s in zip(parts, starts[:-1], strict=True)]).astype(np.int32),
    ]
    together = forces(*packed, air, world=torch.as_tensor(world))
    np.testing.assert_array_equal(together, forces(*packed, air, world=torch.as_tensor(world)))
    for i, part in enumerate(parts):
        np.testing.assert_array_equal(together[starts[i] : starts[i + 1]], forces(*part, air[i : i + 1]))


PLATE = (
    np.array([[0, 0, 0], [2, 0, 0], [2, 0, 3], [0, 0, 3]], np.float32),
    np.zeros((4, 3), np.float32),
    np.array([[0, 2, 1], [0, 3, 2]], np.int32),  # 6 m^2, facing up
)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_plate_met_head_on(side):
    """The drag of a plate would not be ½ ρ C_D A v², or depend on which side of the cloth the wind meets."""
    found = forces(*PLATE, np.array([[0, side * 5.0, 0]], np.float32))
    assert found.sum(0) == pytest.approx([0, side * 0.5 * 1.225 * 1.2 * 6.0 * 25.0, 0], rel=1e-6)
    # each face gives a third to its corners: two faces meet at the first and the third vertex
    np.testing.assert_allclose(found[:, 1] / found[1, 1], [2, 1, 2, 1], rtol=1e-6)


def test_a_plate_at_45_degrees():
    """Lift would point elsewhere than across the wind, or not be C_L sin θ cos θ."""
    speed = 4.0
    along = np.array([np.sqrt(0.5), np.sqrt(0.5), 0])
    found = forces(*PLATE, (speed * along)[None].astype(np.float32)).sum(0)
    pressure = 0.5 * 1.225 * speed**2 * 6.0
    assert found @ along == pytest.approx(pressure * 1.2 * np.sqrt(0.5), rel=1e-6)
    across = np.array([-np.sqrt(0.5), np.sqrt(0.5), 0])
    assert found @ across == pytest.approx(pressure * 0.6 * 0.5, rel=1e-6)


def test_no_force_without_wind_or_along_the_plate():
    """Cloth would be pushed by air that moves with it, or that slides along it; a degenerate face would give NaN."""
    vertices, _, faces = PLATE
    with_the_air = np.full((4, 3), 2.5, np.float32)
    assert not forces(vertices, with_the_air, faces, with_the_air[:1]).any()
    assert not forces(*PLATE, np.array([[3.0, 0, -2.0]], np.float32)).any()
    flat = np.zeros_like(vertices)
    assert not forces(flat, flat, faces, np.ones((1, 3), np.float32)).any()


def test_refuses_what_the_kernel_could_not_read():
    """A wrong index would write outside the arrays instead of naming itself."""
    vertices, velocities, faces = (torch.as_tensor(a) for a in PLATE)
    air = torch.zeros(2, 3)
    with pytest.raises(ValueError, match="world is needed to choose among the air of 2 worlds"):
        air_forces(vertices, velocities, faces, air)
    with pytest.raises(ValueError, match="faces holds indices 0 to 9, there are 4 vertices"):
        air_forces(vertices, velocities, faces.clone().fill_(9).index_fill_(0, torch.tensor([0]), 0), air[:1])
    world = torch.tensor([0, 0, 0, -1], dtype=torch.int32)
    with pytest.raises(ValueError, match="world holds indices -1 to 0, there are 1 worlds"):
        air_forces(vertices, velocities, faces, air[:1], world=world)
    with pytest.raises(TypeError, match="velocities must be float32"):
        air_forces(vertices, velocities.double(), faces, air[:1])
    assert air_forces(vertices, velocities, faces[:0], air[:1]).abs().sum() == 0


def test_a_steady_wind_is_steady_and_gusts_are_smooth():
    """A wind would jump between frames, or not have the strength and direction it says."""
    steady = Wind(direction=(0.0, 3.0, 4.0), strength=2.0).velocities(5, 30.0)
    assert steady.dtype == np.float32
    np.testing.assert_allclose(steady, np.tile([0.0, 1.2, 1.6], (5, 1)), rtol=1e-6)

    wind = Wind((1.0, 0.0, 0.0), 5.0, gusts=0.5, turn=0.4, period=2.0, phases=(0.3, 1.0, 2.0, 0.1, 4.0, 5.0))
    slow, fast = wind.velocities(600, 30.0), wind.velocities(2400, 120.0)
    np.testing.assert_array_equal(slow, fast[::4])  # a function of time, not of the frame rate
    speed = np.linalg.norm(slow, axis=1)
    assert 2.5 <= speed.min() < 3.5
    assert 6.5 < speed.max() <= 7.5
    assert speed.mean() == pytest.approx(5.0, rel=0.03)
    angle = np.arctan2(-slow[:, 2], slow[:, 0])
    assert 0.3 < np.abs(angle).max() <= 0.4
    # the steepest a sum of sines of these amplitudes can be: each amplitude times its angular frequency
    steepest = 2 * np.pi / 2.0 * (np.array([1.0, 1.618, 2.618]) @ [0.5, 0.3, 0.2]) * (5.0 * 0.5 + 7.5 * 0.4) / 30
    assert np.linalg.norm(np.diff(slow, axis=0), axis=1).max() < steepest


def test_sampled_winds_are_a_function_of_the_seed():
    """Two runs of the same seed would blow differently, or a wind be stronger than asked for."""
    first, again = (sampled_wind(np.random.default_rng(5)) for _ in range(2))
    assert first == again
    assert first != sampled_wind(np.random.default_rng(6))
    rng = np.random.default_rng(0)
    winds = [sampled_wind(rng, strongest=6.0, calm=0.3) for _ in range(200)]
    strength = np.array([w.strength for w in winds])
    assert strength.max() <= 6.0
    assert 0.2 < (strength == 0).mean() < 0.4
    headings = np.array([w.direction for w in winds])
    assert np.abs(headings.mean(0)).max() < 0.2  # from everywhere
    assert not Wind(strength=0.0, gusts=0.4).velocities(9).any()


def test_bad_winds_are_refused():
    """A direction without length would become NaN in every frame."""
    with pytest.raises(ValueError, match="no length"):
        Wind(direction=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"gusts 1\.5 lie in"):
        Wind(gusts=1.5)


def test_blender_strengths_are_pressures():
    """A wind would press on Blender's cloth otherwise than on Newton's."""
    for scale in (1.0, 10.0):
        speed = speed_of_strength(20_000, scale)
        assert strength_of_speed(speed, scale) == pytest.approx(20_000)
        head_on = forces(*PLATE, np.array([[0, speed, 0]], np.float32))[:, 1].sum() / 6.0
        assert head_on == pytest.approx(20_000 * 0.02 / 30 * scale**2, rel=1e-5)
    assert speed_of_strength(1000) == pytest.approx(0.95, abs=0.01)
