"""Float64 NumPy twin of kernels/features/face.py."""

from __future__ import annotations

import numpy as np

from . import deformation


def body_motion(vertices: np.ndarray, next_vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deformation gradients [G, 3, 3] of body faces from one frame to the next, and displacements of their centroids
    [m], [G, 3]."""
    velocity = deformation.face_centroids(next_vertices, faces) - deformation.face_centroids(vertices, faces)
    return deformation.deformation_gradient(vertices, next_vertices, faces), velocity


def face_features(
    rest_vertices, vertices, faces, garment_of_face, garment_mean, closest, sign, body_deformation, body_velocity
):
    """Features [F, 34], computed one by one."""
    phi = deformation.deformation_gradient(rest_vertices, vertices, faces)
    centroid = deformation.face_centroids(vertices, faces)
    to_body = closest.astype(np.float64) - centroid
    distance = np.linalg.norm(to_body, axis=1)
    columns = [
        phi.reshape(-1, 9),
        deformation.face_frames(vertices, faces)[:, :, 2],
        centroid - garment_mean.astype(np.float64)[garment_of_face],
        (sign * distance)[:, None],
        to_body / distance[:, None],
        body_deformation.reshape(-1, 9),
        body_velocity,
        deformation.singular_values(phi),
    ]
    return np.concatenate(columns, axis=1)
