"""Limbs as tubes, and which parts of a body they may come too close to.

A limb is a tube around its bone whose radius depends on the place along and around the bone, what it may touch are the
vertices of other parts. A vertex p at height s and angle a of the bone's frame is

    d = |p - axis(s)| - radius(s, a)

away from it. The radius follows the rest pose's vertices within 2 mm, except close to the joints, where skin folds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .anny import RestBody

SHARE = 0.35  # of its distance in the rest pose that a vertex must keep: about a third of the rest pose's opening


@dataclass(frozen=True)
class Tube:
    """A limb segment's surface around its bone.

    Attributes:
        bone: The bone whose head and rotation carry it.
        axes: Columns: two directions across the bone and the one along it, in the rest pose, [3, 3].
        span: Heights between which it is measured [m].
        radius: Over height and angle [m], shape [R, A]; the angle is periodic.
    """

    bone: int
    axes: np.ndarray
    span: tuple[float, float]
    radius: np.ndarray

    def distance(self, points: np.ndarray, head: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Distance of points [F, N, 3] from the surface [m], negative inside, float32 [F, N]."""
        frame = (rotation @ self.axes).astype(np.float32)
        local = (points - head[:, None].astype(np.float32)) @ frame
        low, high = self.span
        height = np.clip(local[..., 2], low, high)
        row = (height - low) / (high - low) * (len(self.radius) - 1)
        angles = self.radius.shape[1]
        column = np.arctan2(local[..., 1], local[..., 0]) * (angles / (2 * np.pi)) % angles
        i, j = np.minimum(row.astype(int), len(self.radius) - 2), column.astype(int) % angles
        u, v, k = row - i, column - np.floor(column), (j + 1) % angles
        r = self.radius
        radius = (1 - u) * ((1 - v) * r[i, j] + v * r[i, k]) + u * ((1 - v) * r[i + 1, j] + v * r[i + 1, k])
        local[..., 2] -= height
        return np.sqrt(np.einsum("fnc,fnc->fn", local, local)) - radius

    def inwards(self, points: np.ndarray, head: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Unit vectors across the bone from points [F, N, 3] to its axis, shape [F, N, 3]."""
        across = rotation @ self.axes[:, :2]
        inwards = -((points - head[:, None]) @ across) @ across.transpose(0, 2, 1)
        return inwards / (np.linalg.norm(inwards, axis=2, keepdims=True) + 1e-12)


@dataclass(frozen=True)
class Contact:
    """A limb that may come too close to other parts, or to the other limb of the pair.

    Attributes:
        limbs: The bones that are turned; a second one is turned the other way by the same angle.
        tubes: The first limb's surface.
        targets: Vertices of the other parts, [N].
        carriers: The bone that moves each of them most, [N].
        normals: Their outward normals in the rest pose, [N, 3], along which the limb moves away, however deep it is;
            None: it moves along its own, for at the groin the trunk's normals point along the thigh.
        required: What they must keep from each tube [m], one [N] a tube.
    """

    limbs: tuple[str, ...]
    tubes: tuple[Tube, ...]
    targets: np.ndarray
    carriers: np.ndarray
    normals: np.ndarray | None
    required: tuple[np.ndarray, ...]


def contacts(body: RestBody, gap: float) -> list[Contact]:
    """What upper arms and legs may touch: thighs the trunk, legs each other, arms all but arms, shins and feet.

    Around a joint, a limb and the trunk always meet, so a vertex that is d0 away in the rest pose must only keep
    min(gap, SHARE * d0), and nothing where it touches there.

    Args:
        body: The body.
        gap: Distance to keep elsewhere [m].
    """
    import igl

    normals = np.asarray(igl.per_vertex_normals(body.vertices, body.faces.astype(np.int64)))
    carriers = body.bone_indices[np.arange(len(body.vertices)), body.bone_weights.argmax(1)]
    found = []

    def add(limbs: tuple[str, ...], tubes: list[Tube], targets: np.ndarray, own_normals: bool = False) -> None:
        targets = np.flatnonzero(targets)
        required = []
        for tube in tubes:
            distance = tube.distance(body.vertices[None, targets], body.joints[None, tube.bone], np.eye(3)[None])[0]
            required.append(np.where(distance > 0, np.minimum(gap, SHARE * distance), -np.inf))
        away = None if own_normals else normals[targets]
        found.append(Contact(limbs, tuple(tubes), targets, carriers[targets], away, tuple(required)))

    arms = body.weight_of("LeftArm", "RightArm")
    legs = body.weight_of("LeftUpLeg", "RightUpLeg")
    trunk = (arms < 0.05) & (legs < 0.05)
    shins = body.weight_of("LeftLeg", "RightLeg")
    for side in ("Left", "Right"):  # the groin folds: skin there is no measure
        add((f"{side}UpLeg",), [fitted_tube(body, f"{side}UpLeg", f"{side}Leg", 0.3)], trunk, own_normals=True)
    thigh, shin = fitted_tube(body, "LeftUpLeg", "LeftLeg"), fitted_tube(body, "LeftLeg", "LeftFoot")
    other = body.weight_of("RightUpLeg") - body.weight_of("RightFoot")
    add(("LeftUpLeg", "RightUpLeg"), [thigh, shin], other > 0.95)
    for side in ("Left", "Right"):
        add((f"{side}Arm",), [fitted_tube(body, f"{side}Arm", f"{side}ForeArm")], (arms < 0.05) & (shins < 0.5))
    return found


def fitted_tube(body: RestBody, name: str, child: str, start: float = 0.15, rows: int = 12, angles: int = 16) -> Tube:
    """The radius around a bone, as a weighted mean of the vertices near each place along and around it.

    It begins a share `start` below the joint, whose own bulge belongs to both parts.
    """
    head, length = body.joint(name), body.joint(child) - body.joint(name)
    size = float(np.linalg.norm(length))
    along = length / size
    across = np.cross(along, np.array([0.0, 0.0, 1.0]))
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(along, across), along], axis=1)
    own = body.weight_of(name) - body.weight_of(child)
    local = (body.vertices[own > 0.5] - head) @ axes
    height, angle = local[:, 2] / size, np.arctan2(local[:, 1], local[:, 0])
    distance = np.hypot(local[:, 0], local[:, 1])
    span = (start, 1.0)
    places = np.linspace(*span, rows)[:, None, None]
    turns = (2 * np.pi / angles * np.arange(angles))[None, :, None]
    apart = np.angle(np.exp(1j * (angle - turns)))
    weight = np.exp(-0.5 * ((height - places) / 0.06) ** 2 - 0.5 * (apart / 0.25) ** 2) + 1e-12
    radius = (weight * distance).sum(2) / weight.sum(2)
    return Tube(body.bone(name), axes, (span[0] * size, span[1] * size), radius.astype(np.float32))


def heads(body: RestBody, transforms: np.ndarray, bone: int) -> np.ndarray:
    """Where a bone's head is in each frame [m], shape [F, 3]."""
    return transforms[:, bone, :, :3] @ body.joints[bone] + transforms[:, bone, :, 3]
