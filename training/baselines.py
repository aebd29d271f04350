"""Two ways to move a garment without a network, to say what a network is worth.

**Skinned**: the garment is skin. In the first frame every vertex V finds its nearest body point p; the body face f0
that holds it and the `neighbours - 1` faces with the nearest centroids to p carry the vertex, face f with weight w_f
~ 1 / (|p - c_f|^2 + s^2), c_f its centroid, s = 3 cm, sum_f w_f = 1. Each face keeps V in its own orthonormal frame
(origin c_f); the vertex is the weighted mean of where its faces take it. In the first frame this is exact.

**Rigid**: every connected component is a rigid body. It takes the rotation and translation that fit best (Kabsch) the
motion of the body vertices nearest to the component's vertices in the first frame.

Neither looks at gravity, inertia or collisions, and both start from one recorded frame. Pins need no care: the
skinned garment is tied to the body everywhere, and the rigid one nowhere.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from warpgarment.body import BodyMotion
from warpgarment.garment import Garment

NEIGHBOURS = 8
SMOOTHING = 0.03  # metres


def skinned(
    garment: Garment, first_vertices: np.ndarray, body: BodyMotion, *, neighbours: int = NEIGHBOURS
) -> np.ndarray:
    """The garment as skin.

    Args:
        garment: For symmetry with `rigid`; only the positions matter here.
        first_vertices: Garment in the body's first frame [m], [V,3].
        body: Body motion, T frames.
        neighbours: Body faces that carry each vertex.

    Returns:
        Vertices [m], float32 [T,V,3]; frame 0 is `first_vertices`.
    """
    import igl

    first = np.asarray(first_vertices, np.float64)
    start = np.asarray(body.vertices[0], np.float64)
    faces = np.asarray(body.faces, np.int64)
    _, nearest, point = igl.point_mesh_squared_distance(first, start, faces)
    centroid = start[faces].mean(axis=1)
    neighbours = min(neighbours, len(faces))
    _, carriers = cKDTree(centroid).query(point, k=neighbours)
    carriers = carriers.reshape(len(first), neighbours)
    missing = ~(carriers == nearest[:, None]).any(axis=1)
    carriers[missing, -1] = nearest[missing]  # the face itself always carries
    weight = 1.0 / (((point[:, None] - centroid[carriers]) ** 2).sum(-1) + SMOOTHING**2)
    weight /= weight.sum(axis=1, keepdims=True)
    frames, origin = _surface_frames(start, faces)
    local = np.einsum("vkji,vkj->vki", frames[carriers], first[:, None] - origin[carriers])
    moved = np.empty((body.frames, len(first), 3), np.float32)
    for t in range(body.frames):
        frames, origin = _surface_frames(np.asarray(body.vertices[t], np.float64), faces)
        taken = origin[carriers] + np.einsum("vkij,vkj->vki", frames[carriers], local)
        moved[t] = (weight[..., None] * taken).sum(axis=1)
    moved[0] = first_vertices
    return moved


def rigid(garment: Garment, first_vertices: np.ndarray, body: BodyMotion) -> np.ndarray:
    """Every component of the garment as a rigid body that follows the body beneath it.

    Args:
        garment: Whose components move each on their own.
        first_vertices: Garment in the body's first frame [m], [V,3].
        body: Body motion, T frames.

    Returns:
        Vertices [m], float32 [T,V,3]; frame 0 is `first_vertices`.
    """
    from warpgarment.kernels.laplacian import components

    first = np.asarray(first_vertices, np.float64)
    start = np.asarray(body.vertices[0], np.float64)
    component, _, count = components(len(first), garment.faces)
    _, nearest = cKDTree(start).query(first)
    moved = np.empty((body.frames, len(first), 3), np.float32)
    for c in range(count):
        mine = np.asarray(component) == c
        below = np.unique(nearest[mine])
        for t in range(body.frames):
            rotation, translation = kabsch(start[below], np.asarray(body.vertices[t], np.float64)[below])
            moved[t, mine] = first[mine] @ rotation.T + translation
    moved[0] = first_vertices
    return moved


def kabsch(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rotation R and translation s that minimise sum |R source + s - target|^2; [N,3], [N,3] -> [3,3], [3]."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = u @ flip @ vt
    return rotation, b - rotation @ a


def _surface_frames(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal frames (columns: along the first edge, across, normal) and centroids of faces; [G,3,3], [G,3]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    along = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1, keepdims=True), 1e-20)
    return np.stack([along, np.cross(normal, along), normal], axis=-1), (a + b + c) / 3.0
