"""The collision refinement against a float64 direct solve of all unknowns; its gradients against a dense solve."""

import warnings

import numpy as np
import pytest
import torch
import warp as wp
from reference import collision as reference
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels import collision
from warpgarment.kernels.collision import compliance
from warpgarment.kernels.collision.operator import Model
from warpgarment.kernels.operator import unpack
from warpgarment.kernels.sdf.bodies import BodyMeshes

EPSILON = 0.004
TOLERANCE = 2e-5
"""0.02 mm: what is promised."""
SOLVERS = {
    "wide": {},
    "lanes": {"one_core": False},
    "rows": {"largest_compliance": 0},
    "factor": {"largest_compliance": 0, "row_budget": 0},
    "displacements": {"largest_compliance": 0, "factor_budget": 0},
}
"""The ways to solve: for contact forces through the inverse of B as on a CPU and as on a GPU, through rows of it, or
through a factor of B, and for the displacement by conjugate gradients."""


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output and work array starts as NaN."""
    return poison_outputs(monkeypatch)


def ellipsoid(x: float = 0.05) -> meshes.Mesh:
    """A torso into which the skirts reach by up to some 30 mm on one side.

    It shares no plane of symmetry with them: where two faces are equally close, either is right, and results differ.
    """
    ball = meshes.icosphere(3, 1.0)
    return meshes.Mesh((ball.vertices * [0.19, 0.5, 0.2] + [x, 0.757, 0.013]).astype(np.float32), ball.faces)


def body_of(mesh: meshes.Mesh) -> BodyMeshes:
    return BodyMeshes(torch.tensor(mesh.vertices), torch.tensor(mesh.faces))


def solver_for(rest: meshes.Mesh, **options) -> collision.CollisionSolver:
    return collision.CollisionSolver(torch.tensor(rest.vertices), torch.tensor(rest.faces), **options)


def moved(rest: meshes.Mesh) -> np.ndarray:
    """A deformed garment, whose shape is not that of the rest mesh of the Laplacian."""
    v = rest.vertices.astype(np.float64)
    return (v + 0.01 * np.sin(15.0 * v[:, [1, 2, 0]])).astype(np.float32)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    "rest",
    [
        meshes.skirt(24, 8, waist=0.17),
        meshes.skirt(44, 24, waist=0.17),
        meshes.irregular_grid(20, 16),
        meshes.skirt(60, 6, waist=0.14, hem=0.19),
    ],
    ids=["coarse", "2k faces", "sheet", "mostly inside"],
)
def test_result_is_the_minimiser(rest, solver):
    """The result would not be the minimiser. 0.02 mm, as documented; contacts in float32 account for 0.001 mm."""
    vertices, body = moved(rest), ellipsoid()
    if np.ptp(rest.vertices[:, 2]) == 0:
        vertices = (vertices + np.array([-0.243, 0.55, 0.18])).astype(
            np.float32
        )  # the sheet, hung in front of the belly
    contacts = reference.contacts(vertices, body.vertices, body.faces, EPSILON)
    exact = reference.refine(vertices, rest.vertices, rest.faces, *contacts, EPSILON)
    solver = solver_for(rest, **SOLVERS[solver])
    result = solver.refine(torch.tensor(vertices), body_of(body)).numpy()
    assert solver.contacts == len(contacts[0]) > 20
    assert np.abs(exact - vertices).max() > 0.01
    assert np.abs(result - exact).max() < TOLERANCE, f"{solver.iterations} iterations"


@pytest.mark.parametrize("weights", [(0.5, 1e-3), (2.0, 1e-2), (0.0, 0.1)])
def test_weights_and_epsilon_reach_the_energy(weights):
    """λ_lap, λ_reg or ε would be confused or ignored."""
    rest, body = meshes.skirt(24, 8, waist=0.17), ellipsoid()
    contacts = reference.contacts(rest.vertices, body.vertices, body.faces, 0.01)
    exact = reference.refine(rest.vertices, rest.vertices, rest.faces, *contacts, 0.01, *weights)
    for options in SOLVERS.values():
        solver = solver_for(rest, lambda_lap=weights[0], lambda_reg=weights[1], **options)
        result = solver.refine(torch.tensor(rest.vertices), body_of(body), epsilon=0.01).numpy()
        assert np.abs(result - exact).max() < TOLERANCE


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_distance_for_each_vertex(solver):
    """Coarse and fine garments of a batch would keep the same distance from the body."""
    rest, body = meshes.skirt(24, 8, waist=0.17), ellipsoid()
    vertices = moved(rest)
    epsilon = np.linspace(0.001, 0.015, len(vertices)).astype(np.float32)
    index, closest, normals = reference.contacts(vertices, body.vertices, body.faces, 0.015)
    depth = ((vertices[index] - closest) * normals).sum(1)
    near = depth < epsilon[index]
    assert 5 < near.sum() < len(near)
    index, closest, normals = index[near], closest[near], normals[near]
    exact = reference.refine(vertices, rest.vertices, rest.faces, index, closest, normals, epsilon[index])
    refiner = solver_for(rest, **SOLVERS[solver])
    result = refiner.refine(torch.tensor(vertices), body_of(body), epsilon=torch.tensor(epsilon)).numpy()
    assert np.abs(result - exact).max() < TOLERANCE
    with pytest.raises(ValueError, match="epsilon must have shape"):
        refiner.refine(torch.tensor(vertices), body_of(body), epsilon=torch.zeros(3))


@pytest.mark.parametrize("solver", SOLVERS)
def test_nothing_moves_without_contact(solver):
    """A garment without contacts would move, perhaps with another garment that has contacts. Bit for bit."""
    far = meshes.Mesh(meshes.skirt(24, 8).vertices + np.float32([3.0, 0.0, 0.0]), meshes.skirt(24, 8).faces)
    near = meshes.skirt(24, 8, waist=0.17)
    both = solver_for(meshes.joined(far, near), **SOLVERS[solver])
    vertices = torch.tensor(meshes.joined(far, near).vertices)
    result = both.refine(vertices, body_of(ellipsoid()))
    count = len(far.vertices)
    assert torch.equal(result[:count], vertices[:count])
    assert not torch.equal(result[count:], vertices[count:])
    alone = solver_for(far, **SOLVERS[solver])
    assert torch.equal(alone.refine(vertices[:count], body_of(ellipsoid())), vertices[:count])
    assert (alone.iterations, alone.contacts) == (0, 0)


@pytest.mark.parametrize("one_core", [True, False])
def test_packed_batch_is_the_garments_one_by_one(one_core):
    """Garments of a batch would influence each other, even equal ones that share an inverse, or meet the wrong body.

    The middle one is too large for an inverse. The same to 1e-6 m: sums may run in another order.
    """
    small, large = meshes.skirt(24, 8, waist=0.17), meshes.skirt(30, 12, waist=0.17)
    rests, ellipsoids = [small, large, small], [ellipsoid(), ellipsoid(-0.06), ellipsoid(0.03)]
    options = [{}, {"largest_compliance": 0}, {}]
    alone = [
        solver_for(rest, one_core=one_core, **option).refine(torch.tensor(moved(rest)), body_of(body))
        for rest, body, option in zip(rests, ellipsoids, options, strict=True)
    ]
    vertex_offsets, face_offsets = meshes.offsets(*ellipsoids)
    joined = meshes.joined(*ellipsoids)
    bodies = BodyMeshes(torch.tensor(joined.vertices), torch.tensor(joined.faces), vertex_offsets, face_offsets)
    which = torch.tensor(np.repeat([0, 1, 2], [len(rest.vertices) for rest in rests]).astype(np.int32))
    packed = solver_for(meshes.joined(*rests), largest_compliance=len(small.vertices), one_core=one_core)
    assert inverted(packed) == [0, -1, 0]  # one inverse for the two equal skirts
    vertices = torch.tensor(np.concatenate([moved(rest) for rest in rests]))
    result = packed.refine(vertices, bodies, which)
    np.testing.assert_allclose(result, torch.cat(alone), atol=1e-6)
    assert torch.equal(packed.refine(vertices, bodies, which), result)


def inverted(solver: collision.CollisionSolver) -> list[int]:
    """First entry of the inverse of each component; -1 without one."""
    return unpack(solver._model, Model).dense.base.tolist()


def test_budgets_are_kept():
    """A batch would allocate without a limit. Only the first of two different skirts fits; the result is the same."""
    first, second = meshes.skirt(24, 8, waist=0.17), meshes.skirt(22, 8, waist=0.16)
    both, count = meshes.joined(first, second), len(first.vertices)
    entries = count * (-(-count // 16) * 16)
    expected = solver_for(both).refine(torch.tensor(both.vertices), body_of(ellipsoid()))
    for factors in (2**20, 0):
        solver = solver_for(both, compliance_budget=entries, factor_budget=factors)
        assert inverted(solver) == [0, -1]
        assert len(unpack(solver._model, Model).dense.values) == entries
        result = solver.refine(torch.tensor(both.vertices), body_of(ellipsoid()))
        np.testing.assert_allclose(result, expected, atol=TOLERANCE)


def test_passes_repeat_detection_and_solve():
    """Each pass would solve the first contacts again, or start from the input. Against two calls."""
    rest, bodies = meshes.skirt(24, 8, waist=0.17), body_of(ellipsoid())
    solver = solver_for(rest)
    first = solver.refine(torch.tensor(rest.vertices), bodies)
    iterations = solver.iterations
    second = solver.refine(first, bodies)
    iterations += solver.iterations
    assert torch.equal(solver.refine(torch.tensor(rest.vertices), bodies, passes=2), second)
    assert solver.iterations == iterations
    depth = [-float(bodies.query(v).distance.min()) for v in (torch.tensor(rest.vertices), first, second)]
    assert depth[0] > depth[1] > depth[2]


def test_normals_at_the_surface_are_those_of_the_faces():
    """A vertex on the body would be pushed in a random direction or inwards, or a vertex inside would be pulled deeper.

    A tetrahedron's face as the body: points on it, 2 mm outside and 2 mm inside all have its normal.
    """
    body = meshes.tetrahedron()
    corners = body.vertices[body.faces[1]].astype(np.float64)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    offsets = np.array([0.0, 2e-7, -2e-7, 0.002, -0.002, 0.01])
    points = torch.tensor(corners.mean(0) + offsets[:, None] * normal, dtype=torch.float32)
    bodies = body_of(body)
    query = bodies.query(points)
    normals, closest, *_ = collision.contacts(points, query.distance, query.face, bodies, EPSILON)
    normals, closest = normals.numpy(), closest.numpy()
    np.testing.assert_allclose(normals[:5], np.tile(normal, (5, 1)), atol=1e-6)  # that of the face's float32 corners
    np.testing.assert_allclose(closest[:5], query.closest[:5], atol=1e-7)
    assert not normals[5].any()


def test_single_mesh_spelling_is_the_same():
    """The function `refine` would have other defaults than the solver, or ignore `rest_vertices`."""
    rest, body = meshes.skirt(24, 8, waist=0.17), ellipsoid()
    vertices, faces = torch.tensor(moved(rest)), torch.tensor(rest.faces)
    arguments = (vertices, faces, torch.tensor(body.vertices), torch.tensor(body.faces))
    assert torch.equal(
        collision.refine(*arguments, rest_vertices=torch.tensor(rest.vertices), passes=2),
        solver_for(rest).refine(vertices, body_of(body), passes=2),
    )
    own = solver_for(meshes.Mesh(moved(rest), rest.faces)).refine(vertices, body_of(body))
    assert torch.equal(collision.refine(*arguments), own)


@pytest.mark.parametrize("solver", SOLVERS)
def test_gradient_is_that_of_a_dense_solve(solver):
    """The adjoint would be wrong. The float64 twin is the dense matrix I - A⁻¹ N Nᵀ, for fixed contacts.

    1e-5 of the largest entry; the adjoint is solved to 1e-6.
    """
    rest, body = meshes.skirt(16, 6, waist=0.17), ellipsoid()
    index, _, normals = reference.contacts(rest.vertices, body.vertices, body.faces, EPSILON)
    count = len(rest.vertices)
    constraint = np.zeros((len(index), count, 3))
    constraint[np.arange(len(index)), index] = normals
    constraint = constraint.reshape(len(index), -1)
    base = reference.base(rest.vertices, rest.faces, 0.5, 1e-3).toarray()
    matrix = np.kron(base, np.eye(3)) + constraint.T @ constraint
    jacobian = np.eye(3 * count) - np.linalg.solve(matrix, constraint.T @ constraint)
    weights = np.random.default_rng(0).normal(size=(count, 3)).astype(np.float32)
    expected = (jacobian.T @ weights.ravel().astype(np.float64)).reshape(-1, 3)
    vertices = torch.tensor(rest.vertices, requires_grad=True)
    (solver_for(rest, **SOLVERS[solver]).refine(vertices, body_of(body)) * torch.tensor(weights)).sum().backward()
    assert np.abs(expected - weights).max() > 0.1
    np.testing.assert_allclose(vertices.grad, expected, atol=1e-5 * np.abs(expected).max())


def test_operator_passes_opcheck():
    """torch.compile would fail on the operator: schema, fake tensors, autograd registration."""
    rest, bodies = meshes.skirt(8, 3, waist=0.17), body_of(ellipsoid())
    vertices = torch.tensor(rest.vertices, requires_grad=True)
    query = bodies.query(vertices)
    normals, closest, *_ = collision.contacts(vertices, query.distance, query.face, bodies, EPSILON)
    limit, distance = (torch.full((1,), value, dtype=torch.float64) for value in (1e-6, EPSILON))
    arguments = (vertices, normals, closest, distance, limit, list(solver_for(rest)._model), 100)
    torch.library.opcheck(torch.ops.warpgarment.collision_solve, arguments)


@pytest.mark.parametrize("solver", ["lanes", "displacements"])
def test_many_lanes_give_the_same_result(monkeypatch, solver):
    """A barrier would be missing or a stride wrong, which one lane cannot show. 256 lanes per block, as on a GPU."""
    rest, bodies = meshes.skirt(12, 4, waist=0.17), body_of(ellipsoid())
    solver, vertices = solver_for(rest, **SOLVERS[solver]), torch.tensor(rest.vertices, requires_grad=True)
    query = bodies.query(vertices)
    normals, closest, *_ = collision.contacts(vertices, query.distance, query.face, bodies, EPSILON)
    limit, distance = (torch.full((1,), value, dtype=torch.float64) for value in (1e-6, EPSILON))

    def solve():
        model = solver._model
        result, _, _ = torch.ops.warpgarment.collision_solve(vertices, normals, closest, distance, limit, model, 500)
        return result, *torch.autograd.grad((result**3).sum(), vertices)

    one = solve()
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    for many, single in zip(solve(), one, strict=True):
        np.testing.assert_allclose(many.detach(), single.detach(), atol=2e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_reaching_the_limit_is_said_once(solver):
    """An iteration would stop unconverged without a warning, or warn in every frame."""
    rest, bodies = meshes.skirt(24, 8, waist=0.17), body_of(ellipsoid())
    solver = solver_for(rest, max_iterations=3, **SOLVERS[solver])
    with pytest.warns(RuntimeWarning, match="raise max_iterations"):
        solver.refine(torch.tensor(rest.vertices), bodies)
    assert solver.iterations == 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver.refine(torch.tensor(rest.vertices), bodies)


def test_not_a_number_stays_visible():
    """NaN in the input would become finite numbers in the result."""
    rest = meshes.skirt(24, 8, waist=0.17)
    vertices = torch.tensor(rest.vertices)
    vertices[7, 1] = torch.nan
    result = solver_for(rest).refine(vertices, body_of(ellipsoid()))
    assert result[7, 1].isnan()
    limit, distance = (torch.full((1,), value, dtype=torch.float64) for value in (1e-6, EPSILON))
    normals = torch.zeros(len(vertices), 3, dtype=torch.float64)
    normals[7, 0] = 1.0
    for options in SOLVERS.values():
        model = solver_for(rest, **options)._model
        broken = torch.ops.warpgarment.collision_solve(
            vertices + torch.nan, normals, 0.0 * normals, distance, limit, model, 50
        )
        assert broken[0].isnan().all()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"vertices": torch.zeros(3, 3)}, ValueError, "vertices must have shape"),
        ({"vertices": torch.zeros(4, 3, dtype=torch.float64)}, TypeError, "vertices must be float32"),
        ({"body_of_vertex": torch.zeros(3, dtype=torch.int32)}, ValueError, "body_of_vertex must have shape"),
        ({"body_of_vertex": torch.zeros(4, dtype=torch.int64)}, TypeError, "body_of_vertex must be int32"),
        ({"epsilon": -1.0}, ValueError, "epsilon"),
        ({"epsilon": float("nan")}, ValueError, "epsilon"),
        ({"origin": torch.zeros(3, 3)}, ValueError, "origin must have shape"),
        ({"origin": torch.zeros(4, 3, dtype=torch.float64)}, TypeError, "origin must be float32"),
        ({"tolerance": 0.0}, ValueError, "tolerance"),
        ({"passes": 0}, ValueError, "passes"),
    ],
)
def test_bad_arguments_are_refused(change, error, message):
    """A kernel would read outside of its arrays, or an invalid option would be accepted."""
    rest = meshes.tetrahedron()
    arguments = {"vertices": torch.tensor(rest.vertices), **change}
    with pytest.raises(error, match=message):
        solver_for(rest).refine(arguments.pop("vertices"), body_of(rest), **arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lambda_reg": 0.0}, "lambda_reg"),
        ({"lambda_lap": -1.0}, "lambda_lap"),
        ({"max_iterations": 0}, "max_iterations"),
    ],
)
def test_bad_options_are_refused(options, message):
    """The system would be singular or indefinite, and the iteration would not converge."""
    with pytest.raises(ValueError, match=message):
        solver_for(meshes.tetrahedron(), **options)


def test_largest_compliance_covers_the_benchmarked_garments():
    """The limit would be so low that a garment of 2,000 faces (1,000 vertices) is solved by the slow method."""
    assert compliance.LARGEST >= 1100
