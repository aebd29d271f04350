"""Rollouts of recorded sequences: by a network from recorded frames, and by two baselines without a network.

`predict` starts from the network's whole history of frames, or cold, from a single frame: the recorded frame repeated
on a body that stands still, as in training. The baselines show the benefit of a network.

**Skinned**: the garment moves like skin. For every vertex V, p is the nearest body point in the first frame; the face
that holds p and the `neighbours - 1` faces with the nearest centroids to p carry the vertex. It is bound to each face
at the point p_f of the face that is nearest to V (barycentric), with the offset V - p_f turning with the face (the
polar factor R_f of its deformation gradient since the first frame). The vertex is at the mean of the positions
p_f(t) + R_f(t) (V - p_f), weighted by 1 / (|p - p_f|^2 + s^2), s = 3 cm. In the first frame this is exact.

**Rigid**: every connected component is a rigid body. It takes the rotation and translation that fit best (Kabsch) the
motion of the body vertices nearest to the component's vertices in the first frame.

Neither baseline considers gravity, inertia or collisions, and both start from one recorded frame. Pins have no effect:
the skinned garment is tied to the body everywhere, and the rigid one nowhere.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, cast

import igl
import numpy as np
import torch
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point, points_to_barycentric

from warpgarment.errors import MeshError
from warpgarment.kernels.deformation.gradients import deformation_gradient
from warpgarment.kernels.deformation.replaced import rotation
from warpgarment.kernels.mesh.laplacian import components
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

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


def check_rate(recorded: float, network: float) -> None:
    """Refuses recordings whose frames are at other moments than those that a network predicts.

    Args:
        recorded: Frames per second of the recording.
        network: Frames per second of the network.

    Raises:
        MeshError: They differ.
    """
    if abs(recorded - network) > 1e-6 * network:
        raise MeshError(
            f"the recording runs at {recorded:g} frames a second and the network at {network:g}: bring it to that rate "
            "with Recording.resampled before it is written as a sequence."
        )


class RecordedOutfit(Recorded, Protocol):
    """Several garments, as a `Sequence` of a data set has them."""

    @property
    def layers(self) -> Sequence[Any]:
        """Entries with the range `vertices` of each garment."""

    @property
    def worn(self) -> Sequence[Garment]:
        """The garments."""

    @property
    def materials(self) -> Sequence[Material | None]:
        """Their materials."""

    @property
    def wind(self) -> np.ndarray | None:
        """Velocity of the air in each frame [m/s], [T,3]."""


def predict(
    simulator: Simulator,
    sequence: Recorded,
    newest: int,
    steps: int,
    *,
    cold: bool = False,
    body: BodyMotion | None = None,
    layers: bool = False,
    apart: bool = False,
) -> np.ndarray:
    """Rolls a sequence out from its recorded frames.

    Args:
        simulator: Simulator with the network.
        sequence: Recorded sequence, a `training.data.sequence.Sequence`.
        newest: Index of the newest recorded frame that is an input of the network.
        steps: Number of frames to predict; frame `newest + steps` of the body must exist.
        cold: Whether that frame is the only recorded frame that is an input.
        body: The body of the sequence, `sequence.body()`, if the caller has it already.
        layers: Whether garments are kept from crossing each other and themselves. Each garment of several is an entry
            of its own in any case.
        apart: Whether each garment is alone on a body of its own, so that a network for outfits sees no other garment.

    Returns:
        Vertices of frames newest+1 .. newest+steps [m], float32 [steps,V,3]; NaN after a rollout that failed.

    Raises:
        MeshError: The sequence has another rate than the network, so that its frames are at other moments.
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
    check_rate(body.fps, simulator.network.config.fps)
    part = BodyMotion(body.vertices[first : newest + steps + 1], body.faces, body.fps)
    reads = simulator.network.reads & {"materials", "wind"}
    with warnings.catch_warnings():  # a rollout that fails is visible in the figures
        warnings.simplefilter("ignore", RuntimeWarning)
        worn = getattr(sequence, "layers", ())
        if layers or len(worn) > 1 or (worn and reads):  # each garment by itself
            moved = _outfit(simulator, cast(RecordedOutfit, sequence), part, first, start, known, layers, apart)
        else:
            moved = simulator.rollout(sequence.garment, part, first_vertices=start, history=known).vertices
    predicted = np.full((steps, *sequence.vertices.shape[1:]), np.nan, np.float32)
    moved = np.asarray(moved)[newest + 1 - first :]
    predicted[: len(moved)] = moved
    return predicted


def _outfit(
    simulator: Simulator,
    sequence: RecordedOutfit,
    body: BodyMotion,
    first: int,
    start: np.ndarray | None,
    known: np.ndarray | None,
    layers: bool,
    apart: bool,
) -> np.ndarray:
    """Rolls an outfit out garment by garment, with the materials and the wind that the network reads; the arguments are
    those of `predict`.

    Returns:
        Vertices [m], float32 [T,V,3]; a garment that has stopped is NaN.
    """
    parts = [layer.vertices for layer in sequence.layers]
    reads, wind = simulator.network.reads, sequence.wind
    motions = simulator.rollout(
        list(sequence.worn),
        [BodyMotion(body.vertices, body.faces, body.fps) for _ in parts] if apart else body,
        first_vertices=None if start is None else [start[part] for part in parts],
        history=None if known is None else [known[:, part] for part in parts],
        layers=True if layers else None,
        materials=list(sequence.materials) if "materials" in reads else None,
        wind=wind[first : first + len(body.vertices)] if "wind" in reads and wind is not None else None,
    )
    moved = np.full((body.frames, len(sequence.garment.vertices), 3), np.nan, np.float32)
    for part, motion in zip(parts, motions, strict=True):
        moved[: len(motion.vertices), part] = motion.vertices
    return moved


NEIGHBOURS = 8


SMOOTHING = 0.03  # metres


def skinned(
    garment: Garment, first_vertices: np.ndarray, body: BodyMotion, *, neighbours: int = NEIGHBOURS
) -> np.ndarray:
    """The garment moving like skin.

    Args:
        garment: The garment, which is not read; it makes the arguments those of `rigid`.
        first_vertices: Garment vertices in the body's first frame [m], [V,3].
        body: Body motion, T frames.
        neighbours: Number of body faces that carry each vertex.

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
        garment: Garment whose components move separately.
        first_vertices: Garment vertices in the body's first frame [m], [V,3].
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
        of_component = np.asarray(component) == c
        below = np.unique(nearest[of_component])
        for t in range(body.frames):
            rotation, translation = kabsch(start[below], np.asarray(body.vertices[t], np.float64)[below])
            moved[t, of_component] = first[of_component] @ rotation.T + translation
    moved[0] = first_vertices
    return moved


def kabsch(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rigid motion that minimises sum |R source + s - target|^2 (Kabsch 1976).

    Args:
        source: Points before the motion [m], [N,3].
        target: Points after the motion [m], [N,3].

    Returns:
        Rotation R, [3,3], and translation s [m], [3].
    """
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    rotation = u @ flip @ vt
    return rotation, b - rotation @ a
