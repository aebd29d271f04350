"""Float64 NumPy twins of kernels/features/face.py and skin.py, of smooth skin one vertex of a garment at a time."""

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


SPACING, AROUND, BOUND = 0.08, 24, 12


def nearest_rotation(m):
    u, _, v = np.linalg.svd(m)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v


def smooth_skin(vertices, body, poses):
    """R [T,V,3,3] and s [T,V,3] of garments [V,3] that are bound to one body [U,3], in some poses [T,U,3] of it."""
    vertices, body = np.asarray(vertices, float), np.asarray(body, float)
    chosen = [0]
    while True:
        far = np.array([min(np.linalg.norm(p - body[c]) for c in chosen) for p in body])
        if far.max() <= SPACING:
            break
        chosen.append(int(far.argmax()))
    around = [np.argsort(np.linalg.norm(body - body[c], axis=1), kind="stable")[:AROUND] for c in chosen]
    centres = np.array([body[a].mean(0) for a in around])
    turns, places = np.zeros((len(poses), len(vertices), 3, 3)), np.zeros((len(poses), len(vertices), 3))
    for t, pose in enumerate(np.asarray(poses, float)):
        middle = np.array([pose[a].mean(0) for a in around])
        own = [
            nearest_rotation((pose[a] - m).T @ (body[a] - c)) for a, m, c in zip(around, middle, centres, strict=True)
        ]
        for v, x in enumerate(vertices):
            away = np.linalg.norm(centres - x, axis=1)
            near = np.argsort(away, kind="stable")[:BOUND]
            w = (1.0 - (away[near] / (away[near].max() * (1 + 1e-6) + 1e-9)) ** 2) ** 2
            w /= w.sum()
            places[t, v] = sum(a * (middle[j] + own[j] @ (x - centres[j])) for a, j in zip(w, near, strict=True))
            turns[t, v] = nearest_rotation(sum(a * own[j] for a, j in zip(w, near, strict=True)))
    return turns, places
