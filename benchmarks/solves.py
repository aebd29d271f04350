"""Poisson solve and collision refinement, each beside direct solutions in float64."""

from __future__ import annotations

from collections.abc import Iterator

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import torch

from benchmarks.measure import Call, Row, aimed, aimed_time, compared, tensor
from benchmarks.scenes import Dressed
from warpgarment.kernels import deformation
from warpgarment.kernels.collision.body_contacts import contacts
from warpgarment.kernels.collision.solver import CollisionSolver
from warpgarment.kernels.poisson.solver import PoissonSolver
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.objects.garment import Garment
from warpgarment.training.bodies.limb_clearance import TOLERANCE

NOT_INSTALLED = "not installed"
EPSILON = 0.004  # distance kept from the body [m]
PASSES = 4  # number of passes of the refinement, the largest in a frame
SYMMETRIC = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


def poisson(scene: Dressed, device: torch.device, seconds: float) -> Iterator[Row]:
    """Rows on the solve for the next frame from the present one; references get the right-hand side and a factor."""
    garment = scene.garment
    rest, triangles, posed = tensor(garment.vertices, device), tensor(garment.faces, device, np.int32), scene.first
    inverse = deformation.inverse_rest_frames(rest, triangles)
    following = tensor(scene.second, device)
    target = deformation.deformation_gradient_from_inverse(inverse, following, triangles)
    solver = PoissonSolver(rest, triangles)
    centroids = deformation.face_centroids(following, triangles)
    centre = deformation.segment_mean(centroids, solver.face_component, solver.component_count)

    rest_host, index = garment.vertices.astype(np.float64), garment.faces.astype(np.int64)
    matrix = (-igl.cotmatrix(rest_host, index)).tocsc()
    _, first = np.unique(garment.components[0], return_index=True)
    ground = np.zeros(len(rest_host))  # holds one vertex of each component, which fixes its translation
    ground[first] = matrix.diagonal().max()
    matrix = (matrix + sp.diags(ground)).tocsc()
    areas = np.tile(0.5 * igl.doublearea(rest_host, index), 3)
    gradients = target.cpu().numpy().astype(np.float64).transpose(2, 0, 1).reshape(-1, 3)
    right = igl.grad(rest_host, index).T @ (areas[:, None] * gradients)
    factor = spl.splu(matrix, **SYMMETRIC)
    means = centre.cpu().numpy().astype(np.float64)
    exact = _with_means(factor.solve(right), garment, means)

    def off(vertices: np.ndarray) -> float:
        return 1e3 * float(np.linalg.norm(vertices.astype(np.float64) - exact, axis=1).max())

    initial = tensor(posed, device)
    cholespy = _cholespy(matrix, right)
    references: dict[str, Call | str] = {
        "SciPy splu prefactored": lambda: factor.solve(right),
        "CHOLMOD prefactored": _cholmod(matrix, right),
        "cholespy prefactored": cholespy,
    }
    error = off(solver.solve(target, centre, initial=initial).cpu().numpy())
    base = {"part": "stages", "faces": len(index), "what": "Poisson solve", "error_mm": error}
    rows = compared(base, lambda: solver.solve(target, centre, initial=initial), references, device, seconds)
    if not isinstance(cholespy, str):
        next(row for row in rows if row["reference"] == "cholespy prefactored")["reference_error_mm"] = off(
            _with_means(np.asarray(cholespy(), np.float64), garment, means)
        )
    if 8_000 < len(index) < 12_000 and device.type == "cpu":
        rows[0] = aimed_time(rows[0], 1.5, 10_000)
    yield from rows
    check = {"part": "stages", "faces": len(index), "what": "Poisson solve, off the direct solution", "error_mm": error}
    yield aimed(check, "under 0.01 mm", f"{error:.1e} mm", error < 0.01)


def collisions(scene: Dressed, bodies: BodyMeshes, device: torch.device, seconds: float) -> Iterator[Row]:
    """Rows on the refinement of a garment pressed 6 mm into its body; references get the contacts and the matrix."""
    garment = scene.garment
    rest, triangles = tensor(garment.vertices, device), tensor(garment.faces, device, np.int32)
    pressed, refiner = tensor(scene.pressed, device), CollisionSolver(rest, triangles)
    query = bodies.query(pressed, within=EPSILON)
    normal, closest, *_ = contacts(pressed, query.distance, query.face, bodies, EPSILON)
    limit = torch.full((refiner.component_count,), TOLERANCE, dtype=torch.float64, device=device)
    distance = torch.full((1,), EPSILON, dtype=torch.float64, device=device)

    def solve() -> torch.Tensor:
        operator = torch.ops.warpgarment.collision_solve
        return operator(pressed, normal, closest, distance, limit, refiner._model, refiner.max_iterations)[0]

    host, normals = scene.pressed.astype(np.float64), normal.cpu().numpy()
    touching = np.flatnonzero((normals != 0.0).any(axis=1))
    normals = normals[touching]
    columns = (3 * touching[:, None] + np.arange(3)).ravel()
    shape = (len(touching), host.size)
    constraint = sp.csr_matrix((normals.ravel(), (np.repeat(np.arange(len(touching)), 3), columns)), shape=shape)
    gap = EPSILON - (normals * (host[touching] - closest.cpu().numpy()[touching])).sum(axis=1)
    laplacian = igl.cotmatrix(garment.vertices.astype(np.float64), garment.faces.astype(np.int64))
    stiffness = 0.5 * laplacian.T @ laplacian + 1e-3 * sp.identity(len(host))
    matrix = (sp.kron(stiffness, sp.identity(3)) + constraint.T @ constraint).tocsc()
    right = constraint.T @ gap

    exact = host + spl.splu(matrix, **SYMMETRIC).solve(right).reshape(-1, 3)
    error = 1e3 * float(np.linalg.norm(solve().cpu().numpy() - exact, axis=1).max())
    references: dict[str, Call | str] = {
        "SciPy splu every frame": lambda: spl.splu(matrix).solve(right),
        "SciPy splu, symmetric, every frame": lambda: spl.splu(matrix, **SYMMETRIC).solve(right),
        "CHOLMOD every frame": _cholmod_every_frame(matrix, right),
    }
    base = {"part": "stages", "faces": len(garment.faces), "what": "collisions", "error_mm": error}
    count = f"{len(touching)} contacts"
    ours: dict[str, Call] = {
        f"collision solve, {count}": solve,
        f"collisions with their query, {count}": lambda: refiner.refine(pressed, bodies, epsilon=EPSILON),
    }
    for row in compared(base, ours, references, device, seconds):
        reached = f"{row['ratio']:.1f} x" if "ratio" in row else ""
        wanted = device.type == "cpu"
        yield aimed(row, "8 x faster than refactoring", reached, row.get("ratio", 0.0) >= 8.0) if wanted else row
    check = {"part": "stages", "faces": len(garment.faces), "what": "collisions, off the minimiser", "error_mm": error}
    yield aimed(check, "under 0.02 mm", f"{error:.1e} mm", error < 0.02)

    base = {"part": "stages", "faces": len(garment.faces), "what": f"collisions, {PASSES} passes"}
    deepest = -float(bodies.query(refiner.refine(pressed, bodies, epsilon=EPSILON, passes=PASSES)).distance.min())
    calls = {base["what"]: lambda: refiner.refine(pressed, bodies, epsilon=EPSILON, passes=PASSES)}
    for row in compared(base, calls, {}, device, seconds):
        reached = f"deepest {1e3 * deepest:.2f} mm" if deepest > 0.0 else f"nearest {-1e3 * deepest:.2f} mm outside"
        yield aimed(row, "no vertex inside", reached, deepest <= 0.0)


def _with_means(solution: np.ndarray, garment: Garment, means: np.ndarray) -> np.ndarray:
    """Positions [V,3] with each component moved so that the mean of its face centroids is the wanted one, [C,3]."""
    _, of_face, count = garment.components
    centroids, sizes = solution[garment.faces].mean(axis=1), np.bincount(of_face, minlength=count)
    mean = np.stack([np.bincount(of_face, weights=c, minlength=count) for c in centroids.T], axis=1) / sizes[:, None]
    return solution + (means - mean)[garment.components[0]]


def _cholespy(matrix: sp.csc_matrix, right: np.ndarray) -> Call | str:
    try:
        from cholespy import CholeskySolverF, MatrixType
    except ImportError:
        return NOT_INSTALLED
    entries = matrix.tocoo()
    indices = (entries.row.astype(np.int32), entries.col.astype(np.int32))
    solver = CholeskySolverF(matrix.shape[0], *indices, entries.data.astype(np.float64), MatrixType.COO)
    b = np.ascontiguousarray(right, dtype=np.float32)
    x = np.empty_like(b)

    def call() -> np.ndarray:
        solver.solve(b, x)
        return x

    return call


def _cholmod(matrix: sp.csc_matrix, right: np.ndarray) -> Call | str:
    try:
        from sksparse.cholmod import cholesky
    except ImportError:
        return NOT_INSTALLED
    factor = cholesky(matrix)
    return lambda: factor(right)


def _cholmod_every_frame(matrix: sp.csc_matrix, right: np.ndarray) -> Call | str:
    try:
        from sksparse.cholmod import cholesky
    except ImportError:
        return NOT_INSTALLED
    return lambda: cholesky(matrix)(right)
