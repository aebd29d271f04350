"""Pairs of faces that keep a distance, as part of a step: energy and gradient against the twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from reference.finite_differences import numeric_gradient
from reference.physics import energies as reference
from support import meshes

from warpgarment.kernels.cloth.contacts import Contacts
from warpgarment.kernels.cloth.pairs import FacePairs, Outfits
from warpgarment.kernels.physics import ImplicitSolver, PhysicsCloth, Sheet

DISTANCE, STIFFNESS, SLIP = 0.01, 30.0, 5e-4
FRICTION = (0.2, 0.6)


@pytest.mark.parametrize("moved", [0.0, 2e-4, 3e-3], ids=["at rest", "sticking", "sliding"])
def test_energy_and_gradient_of_pairs(moved):
    """Layers would attract each other, push by another force than the energy's, or rub the wrong way.

    Two triangles 6 mm apart, one tilted, with no stiffness of their own worth mentioning.
    """
    first = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0]])
    second = first @ np.array([[1, 0, 0.1], [0, 1, -0.05], [0, 0, 1]]) + [0.004, 0.003, 0.006]
    points = np.concatenate([first, second])
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    parts = [meshes.Mesh(p.astype(np.float32), faces[:1]) for p in (first, second)]
    packed = meshes.joined(*parts)
    cloth = PhysicsCloth.build(points, packed.faces, [0, 6], [Sheet.isotropic(0.2, 1e-9, 1e-9, 0.0)], np.zeros(2, int))

    def integers(*values: int) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.int32)

    tensor = torch.from_numpy(points).float()
    outfits = Outfits(torch.from_numpy(packed.faces), integers(0, 1), integers(0, 0), integers(0, 1))
    pairs = FacePairs(outfits, tensor, margin=0.02)
    contacts = Contacts(pairs, 6, thickness=DISTANCE, rounds=1)
    pairs.find(tensor, tensor, torch.ones(2, dtype=torch.bool))
    contacts.find(tensor, tensor)
    solver = ImplicitSolver(
        cloth,
        inertia=1.0,
        iterations=1,
        slip=SLIP,
        pairs=contacts,
        pair_distance=DISTANCE,
        pair_stiffness=STIFFNESS,
        pair_friction=torch.tensor(FRICTION, dtype=torch.float64),
    )
    before = points - np.repeat([[0.6 * moved, -0.8 * moved, 0.0], [0.0, 0.0, 0.0]], 3, axis=0)
    solver.positions.copy_(torch.from_numpy(before))
    solver.remember()
    start = torch.from_numpy(points)
    solver.target.copy_(start)
    solver.positions.copy_(start)
    solver.solve()

    member, partner = (0, 1) if int(pairs.count[0]) else (1, 0)
    n, u, v = (t[member, 0].double().numpy() for t in (contacts.normal, contacts.weights_p, contacts.weights_q))
    one, other = packed.faces[member], packed.faces[partner]
    # the direction leads from the partner to the face, over the distance of the nearest points
    gap = u @ points[one] - v @ points[other]
    assert 0.003 < np.linalg.norm(gap) < 0.009
    assert np.allclose(n, gap / np.linalg.norm(gap), atol=1e-5)

    def energy(x: np.ndarray) -> float:
        return reference.pair_energy(x, one, other, u, v, n, DISTANCE, STIFFNESS, before, sum(FRICTION) / 2, SLIP)

    assert energy(points) > 1e-5
    # float32 weights and directions enter both; the sheet's own energy at float32 rest positions is below 1e-12 J
    assert abs(solver.energy()[0].item() - energy(points)) < 1e-9 * STIFFNESS
    found, expected = solver.search["gradient"].numpy(), numeric_gradient(energy, points, 1e-6)
    assert np.abs(found - expected).max() < 1e-6 * np.abs(expected).max() + 1e-9
    solver.solve()  # what pairs accumulate is cleared between evaluations
    assert np.abs(solver.search["gradient"].numpy() - expected).max() < 1e-6 * np.abs(expected).max() + 1e-9
