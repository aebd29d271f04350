"""Float64 twin of kernels/collision/solver.py: libigl's Laplacian and distances, a sparse direct solve of 3V
unknowns."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve


def contacts(vertices: np.ndarray, body_vertices: np.ndarray, body_faces: np.ndarray, epsilon: float):
    """Indices of the vertices closer to the body than epsilon [m], closest surface points [m], outward directions."""
    distance, _, closest, _ = igl.signed_distance(
        vertices.astype(np.float64),
        body_vertices.astype(np.float64),
        body_faces.astype(np.int64),
        igl.SIGNED_DISTANCE_TYPE_WINDING_NUMBER,
    )
    index = np.flatnonzero(distance < epsilon)
    away = vertices[index].astype(np.float64) - closest[index]
    return index, closest[index], np.sign(distance[index])[:, None] * away / np.linalg.norm(away, axis=1)[:, None]


def base(rest: np.ndarray, faces: np.ndarray, lambda_lap: float, lambda_reg: float) -> sp.csr_matrix:
    """λ_lap LᵀL + λ_reg I."""
    laplacian = igl.cotmatrix(rest.astype(np.float64), faces.astype(np.int64))
    return (lambda_lap * laplacian.T @ laplacian + lambda_reg * sp.eye(len(rest))).tocsr()


def refine(
    vertices: np.ndarray,
    rest: np.ndarray,
    faces: np.ndarray,
    index: np.ndarray,
    closest: np.ndarray,
    normals: np.ndarray,
    epsilon: float | np.ndarray,
    lambda_lap: float = 0.5,
    lambda_reg: float = 1e-3,
) -> np.ndarray:
    """Minimiser of eq. 5 of the supplement for given contacts [m], [V, 3], solved for V and not for an increment."""
    vertices = vertices.astype(np.float64)
    matrix = base(rest, faces, lambda_lap, lambda_reg)
    rows = np.repeat(np.arange(len(index)), 3)
    columns = (3 * index[:, None] + np.arange(3)).ravel()
    constraint = sp.csr_matrix((normals.ravel(), (rows, columns)), shape=(len(index), vertices.size))
    target = epsilon + (normals * closest).sum(1)
    left = sp.kron(matrix, sp.eye(3)) + constraint.T @ constraint
    right = (matrix @ vertices).ravel() + constraint.T @ target
    return spsolve(left.tocsc(), right).reshape(-1, 3)


def entry(origin: np.ndarray, end: np.ndarray, body_vertices: np.ndarray, body_faces: np.ndarray):
    """First points at which straight paths enter a body [m], [N, 3], and outward normals there, [N, 3].

    They are NaN where a path does not meet the body, or leaves it. Every path is tested against every face, by the
    signed volumes of the tetrahedra that it spans with the face's edges.
    """
    a, b, c = (body_vertices[body_faces[:, k]].astype(np.float64) for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points, outward = np.full(origin.shape, np.nan), np.full(origin.shape, np.nan)
    for i, (o, p) in enumerate(zip(origin.astype(np.float64), end.astype(np.float64), strict=True)):
        along = normals @ (p - o)
        with np.errstate(all="ignore"):
            t = ((a - o) * normals).sum(1) / along
        sides = np.stack([np.cross(x - o, y - o) @ (p - o) for x, y in ((a, b), (b, c), (c, a))])
        met = ((sides > 0).all(0) | (sides < 0).all(0)) & (t >= 0) & (t <= 1)
        if met.any():
            first = np.flatnonzero(met)[np.argmin(t[met])]
            if along[first] < 0:
                points[i], outward[i] = o + t[first] * (p - o), normals[first]
    return points, outward
