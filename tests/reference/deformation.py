"""Float64 NumPy twins of kernels/deformation/gradients.py and kernels/deformation/svd.py."""

from __future__ import annotations

import numpy as np


def face_frames(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Face frames [F, 3, 3] with columns e1, e2 and the unit normal; the normal of a face without area is zero."""
    corners = vertices.astype(np.float64)[faces]
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([e1, e2, np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)], axis=2)


def face_centroids(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Centroids [F, 3], means of the corners."""
    return vertices.astype(np.float64)[faces].mean(axis=1)


def deformation_gradient(rest_vertices: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Deformation gradients [F, 3, 3] from Φ Q_rest = Q by a linear solve, without an inverse."""
    rest, now = face_frames(rest_vertices, faces), face_frames(vertices, faces)
    return np.linalg.solve(rest.transpose(0, 2, 1), now.transpose(0, 2, 1)).transpose(0, 2, 1)


def relative_deformation_gradient(phi_next: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Relative deformation gradients [F, 3, 3] from Ψ Φ = Φ_next by a linear solve."""
    phi_next, phi = phi_next.astype(np.float64), phi.astype(np.float64)
    return np.linalg.solve(phi.transpose(0, 2, 1), phi_next.transpose(0, 2, 1)).transpose(0, 2, 1)


def singular_values(phi: np.ndarray) -> np.ndarray:
    """Singular values [F, 3] by LAPACK."""
    return np.linalg.svd(phi.astype(np.float64), compute_uv=False)


def replace_singular_values(phi: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Matrices [F, 3, 3] from LAPACK's factors, made proper by reversing the vectors of the smallest singular value."""
    u, _, vt = np.linalg.svd(phi.astype(np.float64))
    u[:, :, 2] *= np.sign(np.linalg.det(u))[:, None]
    vt[:, 2, :] *= np.sign(np.linalg.det(vt))[:, None]
    return u @ (np.abs(s.astype(np.float64))[:, :, None] * vt)


def segment_mean(values: np.ndarray, segment: np.ndarray, count: int) -> np.ndarray:
    """Means [count, K] of the rows of each segment, in one loop."""
    means = np.zeros((count, values.shape[1]))
    for k in range(count):
        if (segment == k).any():
            means[k] = values[segment == k].astype(np.float64).mean(axis=0)
    return means
