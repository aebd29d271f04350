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


def relax(*garments: Garment, iterations: int = 8, pull: float = 100.0, materials=None) -> Relax:
    return Relax(PackedGarments.pack(garments, CPU), iterations, pull, 30.0, materials, Timings(CPU))


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
    mass = reference.masses(faces, rest, material.density)

    def energy(points: np.ndarray) -> float:
        return (
            reference.membrane_energy(points, faces, rest, stiffness)
            + reference.bending_energy(points, faces, rest, material.bend)
            + reference.inertia_energy(points, start.astype(np.float64), mass, 100.0 * 30.0**2)
        )

    before, after = energy(start.astype(np.float64)), energy(found)
    assert after < 0.5 * before
    assert np.linalg.norm(found - start, axis=1).max() < 0.03
    ends = garment.edges
    lengths = [np.linalg.norm(p[ends[:, 0]] - p[ends[:, 1]], axis=1) for p in (rest, start, found)]
    assert np.abs(lengths[2] / lengths[0] - 1).mean() < 0.7 * np.abs(lengths[1] / lengths[0] - 1).mean()


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
    with pytest.raises(ValueError, match="physics_pull"):
        network(physics_pull=0.0)
