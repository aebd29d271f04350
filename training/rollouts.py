"""Recorded sequences rolled out: by a network from recorded frames, and by two baselines without one.

`predict` starts from as many frames as the network remembers, or cold, from one: the recorded frame repeated on a body
that stands still, which is what the network was trained on. The baselines say what a network is worth.

**Skinned**: the garment is skin. In the first frame every vertex V finds its nearest body point p; the face that
holds p and the `neighbours - 1` faces with the nearest centroids to p carry it. To each it is bound at the face's
point p_f that is nearest to V (barycentric), with the offset V - p_f turning with the face (the polar factor R_f of
its deformation gradient since the first frame). The vertex is the mean of where its faces take it, p_f(t) + R_f(t) (V
- p_f), weighted by 1 / (|p - p_f|^2 + s^2), s = 3 cm. In the first frame this is exact.

**Rigid**: every connected component is a rigid body. It takes the rotation and translation that fit best (Kabsch) the
motion of the body vertices nearest to the component's vertices in the first frame.

Neither looks at gravity, inertia or collisions, and both start from one recorded frame. Pins need no care: the
skinned garment is tied to the body everywhere, and the rigid one nowhere.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Protocol, cast

import igl
import numpy as np
import torch
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point, points_to_barycentric

from warpgarment.kernels.deformation.gradients import deformation_gradient
from warpgarment.kernels.deformation.svd import rotation
from warpgarment.kernels.mesh.laplacian import components
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment

if TYPE_CHECKING:
    from warpgarment.sim.simulator import Simulator


class Recorded(Protocol):
    """A garment and frames of it, float32 [T,V,3] in metres."""

    @property
    def garment(self) -> Garment:
        """The rest mesh."""

    @property
    def vertices(self) -> np.ndarray:
        """The frames."""


class RecordedOnBody(Recorded, Protocol):
    """These and the body, as a `Sequence` of a data set has them."""

    def body(self) -> BodyMotion:
        """The collider."""


def predict(
    simulator: Simulator,
    sequence: Recorded,
    newest: int,
    steps: int,
    *,
    cold: bool = False,
    body: BodyMotion | None = None,
) -> np.ndarray:
    """Rolls a sequence out from its recorded frames.

    Args:
        simulator: A `Simulator`.
        sequence: A `Sequence` of a data set; less will do where `body` is given.
        newest: The newest recorded frame that the network may see.
        steps: Frames to predict; frame `newest + steps` of the body must exist.
        cold: See only that one frame.
        body: `sequence.body()`, where the caller has it already.

    Returns:
        Vertices of frames newest+1 .. newest+steps [m], float32 [steps,V,3]; NaN after a rollout that failed.
    """
    history = simulator.network.config.history
    body = cast(RecordedOnBody, sequence).body() if body is None else body
    start: np.ndarray | None = None
    known: np.ndarray | None = None
    if cold:
        first, start = newest, np.array(sequence.vertices[newest], np.float32)
    elif newest >= history - 1:
        first = newest - history + 1
        known = np.array(sequence.vertices[first : newest + 1], np.float32)
    else:
        raise ValueError(f"a warm start needs {history} recorded frames; up to frame {newest} there are {newest + 1}")
    part = BodyMotion(body.vertices[first : newest + steps + 1], body.faces, body.fps)
    with warnings.catch_warnings():  # a rollout that fails shows in the figures
        warnings.simplefilter("ignore", RuntimeWarning)
        motion = simulator.rollout(sequence.garment, part, first_vertices=start, history=known)
    predicted = np.full((steps, *sequence.vertices.shape[1:]), np.nan, np.float32)
    moved = np.asarray(motion.vertices)[newest + 1 - first :]
    predicted[: len(moved)] = moved
    return predicted


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
    first = np.asarray(first_vertices, np.float64)
    start = np.asarray(body.vertices[0], np.float64)
    faces = np.asarray(body.faces, np.int64)
    _, nearest, point = igl.point_mesh_squared_distance(first, start, faces)
    neighbours = min(neighbours, len(faces))
    _, carriers = cKDTree(start[faces].mean(axis=1)).query(point, k=neighbours)
    carriers = np.reshape(carriers, (len(first), neighbours))
    missing = ~(carriers == nearest[:, None]).any(axis=1)
    carriers[missing, -1] = nearest[missing]  # the face itself always carries

    corners = faces[carriers.ravel()]
    repeated = np.repeat(first, neighbours, axis=0)
    bound = closest_point(start[corners], repeated)
    barycentric = points_to_barycentric(start[corners], bound)
    offset = repeated - bound
    weight = 1.0 / (((bound - np.repeat(point, neighbours, axis=0)) ** 2).sum(-1) + SMOOTHING**2)
    weight = weight.reshape(len(first), neighbours)
    weight /= weight.sum(axis=1, keepdims=True)

    body_faces, rest = torch.as_tensor(np.array(body.faces)), torch.as_tensor(np.array(body.vertices[0]))
    moved = np.empty((body.frames, len(first), 3), np.float32)
    for t in range(body.frames):
        now = np.array(body.vertices[t])
        turn = rotation(deformation_gradient(rest, torch.from_numpy(now), body_faces)).numpy()[carriers.ravel()]
        feet = np.einsum("nk,nki->ni", barycentric, now[corners])
        taken = feet + np.einsum("nij,nj->ni", turn, offset)
        moved[t] = (weight[..., None] * taken.reshape(len(first), neighbours, 3)).sum(axis=1)
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
