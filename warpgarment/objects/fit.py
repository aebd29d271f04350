"""Carries a garment from the pose in which it was modelled to the first frame of a motion."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from warpgarment.errors import MeshError
from warpgarment.geometry.checks import checked_faces, checked_positions, to_numpy
from warpgarment.geometry.orientation import turned_outward
from warpgarment.kernels.mesh.laplacian import half_cotangents
from warpgarment.kernels.sdf.bodies import BodyMeshes

from .body import BodyMotion
from .clearance import clearance as least_clearance
from .garment import Garment

NEAREST = 48  # number of body faces whose motions a garment vertex blends
SMOOTHING = 0.08  # radius [m] over which motions are averaged; a larger one drags the garment into a bent body
ATTACHMENT = 0.2  # length [m] over which the garment may drift from its carried position to avoid stretch
CONTACT = 0.002  # length [m] over which a vertex may drift from the position to which a contact pushes it
ROUNDS = 12  # number of local-global rounds
MOST_CLEARANCE = 0.02  # largest clearance of the rest pose that is kept [m]


def fit(garment: Garment, body_rest: Any, body_first: Any, *, epsilon: float | None = 0.004) -> np.ndarray:
    """The garment's vertices in the first frame of a motion, given the body on which it was modelled.

    1. Each garment vertex takes a blend of the rigid motions rest -> first of its nearest body faces, weighted by
       area, closeness and whether they face it; the blends are averaged over the garment's edges, so that neighbours
       between two legs or at an armpit do not tear apart.
    2. As-rigid-as-possible rounds (Sorkine and Alexa 2007, per triangle as Liu et al. 2008) remove the stretch while
       the vertices stay loosely attached to the result of 1, and push out vertices that are closer to the body than
       their clearance.

    A body that only turns and shifts carries the garment along exactly. The clearance of a vertex is half its distance
    at rest, between `epsilon` and 2 cm, so that layers stay in order where there is enough space. Limits: contacts are
    those of vertices, the garment does not collide with itself, and a pose far from the rest pose (arms up, deep squat)
    is better reached by a motion that starts at the rest pose and moves there within a second.

    Args:
        garment: Garment around the rest body.
        body_rest: Body on which the garment was modelled: `(vertices [U,3], faces [G,3])` with positions in metres, or
            a BodyMotion, of which the first frame counts.
        body_first: That body in the first frame of the motion: positions [m], shape [U,3], or as `body_rest`.
        epsilon: Least distance to the body [m]. None: what a simulator keeps by default, 4 mm, or a fifth of the
            garment's mean edge length if that is more.

    Returns:
        Positions [m], float32, shape [V,3].

    Raises:
        MeshError: The two bodies differ in vertices or faces, or one is not a mesh.
    """
    simulated = garment.simulated
    if simulated.garment is not garment:
        return simulated.restored(fit(simulated.garment, body_rest, body_first, epsilon=epsilon))
    epsilon = least_clearance(garment) if epsilon is None else epsilon
    rest, faces = _body(body_rest, None, "body_rest")
    first, _ = _body(body_first, faces, "body_first")
    if first.shape != rest.shape:
        raise MeshError(
            f"body_rest has {len(rest):,} vertices and body_first {len(first):,}. Give one body in two poses."
        )
    points = garment.vertices.astype(np.float64)
    transforms = _smooth(garment, _carry(points, rest.astype(np.float64), first.astype(np.float64), faces))
    carried = np.einsum("vij,vj->vi", transforms[..., :3], points) + transforms[..., 3]
    body = BodyMeshes(torch.from_numpy(rest), torch.from_numpy(faces))
    clearance = np.clip(0.5 * body.query(_tensor(points)).distance.numpy(), epsilon, max(MOST_CLEARANCE, epsilon))
    body.update(torch.from_numpy(first))
    result = _relax(garment, carried, body, clearance.astype(np.float64))
    for _ in range(3):  # pushes out the vertices that the soft contacts left too close
        inside, target = _contacts(result, body, np.full(len(result), float(epsilon)))
        result[inside] = target[inside]
        if not inside.any():
            break
    return result.astype(np.float32)


def _body(body: Any, faces: np.ndarray | None, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a body in its first frame, from any of the forms that `fit` accepts."""
    if isinstance(body, BodyMotion):
        vertices, own = body.vertices[0], body.faces
    elif isinstance(body, tuple) and len(body) == 2:
        vertices = checked_positions(body[0], name=f"{name} vertices")
        own = turned_outward(vertices, checked_faces(body[1], len(vertices), name=f"{name} faces"), name)
    elif faces is None:
        raise MeshError(f"{name} must be (vertices, faces) or a BodyMotion.")
    else:
        return checked_positions(to_numpy(body), name=name), faces
    if faces is not None and (own.shape != faces.shape or (own != faces).any()):
        raise MeshError("body_rest and body_first have different faces. Give one body in two poses.")
    return np.ascontiguousarray(vertices), own


def _frames(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Face frames: columns e1, e2 [m] and the unit normal, shape [F,3,3]; the normal is nan for a face without area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([b - a, c - a, normal], axis=2)


def _rotations(matrices: np.ndarray) -> np.ndarray:
    """Nearest proper rotations, shape [N,3,3]."""
    u, _, v = np.linalg.svd(matrices)
    u[..., 2] *= np.sign(np.linalg.det(u @ v))[..., None]
    return u @ v


def _carry(points: np.ndarray, rest: np.ndarray, first: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Blended rigid motions [A | t] of the nearest body faces for each point, shape [V,3,4]."""
    frame_rest, frame_first = _frames(rest, faces), _frames(first, faces)
    area = 0.5 * np.linalg.norm(np.cross(frame_rest[..., 0], frame_rest[..., 1]), axis=1)
    good = (
        np.isfinite(frame_rest).all(axis=(1, 2))
        & np.isfinite(frame_first).all(axis=(1, 2))
        & (area > 1e-9 * area.max())
    )
    if not good.any():
        raise MeshError("No body face has an area in both poses.")
    faces, area, normal = faces[good], area[good], frame_rest[good][..., 2]
    rotation = _rotations(frame_first[good] @ np.linalg.inv(frame_rest[good]))
    before, after = rest[faces].mean(axis=1), first[faces].mean(axis=1)
    motion = np.concatenate([rotation, (after - np.einsum("fij,fj->fi", rotation, before))[..., None]], axis=2)
    distance, nearest = cKDTree(before).query(points, k=min(NEAREST, len(faces)))
    distance, nearest = distance.reshape(len(points), -1), nearest.reshape(len(points), -1)
    toward = points[:, None] - before[nearest]
    facing = np.einsum("vkc,vkc->vk", toward, normal[nearest]) / np.maximum(distance, 1e-9)
    weight = area[nearest] * (1 - distance / (1.1 * distance[:, -1:] + 1e-12)) ** 2 * (np.maximum(facing, 0) + 0.02)
    weight /= weight.sum(axis=1, keepdims=True)
    rows = np.repeat(np.arange(len(points)), nearest.shape[1])
    blend = csr_matrix((weight.reshape(-1), (rows, nearest.reshape(-1))), shape=(len(points), len(faces)))
    return (blend @ motion.reshape(len(faces), 12)).reshape(-1, 3, 4)


def _smooth(garment: Garment, transforms: np.ndarray) -> np.ndarray:
    """Transforms averaged over the edges; a motion that all vertices share is not changed."""
    i, j = garment.edges.T
    count = len(transforms)
    ones = np.ones(2 * len(i))
    graph = coo_matrix((ones, (np.r_[i, j], np.r_[j, i])), shape=(count, count)).tocsr() + diags(np.ones(count))
    average = diags(1.0 / np.asarray(graph.sum(axis=1)).reshape(-1)) @ graph
    flat = transforms.reshape(count, 12)
    edge = np.linalg.norm(garment.vertices[i] - garment.vertices[j], axis=1).mean()
    for _ in range(int(np.clip((SMOOTHING / edge) ** 2, 1, 100))):  # each pass spreads by about an edge
        flat = average @ flat
    return flat.reshape(count, 3, 4)


def _relax(garment: Garment, carried: np.ndarray, body: BodyMeshes, clearance: np.ndarray) -> np.ndarray:
    """Local-global rounds: min sum_f sum_k w_k |(x_i - x_j) - R_f (p_i - p_j)|^2 + attachments.

    w_k are half the cotangents of a face.
    """
    points, faces = garment.vertices.astype(np.float64), garment.faces
    weights = half_cotangents(garment.vertices, faces)
    i, j = np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)  # the edge opposite to corner k
    edge = points[i] - points[j]
    inverse = np.linalg.inv(_frames(points, faces))
    area = np.bincount(faces.reshape(-1), np.repeat(_areas(points, faces) / 3, 3), minlength=len(points))
    laplacian = garment.laplacian
    x = carried
    for _ in range(ROUNDS):
        rotated = (
            np.einsum("fab,fkb->fka", _rotations(np.nan_to_num(_frames(x, faces)) @ inverse), edge) * weights[..., None]
        )
        pull = np.zeros_like(x)
        np.add.at(pull, i, rotated)
        np.subtract.at(pull, j, rotated)
        inside, target = _contacts(x, body, clearance)
        stiffness = area * np.where(inside, CONTACT**-2, ATTACHMENT**-2)
        goal = np.where(inside[:, None], target, carried)
        x = splu((laplacian + diags(stiffness)).tocsc()).solve(pull + stiffness[:, None] * goal)
    return x


def _areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    frames = _frames(points, faces)
    return 0.5 * np.linalg.norm(np.cross(frames[..., 0], frames[..., 1]), axis=1)


def _contacts(x: np.ndarray, body: BodyMeshes, clearance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that are closer to the body than their clearance, and their positions at that clearance [m]."""
    query = body.query(_tensor(x))
    distance, closest = query.distance.numpy().astype(np.float64), query.closest.numpy().astype(np.float64)
    face = body.faces.numpy()[np.maximum(query.face.numpy(), 0)]
    away = (x - closest) * np.where(distance < 0, -1.0, 1.0)[:, None]
    size = np.linalg.norm(away, axis=1, keepdims=True)
    normal = np.nan_to_num(_frames(body.vertices.numpy().astype(np.float64), face)[..., 2])
    outward = np.where(size > 1e-5, away / np.maximum(size, 1e-12), normal)
    return distance < clearance - 1e-6, closest + clearance[:, None] * outward


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
