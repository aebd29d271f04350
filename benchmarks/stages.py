"""The kernels one by one, on the bundled dress remeshed to a number of faces, against libigl, SciPy and NumPy."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import torch

from warpgarment.kernels import deformation, sdf
from warpgarment.kernels.collision import CollisionSolver
from warpgarment.kernels.features import body_interaction, face_features
from warpgarment.kernels.poisson import PoissonSolver

from .scenes import dressed


def rows(faces: int, device: torch.device, median_ms: Callable) -> Iterator[dict]:
    """One dictionary per stage: faces, stage, ms, and the reference with its time."""
    scene = dressed(faces)
    garment, body, first, second = scene.garment, scene.body, scene.first, scene.second

    def tensor(array, dtype=np.float32):
        return torch.as_tensor(np.ascontiguousarray(array, dtype=dtype), device=device)

    rest, triangles, posed = tensor(garment.vertices), tensor(garment.faces, np.int32), tensor(first)
    inverse = deformation.inverse_rest_frames(rest, triangles)
    count = len(garment.faces)

    def row(stage, call, reference="", reference_call=None):
        entry = {"faces": count, "stage": stage, "ms": median_ms(call, device)}
        if reference_call is not None:
            entry |= {"reference": reference, "reference_ms": median_ms(reference_call, torch.device("cpu"), 3)}
        return entry

    host, rest_host = first.astype(np.float64), garment.vertices.astype(np.float64)
    index = garment.faces.astype(np.int64)

    def numpy_gradient():
        def frames(v):
            a, b = v[index[:, 1]] - v[index[:, 0]], v[index[:, 2]] - v[index[:, 0]]
            n = np.cross(a, b)
            return np.stack([a, b, n / np.linalg.norm(n, axis=1, keepdims=True)], 2)

        return frames(host) @ np.linalg.inv(frames(rest_host))

    phi = deformation.deformation_gradient_from_inverse(inverse, posed, triangles)
    yield row(
        "deformation gradients",
        lambda: deformation.deformation_gradient_from_inverse(inverse, posed, triangles),
        "NumPy",
        numpy_gradient,
    )
    values = deformation.singular_values(phi)
    yield row(
        "replace singular values",
        lambda: deformation.replace_singular_values(phi, values),
        "numpy.linalg.svd",
        lambda: np.linalg.svd(phi.cpu().numpy().astype(np.float64)),
    )

    bodies = sdf.BodyMeshes(tensor(body.vertices[0]), tensor(body.faces, np.int32))
    following = tensor(body.vertices[1])
    centroids = deformation.face_centroids(posed, triangles)
    points = centroids.cpu().numpy().astype(np.float64)
    body_points, body_faces = body.vertices[0].astype(np.float64), body.faces.astype(np.int64)
    yield row(
        "signed distance, refit included",
        lambda: (bodies.update(tensor(body.vertices[0])), bodies.query(centroids)),
        "libigl, fast winding number",
        lambda: igl.signed_distance(
            points, body_points, body_faces, sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        ),
    )
    interaction = body_interaction(centroids, None, bodies, following)
    owner = torch.zeros(count, dtype=torch.int32, device=device)
    mean = centroids.mean(0, keepdim=True)
    yield row("features", lambda: face_features(inverse, posed, triangles, owner, mean, interaction))

    solver = PoissonSolver(rest, triangles)
    target = deformation.deformation_gradient_from_inverse(inverse, tensor(second), triangles)
    centre = deformation.face_centroids(tensor(second), triangles).mean(0, keepdim=True)
    laplacian = -igl.cotmatrix(rest_host, index)
    factor = spl.splu((laplacian + 1e-9 * sp.identity(len(rest_host))).tocsc())
    right = laplacian @ second.astype(np.float64)
    yield row(
        "Poisson solve, warm start",
        lambda: solver.solve(target, centre, initial=posed),
        "SciPy splu, prefactored",
        lambda: factor.solve(right),
    )

    refiner = CollisionSolver(rest, triangles)
    pressed = tensor(scene.pressed)
    base = 0.5 * laplacian.T @ laplacian + 1e-3 * sp.identity(len(rest_host))
    touching = np.asarray(bodies.query(pressed).distance.cpu()) < 0.004
    normals = np.where(touching[:, None], host / np.linalg.norm(host, axis=1, keepdims=True), 0.0)

    def refactored():
        blocks = sp.block_diag([np.outer(n, n) for n in normals], format="csc")
        matrix = (sp.kron(base, sp.identity(3)) + blocks).tocsc()
        return spl.splu(matrix).solve(np.ones(3 * len(rest_host)))

    yield row(
        f"collision refinement, {int(touching.sum())} contacts",
        lambda: refiner.refine(pressed, bodies),
        "SciPy splu, factored every frame",
        refactored,
    )
