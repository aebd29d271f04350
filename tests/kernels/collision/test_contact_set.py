"""Contacts as a struct: the body's against every face tried in float64, and what the solver makes of any source's."""

import numpy as np
import pytest
import torch
from reference import collision as reference
from reference.body_contacts import body_contacts
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels.collision import BodyContacts, CollisionSolver, ContactFrame, Contacts
from warpgarment.kernels.collision.contact_set import nearest
from warpgarment.kernels.sdf.bodies import BodyMeshes

EPSILON = 0.004
TOLERANCE = 2e-5  # m: what the solver promises


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def bodies_of(mesh: meshes.Mesh) -> BodyMeshes:
    return BodyMeshes(torch.tensor(mesh.vertices), torch.tensor(mesh.faces))


def solver_for(rest: meshes.Mesh) -> CollisionSolver:
    return CollisionSolver(torch.tensor(rest.vertices), torch.tensor(rest.faces))


@pytest.mark.parametrize("remembers", [False, True])
@pytest.mark.parametrize("each", [False, True])
def test_body_contacts_are_those_of_a_twin(each, remembers):
    """A contact would have a wrong face, side, body, distance or vertex.

    Two bodies of overlapping limbs and a third of the vertices on none; a distance for all or for each vertex; with and
    without the way that they came. 1e-6 m of gap: positions are float32. Normals within 1e-5; they are not compared
    within 0.1 mm of the surface, where float32 corners turn them, nor is the choice of who is in contact within 1e-6 m
    of the distance to keep.
    """
    rng, one = np.random.default_rng(0), meshes.posed_body()
    other = meshes.Mesh(one.vertices + np.float32([0.1, 0.0, 0.05]), one.faces)
    both, (starts, face_starts) = meshes.joined(one, other), meshes.offsets(one, other)
    bodies = BodyMeshes(torch.tensor(both.vertices), torch.tensor(both.faces), starts, face_starts)
    owner = np.arange(150) % 3 - 1
    start = one.vertices[rng.integers(0, len(one.vertices), 150)] + (owner == 1)[:, None] * [0.1, 0.0, 0.05]
    end = (start + rng.normal(0, 0.02, (150, 3))).astype(np.float32)
    origin = (end + rng.normal(0.0, 0.08, (150, 3))).astype(np.float32) if remembers else None
    epsilon = np.linspace(0.001, 0.02, 150).astype(np.float32) if each else np.full(150, EPSILON, np.float32)
    frame = ContactFrame(
        bodies,
        torch.tensor(owner, dtype=torch.int32),
        epsilon=torch.tensor(epsilon) if each else EPSILON,
        origin=None if origin is None else torch.tensor(origin),
    )
    found = BodyContacts().find(torch.tensor(end), frame)
    parts = [(mesh.vertices, mesh.faces) for mesh in (one, other)]
    normal, gap, distance = body_contacts(end, parts, owner, epsilon.astype(np.float64), origin)
    mine = found.normal.numpy()
    touching, clear = (normal != 0).any(1), np.abs(distance - epsilon) > 1e-6
    assert np.array_equal((mine != 0).any(1)[clear], touching[clear])
    assert 30 < touching.sum() < 100
    kept = found.distance.numpy()
    missing = kept - (mine * (end - found.anchor.numpy())).sum(1)
    compared = touching & clear & (np.abs(distance) > 1e-4)
    np.testing.assert_allclose(mine[compared], normal[compared], atol=1e-5)
    np.testing.assert_allclose(missing[compared], gap[compared], atol=1e-6)
    assert found.vertex is found.weight is None
    if remembers:
        without = body_contacts(end, parts, owner, epsilon.astype(np.float64))[0]
        assert ((without * normal).sum(1) < 0).sum() > 5  # led back to the other side


def test_refinement_is_finding_and_solving():
    """`refine` and `solve` with a source would give different results. Exact, with a number and a tensor."""
    rest, bodies = meshes.skirt(24, 8, waist=0.17), bodies_of(meshes.icosphere(3, 0.3, (0.05, 0.8, 0.0)))
    vertices, solver = torch.tensor(rest.vertices), solver_for(rest)
    for epsilon in (EPSILON, torch.linspace(0.001, 0.02, len(vertices))):
        expected = solver.refine(vertices, bodies, epsilon=epsilon)
        count = solver.contacts
        found = BodyContacts().find(vertices, ContactFrame(bodies, epsilon=epsilon))
        assert torch.equal(solver.solve(vertices, found), expected)
        assert solver.contacts == count > 10
        assert not torch.equal(expected, vertices)


@pytest.mark.parametrize("each", [False, True])
def test_contacts_with_a_plane_have_the_minimiser_of_a_twin(each):
    """Contacts that are no body's would be solved otherwise: a slanted plane through a skirt, against a direct float64
    solve, to the 0.02 mm that are promised; and gradients pass through the gap, not through the contacts."""
    rest = meshes.skirt(24, 8, waist=0.17)
    normal = np.array([0.6, 0.8, 0.0])
    height = rest.vertices.astype(np.float64) @ normal
    plane = np.quantile(height, 0.3)
    index = np.flatnonzero(height < plane)
    keep = np.linspace(0.0, 0.02, len(height)) if each else np.full(len(height), 0.01)
    anchor = np.tile(plane * normal, (len(index), 1))
    rows = np.tile(normal, (len(index), 1))
    exact = reference.refine(rest.vertices, rest.vertices, rest.faces, index, anchor, rows, keep[index])
    normals = torch.zeros(len(height), 3, dtype=torch.float64)
    normals[index] = torch.tensor(normal)
    anchors = torch.tensor(plane * normal).expand(len(height), 3)
    vertices = torch.tensor(rest.vertices, requires_grad=True)
    contacts = Contacts(normals, anchors, torch.tensor(keep) if each else 0.01)
    result = solver_for(rest).solve(vertices, contacts)
    assert np.abs(exact - rest.vertices).max() > 0.05
    assert np.abs(result.detach().numpy() - exact).max() < TOLERANCE
    along = torch.zeros(len(height), 3)
    along[index] = torch.tensor(normal, dtype=torch.float32)
    (result * along).sum().backward()  # contacts hold the vertices where they are along the normal
    assert (vertices.grad * along).sum().abs() < 0.2 * len(index)


def test_of_several_sources_the_largest_gap_counts():
    """A vertex in a body and below a floor would be pushed out of the one in which it is less deep.

    Against a loop over vertices. A source without contacts, numbers and tensors as distances, gaps of both signs.
    """
    rng, count = np.random.default_rng(0), 60
    vertices = torch.tensor(rng.normal(size=(count, 3)).astype(np.float32))

    def source(distance) -> Contacts:
        normal = rng.normal(size=(count, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal[rng.random(count) < 0.4] = 0.0
        return Contacts(torch.tensor(normal), torch.tensor(rng.normal(size=(count, 3))), distance)

    nobody = Contacts(torch.zeros(count, 3, dtype=torch.float64), torch.full((count, 3), torch.nan).double(), 9.0)
    found = [source(0.1), source(torch.tensor(rng.random(count).astype(np.float32))), nobody]
    assert nearest(found[:1], vertices) is found[0]
    result = nearest(found, vertices)
    gaps = result.distance - (result.normal * (vertices.double() - result.anchor)).sum(1)
    chosen = 0
    for i in range(count):
        touched = [c for c in found if c.normal[i].any()]
        distances = [c.distance if isinstance(c.distance, float) else c.distance[i].item() for c in touched]
        expected = [
            d - (c.normal[i] * (vertices[i].double() - c.anchor[i])).sum().item()
            for d, c in zip(distances, touched, strict=True)
        ]
        assert result.normal[i].any() == bool(touched)
        if touched:
            assert gaps[i].item() == pytest.approx(max(expected), abs=1e-12)
        chosen += len(touched) == 2
    assert chosen > 10


def test_contacts_that_cannot_be_solved_are_refused():
    """Stencils would be ignored, or a kernel read outside of its arrays."""
    rest = meshes.tetrahedron()
    vertices, solver = torch.tensor(rest.vertices), solver_for(rest)
    four = torch.zeros(4, 3, dtype=torch.float64)
    index, weight = torch.zeros(4, 4, dtype=torch.int32), torch.zeros(4, 4, dtype=torch.float64)
    for contacts, error, message in [
        (Contacts(four, four, 0.0, index, weight), ValueError, "`vertex` and `weight` are given"),
        (Contacts(four, four, 0.0, None, weight), ValueError, "one contact for each vertex"),
        (Contacts(four[:3], four[:3], 0.0), ValueError, r"contacts.normal must have shape \[4, 3\]"),
        (Contacts(four, four.float(), 0.0), TypeError, "contacts.anchor must be float64"),
        (Contacts(four, four, torch.zeros(3)), ValueError, r"contacts.distance must have shape \[4\]"),
        (Contacts(four, four, torch.zeros(4, dtype=torch.int32)), TypeError, "contacts.distance must be float64"),
    ]:
        with pytest.raises(error, match=message):
            solver.solve(vertices, contacts)
    with pytest.raises(ValueError, match="tolerance"):
        solver.solve(vertices, Contacts(four, four, 0.0), tolerance=0.0)
    assert torch.equal(solver.solve(vertices, Contacts(four, four, 0.0)), vertices)
