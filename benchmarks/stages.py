"""The kernels one by one, on the bundled dress remeshed to a number of faces, each against the published way."""

from __future__ import annotations

from collections.abc import Iterator

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import torch

from warpgarment.attention import ManifoldAwareAttention
from warpgarment.batch import PackedGarments, padded_views
from warpgarment.garment import Garment
from warpgarment.kernels import deformation, sdf
from warpgarment.kernels.collision import CollisionSolver
from warpgarment.kernels.features import body_interaction, face_features
from warpgarment.kernels.poisson import PoissonSolver
from warpgarment.network import NetworkConfig

from .measure import Call, Row, compared
from .scenes import dressed

NOT_INSTALLED = "not installed"


def rows(faces: int, device: torch.device, seconds: float) -> Iterator[Row]:
    """Rows of all stages; `seconds` is spent on each call that is timed. References run on the CPU."""
    scene = dressed(faces)
    garment, body, first, second = scene.garment, scene.body, scene.first, scene.second

    def tensor(array, dtype=np.float32):
        return torch.as_tensor(np.ascontiguousarray(array, dtype=dtype), device=device)

    rest, triangles, posed = tensor(garment.vertices), tensor(garment.faces, np.int32), tensor(first)
    inverse = deformation.inverse_rest_frames(rest, triangles)
    count = len(garment.faces)

    def row(stage: str, call: Call, **references: Call | str) -> Iterator[Row]:
        names = {key.replace("_", " "): reference for key, reference in references.items()}
        yield from compared({"part": "stages", "faces": count, "what": stage}, call, names, device, seconds)

    host, rest_host = first.astype(np.float64), garment.vertices.astype(np.float64)
    index = garment.faces.astype(np.int64)

    def numpy_gradient():
        def frames(v):
            a, b = v[index[:, 1]] - v[index[:, 0]], v[index[:, 2]] - v[index[:, 0]]
            n = np.cross(a, b)
            return np.stack([a, b, n / np.linalg.norm(n, axis=1, keepdims=True)], 2)

        return frames(host) @ np.linalg.inv(frames(rest_host))

    phi = deformation.deformation_gradient_from_inverse(inverse, posed, triangles)
    yield from row(
        "deformation gradients",
        lambda: deformation.deformation_gradient_from_inverse(inverse, posed, triangles),
        NumPy=numpy_gradient,
    )
    values = deformation.singular_values(phi)
    yield from row(
        "replace singular values",
        lambda: deformation.replace_singular_values(phi, values),
        NumPy_SVD=lambda: np.linalg.svd(phi.cpu().numpy().astype(np.float64)),
    )

    bodies = sdf.BodyMeshes(tensor(body.vertices[0]), tensor(body.faces, np.int32))
    following = tensor(body.vertices[1])
    centroids = deformation.face_centroids(posed, triangles)
    points = centroids.cpu().numpy().astype(np.float64)
    body_points, body_faces = body.vertices[0].astype(np.float64), body.faces.astype(np.int64)
    yield from row(
        "signed distance, refit included",
        lambda: (bodies.update(tensor(body.vertices[0])), bodies.query(centroids)),
        libigl_fast_winding_number=lambda: igl.signed_distance(
            points, body_points, body_faces, sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        ),
    )
    interaction = body_interaction(centroids, None, bodies, following)
    owner = torch.zeros(count, dtype=torch.int32, device=device)
    mean = centroids.mean(0, keepdim=True)
    yield from row(
        "features other than distance", lambda: face_features(inverse, posed, triangles, owner, mean, interaction)
    )

    solver = PoissonSolver(rest, triangles)
    target = deformation.deformation_gradient_from_inverse(inverse, tensor(second), triangles)
    centre = deformation.face_centroids(tensor(second), triangles).mean(0, keepdim=True)
    laplacian = -igl.cotmatrix(rest_host, index)
    factor = spl.splu((laplacian + 1e-9 * sp.identity(len(rest_host))).tocsc())
    right = laplacian @ second.astype(np.float64)
    yield from row(
        "Poisson solve, warm start",
        lambda: solver.solve(target, centre, initial=posed),
        SciPy_splu_prefactored=lambda: factor.solve(right),
        CHOLMOD_prefactored=_cholmod(laplacian, right),
        cholespy_prefactored=_cholespy(laplacian, right),
    )

    refiner = CollisionSolver(rest, triangles)
    pressed = tensor(scene.pressed)
    base = 0.5 * laplacian.T @ laplacian + 1e-3 * sp.identity(len(rest_host))
    touching = np.asarray(bodies.query(pressed).distance.cpu()) < 0.004
    normals = np.where(touching[:, None], host / np.linalg.norm(host, axis=1, keepdims=True), 0.0)

    blocks = sp.block_diag([np.outer(n, n) for n in normals], format="csc")
    refinement = (sp.kron(base, sp.identity(3)) + blocks).tocsc()  # assembling it is not held against the reference

    def refactored():
        return spl.splu(refinement).solve(np.ones(3 * len(rest_host)))

    yield from row(
        f"collision refinement, {int(touching.sum())} contacts",
        lambda: refiner.refine(pressed, bodies),
        SciPy_splu_factored_every_frame=refactored,
        CHOLMOD_factored_every_frame=_cholmod_every_frame(refinement),
    )
    yield from manifold_heads(garment, device, seconds)


def manifold_heads(garment: Garment, device: torch.device, seconds: float) -> Iterator[Row]:
    """Two manifold heads of `small` in a layer, with its projections, against softmax(-(D/r)^p) V of all pairs."""
    config = NetworkConfig.small()
    head = config.embedding // config.heads
    attention = ManifoldAwareAttention(2 * head, 2, 2, 0.0).to(device).eval()
    packed = PackedGarments.pack([garment], device)
    view = padded_views(packed, [garment], config)[0]
    tokens = torch.randn(1, len(garment.faces), 2 * head, device=device)
    distances = torch.from_numpy(garment.geodesics).to(device)

    @torch.inference_mode()
    def ours() -> object:
        return attention(tokens, view.weights, None)

    @torch.inference_mode()
    def dense() -> object:
        value = torch.nn.functional.linear(tokens, attention.qkv.weight[-2 * head :], attention.qkv.bias[-2 * head :])
        heads = [  # each head its own softmax over all pairs, as attention does it
            torch.softmax(-((distances / config.geodesic_radius) ** config.geodesic_power), dim=-1) @ part
            for part in value[0].split(head, dim=-1)
        ]
        return attention.out(torch.cat(heads, dim=-1))

    base = {"part": "stages", "faces": len(garment.faces), "what": "manifold heads of a layer"}
    yield from compared(base, ours, {"dense softmax": dense}, device, seconds)


def _cholespy(laplacian: sp.csc_matrix, right: np.ndarray) -> Call | str:
    try:
        from cholespy import CholeskySolverF, MatrixType
    except ImportError:
        return NOT_INSTALLED
    matrix = (laplacian + 1e-9 * sp.identity(laplacian.shape[0])).tocoo()
    indices = (matrix.row.astype(np.int32), matrix.col.astype(np.int32))
    solver = CholeskySolverF(matrix.shape[0], *indices, matrix.data.astype(np.float64), MatrixType.COO)
    b = np.ascontiguousarray(right, dtype=np.float32)
    x = np.empty_like(b)
    return lambda: solver.solve(b, x)


def _cholmod(laplacian: sp.csc_matrix, right: np.ndarray) -> Call | str:
    try:
        from sksparse.cholmod import cholesky
    except ImportError:
        return NOT_INSTALLED
    factor = cholesky((laplacian + 1e-9 * sp.identity(laplacian.shape[0])).tocsc())
    return lambda: factor(right)


def _cholmod_every_frame(matrix: sp.csc_matrix) -> Call | str:
    try:
        from sksparse.cholmod import cholesky
    except ImportError:
        return NOT_INSTALLED
    right = np.ones(matrix.shape[0])
    return lambda: cholesky(matrix)(right)
