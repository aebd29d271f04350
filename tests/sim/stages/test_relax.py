"""The cloth's own physics in a frame: off it changes nothing, on it lowers the energy near the predicted positions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from reference.physics import energies as reference
from support.scenes import network, simulator, skirt, walk

from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.pack import PackedGarments
from warpgarment.sim import memory
from warpgarment.sim.stages.relax import Relax
from warpgarment.sim.timing import Timings

CPU = torch.device("cpu")


def relax(*garments: Garment, iterations: int = 8, length: float = 2.5, materials=None) -> Relax:
    return Relax(PackedGarments.pack(garments, CPU), iterations, length, materials, Timings(CPU))


def squeezed(garment: Garment, seed: int = 0) -> np.ndarray:
    """The garment squeezed by 8 % in height, with 1 mm of noise: [V,3], float32."""
    rng = np.random.default_rng(seed)
    points = garment.vertices * [1.0, 0.92, 1.0] + 0.001 * rng.normal(size=garment.vertices.shape)
    points[garment.pins] = garment.vertices[garment.pins]
    return points.astype(np.float32)


def test_lowers_the_energy_and_keeps_the_place():
    """The stage would tear cloth away from where the network put it, or do nothing; energies are the twins'."""
    garment, material = skirt(), Material()
    start = squeezed(garment)
    found = relax(garment)(torch.from_numpy(start), torch.ones(1, dtype=torch.bool)).numpy().astype(np.float64)
    rest, faces = garment.vertices.astype(np.float64), garment.faces
    both = material.stretch + 2 * material.shear
    stiffness = [[both, material.stretch, 0], [material.stretch, both, 0], [0, 0, material.shear]]
    held = reference.masses(faces, rest, both)  # area times stiffness

    def energy(points: np.ndarray) -> float:
        return (
            reference.membrane_energy(points, faces, rest, stiffness)
            + reference.bending_energy(points, faces, rest, material.bend)
            + reference.inertia_energy(points, start.astype(np.float64), held, (2.0 * np.pi / 2.5) ** 2)
        )

    before, after = energy(start.astype(np.float64)), energy(found)
    assert after < 0.5 * before
    assert np.linalg.norm(found - start, axis=1).max() < 0.03
    ends = garment.edges
    lengths = [np.linalg.norm(p[ends[:, 0]] - p[ends[:, 1]], axis=1) for p in (rest, start, found)]
    assert np.abs(lengths[2] / lengths[0] - 1).mean() < 0.7 * np.abs(lengths[1] / lengths[0] - 1).mean()


def test_long_waves_stay_and_short_ones_go():
    """The length would not say which waves are the network's: waves of strain across a strip, of energy 1/2 k e^2 for a
    strain e, lose little of their size where they are three times as long as it, most where they are a third.

    Of two quadratic energies with ratio r = (l / L)^2 at a wave of length l the least is at r / (1 + r) of the size: a
    tenth, 0.9; 0.15 for edges of a sixth of the wave, which see less strain, and ends."""
    columns, spacing = 37, 0.01
    x, y = np.meshgrid(np.arange(columns) * spacing, np.arange(4) * spacing, indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(columns - 1)[:, None] * 4 + np.arange(3)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 4, corner + 5], 1), np.stack([corner, corner + 5, corner + 1], 1)]
    )
    strip = Garment(points.astype(np.float32), faces)
    kept = []
    for wave in (0.06, 0.54):
        shape = np.cos(2.0 * np.pi * points[:, 0] / wave)
        start = points + 2e-4 * shape[:, None] * [1.0, 0.0, 0.0]
        stage = relax(strip, iterations=40, length=0.18)
        found = stage(torch.from_numpy(start.astype(np.float32)), torch.ones(1, dtype=torch.bool)).numpy()
        inner = (points[:, 0] > 0.06) & (points[:, 0] < 0.30)
        moved = (found - points)[inner, 0]
        kept.append(float(moved @ shape[inner] / (2e-4 * (shape[inner] @ shape[inner]))))
    assert kept[0] < 0.25
    assert kept[1] > 0.75


def test_the_same_for_soft_and_stiff_cloth():
    """What the network decides would depend on the fabric. 1e-5 m: 40 iterations do not end at the same bits."""
    found = []
    for times in (0.05, 1.0):
        material = Material(stretch=1000.0 * times, shear=1000.0 * times, bend=1e-3 * times)
        stage = relax(skirt(), iterations=40, materials=torch.tensor([dataclasses.astuple(material)]))
        found.append(stage(torch.from_numpy(squeezed(skirt())), torch.ones(1, dtype=torch.bool)))
    assert (found[0] - found[1]).abs().max() < 1e-5


def test_off_changes_nothing():
    """Networks without the setting would give other bits."""
    start = torch.from_numpy(squeezed(skirt()))
    stage = relax(skirt(), iterations=0)
    assert stage(start, torch.ones(1, dtype=torch.bool)) is start
    assert "physics" not in network().config.as_dict()


def test_pins_stay():
    """A waistband would be pulled off the body."""
    garment = skirt()
    garment = Garment(garment.vertices, garment.faces, pins=[0, 3, 7])
    start = squeezed(garment)
    found = relax(garment)(torch.from_numpy(start), torch.ones(1, dtype=torch.bool)).numpy()
    np.testing.assert_array_equal(found[garment.pins], start[garment.pins])
    assert np.abs(found - start).max() > 1e-3


def test_frames_do_not_depend_on_frames_before():
    """`step` from one state would give another frame the second time."""
    stage, on = relax(skirt()), torch.ones(1, dtype=torch.bool)
    start = torch.from_numpy(squeezed(skirt()))
    first = stage(start, on)
    stage(torch.from_numpy(squeezed(skirt(), 5)), on)
    assert torch.equal(stage(start, on), first)


def test_a_batch_is_like_one_at_a_time_and_materials_are_each_garments():
    """One garment would be relaxed with another's cloth, or be moved by its neighbour."""
    fields = [dataclasses.astuple(m) for m in (Material(), Material(stretch=50.0, shear=50.0, bend=0.1))]
    starts = [torch.from_numpy(squeezed(skirt(), n)) for n in (1, 2)]
    both = relax(skirt(), skirt(), materials=torch.tensor(fields))
    together = both(torch.cat(starts), torch.ones(2, dtype=torch.bool)).split(len(starts[0]))
    for found, start, row in zip(together, starts, fields, strict=True):
        alone = relax(skirt(), materials=torch.tensor([row]))(start, torch.ones(1, dtype=torch.bool))
        assert torch.equal(found, alone)
    assert (together[1] - relax(skirt())(starts[1], torch.ones(1, dtype=torch.bool))).abs().max() > 1e-4


def test_stopped_garments_are_not_moved():
    """A garment that is not finite would be moved, or would spoil others."""
    starts = torch.cat([torch.from_numpy(squeezed(skirt())), torch.full((len(skirt().vertices), 3), float("nan"))])
    found = relax(skirt(), skirt())(starts, torch.tensor([True, False]))
    half = len(skirt().vertices)
    assert torch.equal(found[:half], relax(skirt())(starts[:half], torch.ones(1, dtype=torch.bool)))
    assert found[half:].isnan().all()


def test_gradients_pass():
    """Training around the stage would get no gradient."""
    start = torch.from_numpy(squeezed(skirt())).requires_grad_()
    weights = torch.randn(start.shape, generator=torch.Generator().manual_seed(0))
    (relax(skirt())(start, torch.ones(1, dtype=torch.bool)) * weights).sum().backward()
    assert torch.equal(start.grad, weights)


def test_a_simulator_runs_it_when_asked():
    """`sim.physics` would not reach the frames, not be timed, or not count in the forecast of memory."""
    plain, asked = simulator(network()), simulator(network())
    asked.physics = 4
    one, other = (s.rollout(skirt(), walk(4)).vertices for s in (plain, asked))
    assert np.abs(one[-1] - other[-1]).max() > 1e-5
    assert asked.timings["physics"] > 0
    assert "physics" not in plain.timings
    own = simulator(network(physics=4))
    np.testing.assert_array_equal(own.rollout(skirt(), walk(4)).vertices, other)
    sizes = [memory.predict([skirt()], [walk(2)], network().config, physics=n).total for n in (0, 4)]
    assert sizes[1] > sizes[0]


def test_silly_settings_are_refused():
    """A checkpoint with a negative number of iterations would fail in a kernel."""
    with pytest.raises(ValueError, match="physics"):
        network(physics=-1)
    with pytest.raises(ValueError, match="physics_length"):
        network(physics_length=0.0)
