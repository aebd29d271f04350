"""Implicit steps: the minimum against SciPy's, the gradient at the vertices, and batches."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from reference.finite_differences import numeric_gradient
from reference.physics import energies as reference
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels.physics import ImplicitSolver, PhysicsCloth, Sheet

SHEET = Sheet.isotropic(0.3, 300.0, 200.0, 1e-3)
INERTIA = 100.0**2


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def square(cells: int) -> meshes.Mesh:
    """A sheet of 0.3 m."""
    k = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    y, x = np.meshgrid(*[np.linspace(0, 0.3, cells + 1)] * 2)
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1).astype(np.float32)
    return meshes.Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32))


def cloth_of(*parts: meshes.Mesh) -> PhysicsCloth:
    packed = meshes.joined(*parts)
    owner = np.zeros(len(packed.faces), int)
    return PhysicsCloth.build(packed.vertices, packed.faces, meshes.offsets(*parts)[0], [SHEET], owner)


class Problem:
    """A step of a sheet that falls on planes with friction, with its energy by the twins.

    Attributes:
        solver: The solver, with its inputs.
        start: Where it starts [m].
    """

    def __init__(self, cells: int, iterations: int, seed: int = 0, copies: int = 1, **options) -> None:
        self.mesh, rng = square(cells), np.random.default_rng(seed)
        self.rest = self.mesh.vertices.astype(np.float64)
        count = len(self.rest)
        self.start = self.rest + 0.004 * rng.normal(size=self.rest.shape)
        self.target = self.start + 0.01 * rng.normal(size=self.rest.shape) - [0, 0, 0.02]
        self.normal = np.where(rng.random(count) < 0.5, 1.0, 0.0)[:, None] * np.array([0.0, 0.6, 0.8])
        self.offset, self.distance = 0.004 * rng.normal(size=count), np.full(count, 0.008)
        self.anchor, self.friction, self.slip = self.start + 0.001, rng.random(count) * 2e-3, 5e-4
        self.held = np.zeros(count, bool)
        self.held[:2] = True
        cloth = cloth_of(*[self.mesh] * copies)
        self.solver = ImplicitSolver(
            cloth,
            inertia=INERTIA,
            iterations=iterations,
            held=np.tile(self.held, copies),
            contact=2e4,
            slip=self.slip,
            **options,
        )
        for name in ("target", "normal", "offset", "distance", "anchor", "friction"):
            value = getattr(self, name)
            getattr(self.solver, name).copy_(torch.from_numpy(np.concatenate([value] * copies)))
        self.solver.positions.copy_(torch.from_numpy(np.concatenate([self.start] * copies)))
        self.mass = reference.masses(self.mesh.faces, self.rest, SHEET.density)
        self.stiffness = 2e4 * reference.masses(self.mesh.faces, self.rest, 1.0)

    def energy(self, points: np.ndarray) -> float:
        """The energy of a step by the twins, without what held vertices have of their own [J]."""
        free = ~self.held
        return (
            reference.membrane_energy(points, self.mesh.faces, self.rest, SHEET.stiffness)
            + reference.bending_energy(points, self.mesh.faces, self.rest, SHEET.bend)
            + reference.inertia_energy(points[free], self.target[free], self.mass[free], INERTIA)
            + reference.contact_energy(
                points[free], self.normal[free], self.offset[free], self.distance[free], self.stiffness[free]
            )
            + reference.friction_energy(
                points[free], self.normal[free], self.anchor[free], self.friction[free], self.slip
            )
        )


def test_energy_and_gradient_of_a_step():
    """A step would minimise something else: inertia, contact and friction against twins and central differences."""
    problem = Problem(4, iterations=1)
    problem.solver.solve()
    found = problem.solver.search["gradient"].numpy()
    expected = numeric_gradient(problem.energy, problem.start, 1e-6)
    expected[problem.held] = 0.0
    assert problem.solver.energy()[0].item() == pytest.approx(problem.energy(problem.start), rel=1e-6)
    # central differences over 1 um of contact energies with kinks
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


def test_reaches_the_minimum():
    """Iterations would stop before the end of the step: the gradient by the twins, and energies around the result."""
    problem = Problem(4, iterations=400, tolerance=1e-10)
    found, free = problem.solver.solve().numpy().copy(), ~problem.held
    gradient = numeric_gradient(problem.energy, found, 1e-7)[free]
    before = numeric_gradient(problem.energy, problem.start, 1e-7)[free]
    # a force of 1e-4 of that at the start; central differences of 0.03 J over 1e-7 m leave 3e-10 / 1e-7 N
    assert np.abs(gradient).max() < max(1e-4 * np.abs(before).max(), 1e-8 * problem.energy(found) / 1e-7)
    assert (found[problem.held] == problem.start[problem.held]).all()
    rng, lowest = np.random.default_rng(1), problem.energy(found)
    for size in (1e-5, 1e-4, 1e-3):
        moved = found.copy()
        moved[free] += size * rng.normal(size=moved[free].shape)
        assert problem.energy(moved) > lowest


def test_more_iterations_never_raise_the_energy():
    """A line search that takes what it should refuse: cloth would shake."""
    values = [
        (lambda p: (p.solver.solve(), p.solver.energy()[0].item())[1])(Problem(6, iterations=n)) for n in range(1, 30)
    ]
    assert all(later <= earlier * (1 + 1e-12) for earlier, later in itertools.pairwise(values))
    assert values[-1] < 0.9 * values[0]


def test_groups_do_not_see_each_other():
    """A garment in a batch would end elsewhere than alone: each group has a search of its own."""
    alone, pair = Problem(5, iterations=25), Problem(5, iterations=25, copies=2)
    half = len(alone.start)
    pair.solver.target[half:] += 0.05  # the second garment moves differently
    found, expected = pair.solver.solve(), alone.solver.solve()
    assert torch.equal(found[:half], expected)
    assert (found[half:] - expected).abs().max() > 0.01


def test_lanes_of_a_block_agree_with_one(monkeypatch):
    """On a GPU, where many lanes share a group, a step would end elsewhere than on the CPU."""
    import warp as wp

    expected = Problem(5, iterations=12).solver.solve().clone()
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    found = Problem(5, iterations=12).solver.solve()
    assert (found - expected).abs().max() < 1e-9  # sums in another order


def test_a_garment_that_is_not_finite_leaves_others_alone():
    """One garment's NaN would spread through a batch."""
    alone, pair = Problem(4, iterations=10), Problem(4, iterations=10, copies=2)
    half = len(alone.start)
    pair.solver.positions[half + 3] = float("nan")
    assert torch.equal(pair.solver.solve()[:half], alone.solver.solve())
