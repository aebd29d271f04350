"""The Poisson solve against a float64 direct solve, its Laplacian against libigl, its gradients against torch."""

import itertools
import warnings

import igl
import numpy as np
import pytest
import scipy.sparse as sparse
import torch
import warp as wp
from reference import poisson as reference
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels.linear import conjugate_gradients, factor
from warpgarment.kernels.mesh import laplacian
from warpgarment.kernels.poisson.operator import matrix_of
from warpgarment.kernels.poisson.solver import PoissonSolver

GARMENTS = {
    **meshes.garments(),
    "obtuse": meshes.irregular_grid(24, 16, width=0.6, height=0.08),  # most angles far from 60°, some above 150°
    "strip": meshes.irregular_grid(200, 3, width=2.0, height=0.03),  # a band: small energies, large displacements
    "fine": meshes.skirt(40, 24),
    "small": meshes.irregular_grid(5, 4),
}
SOLVERS = {"substitution": {}, "explicit": {"explicit": True}, "iterations": {"factor_budget": 0}}
"""The ways to solve: by a factor as on a CPU, by its inverse as on a GPU, and by conjugate gradients without either."""


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output and work array starts as NaN."""
    return poison_outputs(monkeypatch)


def problem(name: str, scale: float = 1.0, noise: float = 0.05):
    """Rest mesh, deformed vertices, and gradients that are not those of any vertices (smooth ones plus noise)."""
    rest = GARMENTS[name].scaled(scale)
    goal = meshes.moved(rest).vertices.astype(np.float64)
    corners = (rest.vertices[rest.faces], goal[rest.faces])
    frames = [np.stack([v[:, 1] - v[:, 0], v[:, 2] - v[:, 0]], 2) for v in corners]
    normals = [np.cross(f[:, :, 0], f[:, :, 1]) for f in frames]
    full = [
        np.concatenate([f, (n / np.linalg.norm(n, axis=1, keepdims=True))[:, :, None]], 2).astype(np.float64)
        for f, n in zip(frames, normals, strict=True)
    ]
    phi = full[1] @ np.linalg.inv(full[0])
    phi += noise * np.random.default_rng(3).normal(size=phi.shape)
    piece = reference.piece_of(len(rest.vertices), rest.faces)[rest.faces[:, 0]]
    mean = np.stack([goal[rest.faces[piece == c]].mean((0, 1)) for c in range(piece.max() + 1)])
    return rest, goal, phi.astype(np.float32), mean.astype(np.float32)


def solver_for(rest: meshes.Mesh, **options) -> PoissonSolver:
    return PoissonSolver(torch.tensor(rest.vertices), torch.tensor(rest.faces), **options)


def diagonal(rest: meshes.Mesh) -> float:
    return float(np.linalg.norm(np.ptp(rest.vertices.astype(np.float64), axis=0)))


def smallest_diagonal(rest: meshes.Mesh) -> float:
    piece = reference.piece_of(len(rest.vertices), rest.faces)
    return min(float(np.linalg.norm(np.ptp(rest.vertices[piece == c], axis=0))) for c in range(piece.max() + 1))


@pytest.mark.parametrize("name", GARMENTS)
def test_laplacian_is_libigls_with_the_sign_flipped(name):
    """A weight, angle or sign would be wrong. To rounding of the largest weight."""
    rest = GARMENTS[name]
    ours = laplacian.cotangent_laplacian(rest.vertices, rest.faces).toarray()
    theirs = -igl.cotmatrix(rest.vertices.astype(np.float64), rest.faces.astype(np.int64)).toarray()
    np.testing.assert_allclose(ours, theirs, atol=1e-11 * np.abs(theirs).max())
    np.testing.assert_allclose(ours.sum(1), 0.0, atol=1e-11 * np.abs(theirs).max())
    assert np.linalg.eigvalsh(ours)[0] > -1e-10 * np.abs(theirs).max()


def test_components_are_ordered_by_lowest_vertex():
    """Rows of `mean` would belong to the wrong garment.

    Faces in reverse order; vertex 0 and the last one without a face.
    """
    faces = np.array([[7, 8, 9], [5, 2, 1], [3, 4, 6]], np.int32)
    vertex, face, count = laplacian.components(11, faces)
    assert vertex.tolist() == [0, 1, 1, 2, 2, 1, 2, 3, 3, 3, 4]
    assert (face.tolist(), count) == ([3, 1, 2], 5)
    assert vertex.dtype == face.dtype == np.int32


@pytest.mark.parametrize("way", SOLVERS)
@pytest.mark.parametrize("scale", meshes.SCALES)
@pytest.mark.parametrize("name", GARMENTS)
def test_solution_is_the_direct_one(name, scale, way):
    """The right-hand side or factor would be wrong, or the solver would stop early or stagnate.

    1e-5 of the bounding box is promised (of the smallest component's here); float32 output accounts for 2e-7 of it.
    """
    rest, _, phi, mean = problem(name, scale)
    exact = reference.solve(rest.vertices, rest.faces, phi, mean)
    solver = solver_for(rest, **SOLVERS[way])
    wave = np.sin(9.0 * rest.vertices / diagonal(rest))
    guesses = {
        "rest": None,
        "close": exact + 1e-3 * diagonal(rest) * wave,
        "far": 5.0 * diagonal(rest) * wave,
        "exact": exact,
    }
    for guess, initial in guesses.items():
        initial = None if initial is None else torch.tensor(initial, dtype=torch.float32)
        result = solver.solve(torch.tensor(phi), torch.tensor(mean), initial=initial).numpy()
        error = np.abs(result - exact).max() / smallest_diagonal(rest)
        assert error < 1e-5, f"{guess}: {error:.1e} after {solver.iterations} iterations"


@pytest.mark.parametrize("name", GARMENTS)
def test_gradients_of_a_garment_give_it_back(name):
    """Faces or axes would be confused in the same way as in the reference. 1e-5 of the bounding box, as documented."""
    rest, goal, phi, mean = problem(name, noise=0.0)
    result = solver_for(rest).solve(torch.tensor(phi), torch.tensor(mean)).numpy()
    assert np.abs(result - goal).max() < 1e-5 * diagonal(rest)


def test_mean_of_face_centroids_is_set():
    """The mean would be over vertices, or that of another garment. The tolerance is float32 rounding near 3 m."""
    rest, _, phi, mean = problem("two_components")
    mean = mean + np.float32([[1.0, 2.0, 3.0], [-3.0, 0.5, 0.0]])
    result = solver_for(rest).solve(torch.tensor(phi), torch.tensor(mean)).numpy().astype(np.float64)
    piece = reference.piece_of(len(rest.vertices), rest.faces)[rest.faces[:, 0]]
    for c in range(2):
        np.testing.assert_allclose(result[rest.faces[piece == c]].mean((0, 1)), mean[c], atol=2e-7)


@pytest.mark.parametrize("way", SOLVERS)
def test_vertices_without_faces_stay(way):
    """A vertex without faces would become NaN, or move with the mean of another component."""
    rest, _, phi, mean = problem("skirt")
    loose = meshes.Mesh(np.concatenate([[[9, 9, 9]], rest.vertices, [[7, 8, 9]]]).astype(np.float32), rest.faces + 1)
    solver = solver_for(loose, **SOLVERS[way])
    assert solver.component_count == 3
    means = np.concatenate([[[0, 0, 0]], mean, [[0, 0, 0]]]).astype(np.float32)
    initial = torch.tensor(loose.vertices) + 1.0
    result = solver.solve(torch.tensor(phi), torch.tensor(means), initial=initial)
    assert torch.equal(result[[0, -1]], initial[[0, -1]])
    exact = reference.solve(rest.vertices, rest.faces, phi, mean)
    assert np.abs(result[1:-1].numpy() - exact).max() < 1e-5 * diagonal(rest)


def test_no_faces_and_no_vertices():
    """An empty launch would fail instead of returning its input."""
    empty = PoissonSolver(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32))
    assert empty.solve(torch.zeros(0, 3, 3), torch.zeros(0, 3)).shape == (0, 3)
    points = PoissonSolver(torch.ones(2, 3), torch.zeros(0, 3, dtype=torch.int32))
    assert torch.equal(points.solve(torch.zeros(0, 3, 3), torch.zeros(2, 3)), torch.ones(2, 3))
    assert points.iterations == 0


@pytest.mark.parametrize("way", SOLVERS)
@pytest.mark.parametrize("scale", meshes.SCALES)
def test_pins_are_soft_constraints(scale, way):
    """Pins would have another stiffness than documented, or a component would follow both its pins and its mean.

    The skirt is pinned at its waist, at targets that it cannot reach; the sheet is free. 1e-5 of the bounding box.
    """
    rest, goal, phi, mean = problem("two_components", scale)
    pins = np.array([3, 0, 7, 8])
    targets = (goal[pins] + 0.1 * scale * np.random.default_rng(0).normal(size=(4, 3))).astype(np.float32)
    solver = solver_for(rest, pins=torch.tensor(pins), pin_weight=2.0, **SOLVERS[way])
    wrong_mean = mean + np.float32([[50.0, 0, 0], [0, 0, 0]]) * np.float32(scale)
    result = solver.solve(torch.tensor(phi), torch.tensor(wrong_mean), pin_targets=torch.tensor(targets)).numpy()
    exact = reference.solve(rest.vertices, rest.faces, phi, mean, pins, 2.0, targets)
    assert np.abs(result - exact).max() < 1e-5 * smallest_diagonal(rest)


@pytest.mark.parametrize("way", SOLVERS)
def test_packed_batch_is_the_garments_one_by_one(way):
    """Garments of a batch would influence each other. Same arithmetic, so equal to the last bit."""
    names = ["skirt", "tetrahedron", "irregular_grid", "tetrahedron"]
    rests, _, phis, means = zip(*(problem(name) for name in names), strict=True)
    alone = [
        solver_for(rest, **SOLVERS[way]).solve(torch.tensor(phi), torch.tensor(mean))
        for rest, phi, mean in zip(rests, phis, means, strict=True)
    ]
    packed = solver_for(meshes.joined(*rests), **SOLVERS[way]).solve(
        torch.tensor(np.concatenate(phis)), torch.tensor(np.concatenate(means))
    )
    assert torch.equal(packed, torch.cat(alone))


def test_a_good_guess_saves_iterations():
    """The solve would be for the vertices, which stagnates, instead of for the increment."""
    rest, _, phi, mean = problem("fine")
    solver = solver_for(rest, factor_budget=0)
    first = solver.solve(torch.tensor(phi), torch.tensor(mean))
    cold = solver.iterations
    solver.solve(torch.tensor(phi), torch.tensor(mean), initial=first)
    assert solver.iterations <= 2 * conjugate_gradients.WINDOW < cold


@pytest.mark.parametrize("way", SOLVERS)
def test_gradients_are_those_of_a_dense_solve(way):
    """The adjoint would be wrong. Against a dense float64 torch solve with mean and pins; 1e-5 of the largest entry."""
    rest, goal, phi, mean = problem("two_components")
    pins = np.array([0, 5, 9])
    targets = torch.tensor(goal[pins] + 0.05, dtype=torch.float32)
    system, weighted = (torch.tensor(m.toarray()) for m in reference.operators(rest.vertices, rest.faces))
    stiffness = torch.zeros(len(rest.vertices), dtype=torch.float64)
    stiffness[pins] = 10.0 * system.diagonal().mean()
    piece = torch.tensor(reference.piece_of(len(rest.vertices), rest.faces))
    faces = torch.tensor(rest.faces).long()
    own = faces[piece[faces[:, 0]] == 1]
    weights = torch.randn(len(rest.vertices), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def dense(phi, mean, targets):
        free = (piece == 1).double()
        right = weighted @ phi.permute(2, 0, 1).reshape(-1, 3)
        right = right + torch.zeros_like(right).index_add(0, torch.tensor(pins), stiffness[pins, None] * targets)
        # the pseudo-inverse's nullspace is filled by an outer product; the mean is set afterwards
        v = torch.linalg.solve(system + torch.diag(stiffness) + torch.outer(free, free), right)
        return v + free[:, None] * (mean[1] - v[own].mean((0, 1)))

    def gradients(function, dtype):
        arguments = [torch.as_tensor(a).to(dtype).requires_grad_() for a in (phi, mean, targets)]
        result = function(*arguments)
        return result, torch.autograd.grad((result * weights.to(dtype)).sum(), arguments)

    solver = solver_for(rest, pins=pins, **SOLVERS[way])
    ours, our_gradients = gradients(lambda p, m, t: solver.solve(p, m, pin_targets=t), torch.float32)
    theirs, their_gradients = gradients(dense, torch.float64)
    assert (ours - theirs).abs().max() < 1e-5 * diagonal(rest)
    for name, our, their in zip(("phi", "mean", "targets"), our_gradients, their_gradients, strict=True):
        assert (our - their).abs().max() < 1e-5 * their.abs().max(), name


def test_operator_passes_opcheck():
    """torch.compile would fail on the operator: schema, fake tensors, autograd registration."""
    rest, _, phi, mean = problem("tetrahedron")
    solver = solver_for(rest, pins=[1])
    arguments = (torch.tensor(phi).requires_grad_(), torch.tensor(mean).requires_grad_(), torch.ones(1, 3))
    initial = torch.tensor(rest.vertices)
    torch.library.opcheck(torch.ops.warpgarment.poisson_solve, (*arguments, initial, list(solver._model), 100))


@pytest.mark.parametrize("way", SOLVERS)
def test_many_lanes_give_the_same_result(monkeypatch, way):
    """A barrier would be missing or a stride wrong, which one lane cannot show. 256 lanes per block, as on a GPU."""
    rest, _, phi, mean = problem("small" if way == "explicit" else "two_components")  # a block a row takes long
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", False)
    solver = solver_for(rest, pins=[0, 1], **SOLVERS[way])
    pins = torch.tensor(rest.vertices[[0, 1]])
    one = solver.solve(torch.tensor(phi), torch.tensor(mean), pin_targets=pins)
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    many = solver.solve(torch.tensor(phi), torch.tensor(mean), pin_targets=pins)
    np.testing.assert_allclose(many, one, atol=1e-6 * diagonal(rest))  # sums in another order


def test_reaching_the_limit_is_said_once():
    """An iteration would stop unconverged without a warning, or warn in every frame."""
    rest, _, phi, mean = problem("fine")
    solver = solver_for(rest, max_iterations=9, factor_budget=0)
    with pytest.warns(RuntimeWarning, match="raise max_iterations"):
        solver.solve(torch.tensor(phi), torch.tensor(mean))
    assert solver.iterations == 9
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solver.solve(torch.tensor(phi), torch.tensor(mean))


@pytest.mark.parametrize("way", SOLVERS)
def test_not_a_number_ends(way):
    """With NaN in the input, the iteration would never stop, or the result would be finite."""
    rest, _, phi, mean = problem("skirt")
    phi[4] = np.nan
    assert not solver_for(rest, **SOLVERS[way]).solve(torch.tensor(phi), torch.tensor(mean)).isfinite().any()


@pytest.mark.parametrize("way", ["substitution", "explicit"])
def test_budget_of_the_factors_is_kept(way):
    """A batch would allocate without a limit. One of two skirts fits; the result is the same, and equal ones share."""
    first, second = meshes.skirt(24, 8), meshes.skirt(22, 8)
    alone = solver_for(first, **SOLVERS[way])
    entries = sum(_factor(alone)[name].numel() for name in ("value", "row_value"))
    both = meshes.joined(first, second, first)
    solver = solver_for(both, factor_budget=entries, **SOLVERS[way])
    assert sum(_factor(solver)[name].numel() for name in ("value", "row_value")) == entries
    assert _factor(solver)["base"].tolist() == [0, -1, 0]
    phi = torch.eye(3).expand(len(both.faces), 3, 3) * 1.1
    mean = torch.zeros(3, 3)
    expected = solver_for(both, factor_budget=0).solve(phi, mean)
    np.testing.assert_allclose(solver.solve(phi, mean), expected, atol=1e-5 * smallest_diagonal(both))
    assert solver.iterations > 0
    assert alone.solve(phi[: len(first.faces)], mean[:1]).isfinite().all()
    assert alone.iterations == 0


def test_a_factor_that_cannot_be_trusted_is_not_used():
    """Elimination would lose the solution of a nearly singular matrix, and garments fly apart without a warning."""
    rest = meshes.irregular_grid(9, 7)
    matrix = laplacian.cotangent_laplacian(rest.vertices, rest.faces)
    count, largest = len(rest.vertices), matrix.diagonal().max()
    system = conjugate_gradients.System.build(matrix, np.zeros(count, np.int32), 1, "cpu")

    def factored(ground):
        return factor.Factor.build((matrix + ground * sparse.identity(count)).tocsr(), system, explicit=False)

    assert [factored(share * largest).base.tolist() for share in (1e-14, -1e-2, 1e-6)] == [[-1], [-1], [0]]


@pytest.mark.parametrize("flat", [False, True])
def test_factor_is_that_of_the_matrix(flat):
    """An order, pivot or place would be wrong. L D Lᵀ, or the inverse of W, is the permuted matrix to rounding.

    The diagonals of a regular grid weigh nothing, so that entries of its L cancel.
    """
    rest = meshes.irregular_grid(9, 7)
    x, y = np.meshgrid(np.arange(10.0), np.arange(8.0))
    regular = np.stack([x, y, 0.0 * x], 2).reshape(-1, 3)
    matrix = laplacian.cotangent_laplacian(regular if flat else rest.vertices, rest.faces)
    count = len(rest.vertices)
    matrix = (matrix + 0.1 * sparse.identity(count)).tocsr()
    system = conjugate_gradients.System.build(matrix, np.zeros(count, np.int32), 1, "cpu")
    for explicit in (False, True):
        built = factor.Factor.build(matrix, system, explicit=explicit)
        order, places = built.order.numpy(), len(built.order)
        shape = {"shape": (places, places)}
        if explicit:
            inverse = sparse.csc_matrix((built.value, built.column, built.pointer), **shape).toarray()
            rows = sparse.csr_matrix((built.row_value, built.row_column, built.row_pointer), **shape).toarray()
            np.testing.assert_array_equal(rows, inverse)
            lower = np.linalg.inv(inverse + np.eye(places))
        else:
            lower = np.eye(places)
            for panel, (begin, end) in enumerate(itertools.pairwise(built.pointer.tolist())):
                columns = slice(4 * panel, 4 * panel + 4)
                lower[columns, columns] += built.triangle[panel].numpy()
                lower[built.column[begin:end], columns] = built.value.reshape(-1, 4)[begin:end]
        own = order >= 0
        assert sorted(order[own]) == list(range(count))
        permuted = matrix.toarray()[order[own]][:, order[own]]
        product = lower[own][:, own] @ np.diag(1.0 / built.pivot.numpy()[own]) @ lower[own][:, own].T
        np.testing.assert_allclose(product, permuted, atol=1e-12 * np.abs(permuted).max())


def _factor(solver: PoissonSolver) -> dict[str, torch.Tensor]:
    return matrix_of(solver._model).factor._asdict()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"rest_vertices": torch.zeros(4, 2)}, ValueError, "rest_vertices must have shape"),
        ({"rest_vertices": torch.zeros(4, 3, dtype=torch.float64)}, TypeError, "rest_vertices must be float32"),
        ({"faces": torch.zeros(4, 3, dtype=torch.int64)}, TypeError, "faces must be int32"),
        ({"faces": torch.tensor([[0, 1, 9]], dtype=torch.int32)}, ValueError, "indices 0 to 9"),
        ({"faces": torch.tensor([[0, 1, 2], [1, 1, 2]], dtype=torch.int32)}, ValueError, r"1 of 2 .*first: face 1\)"),
        ({"rest_vertices": torch.full((4, 3), torch.nan)}, ValueError, "finite"),
        ({"pins": [0, 0]}, ValueError, "more than once"),
        ({"pins": [4]}, ValueError, "there are 4 vertices"),
        ({"pins": [0.5]}, TypeError, "pins must be integers"),
        ({"pin_weight": 0.0}, ValueError, "pin_weight"),
        ({"max_iterations": 0}, ValueError, "max_iterations"),
    ],
)
def test_bad_meshes_are_refused(change, error, message):
    """A kernel would read outside of its arrays, or divide by an area of zero."""
    rest = meshes.tetrahedron()
    arguments = {"rest_vertices": torch.tensor(rest.vertices), "faces": torch.tensor(rest.faces), **change}
    with pytest.raises(error, match=message):
        PoissonSolver(arguments.pop("rest_vertices"), arguments.pop("faces"), **arguments)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"phi": torch.zeros(3, 3, 3)}, ValueError, "phi must have shape"),
        ({"phi": torch.zeros(4, 3, 3, dtype=torch.float64)}, TypeError, "phi must be float32"),
        ({"mean": torch.zeros(3)}, ValueError, "mean must have shape"),
        ({"initial": torch.zeros(5, 3)}, ValueError, "initial must have shape"),
        ({"pin_targets": torch.zeros(2, 3)}, ValueError, "pin_targets must have shape"),
        ({"pin_targets": None}, ValueError, "pass pin_targets"),
    ],
)
def test_bad_arguments_are_refused(change, error, message):
    """A kernel would read outside of its arrays."""
    arguments = {"phi": torch.zeros(4, 3, 3), "mean": torch.zeros(1, 3), "pin_targets": torch.zeros(1, 3), **change}
    solver = solver_for(meshes.tetrahedron(), pins=[0])
    with pytest.raises(error, match=message):
        solver.solve(arguments.pop("phi"), arguments.pop("mean"), **arguments)
