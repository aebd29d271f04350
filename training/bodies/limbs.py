"""Limbs as tubes, and the parts of a body to which they may come too close.

A limb is a tube around its bone whose radius depends on the place along and around the bone; it may touch the vertices
of other parts. A vertex p at height s and angle a in the bone's axes is

    d = |p - axis(s)| - radius(s, a)

away from the limb. The radius follows the rest pose's vertices within 2 mm, except near the joints, where skin folds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpgarment.bodies.rest import RestBody

SHARE = 0.35  # share of its distance in the rest pose that a vertex must keep: about a third of the opening there


@dataclass(frozen=True)
class Tube:
    """A limb segment's surface around its bone.

    Attributes:
        bone: Bone whose head and rotation carry the surface.
        axes: Two directions across the bone and the one along it, in the rest pose, as columns, [3, 3].
        span: Lowest and highest place along the bone at which the surface is defined [m].
        radius: Radius as a function of height and angle [m], shape [R, A]; the angle is periodic.
    """

    bone: int
    axes: np.ndarray
    span: tuple[float, float]
    radius: np.ndarray

    def distance(self, points: np.ndarray, head: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Distance of points from the surface.

        Args:
            points: Positions in F frames [m], shape [F, N, 3].
            head: Position of the bone's head [m], shape [F, 3].
            rotation: Rotation of the bone, shape [F, 3, 3].

        Returns:
            Distances [m], negative inside, float32 [F, N].
        """
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
        """Unit vectors across the bone from points to its axis, shape [F, N, 3]; arguments as in :meth:`distance`."""
        across = rotation @ self.axes[:, :2]
        inwards = -((points - head[:, None]) @ across) @ across.transpose(0, 2, 1)
        return inwards / (np.linalg.norm(inwards, axis=2, keepdims=True) + 1e-12)


@dataclass(frozen=True)
class Contact:
    """A limb that may come too close to other parts, or to the other limb of the pair.

    Attributes:
        limbs: Bones that are turned; a second bone is turned by the opposite angle.
        tubes: Surface of the first limb.
        targets: Vertices of the other parts, [N].
        carriers: Bone that moves each target most, [N].
        normals: Outward normals of the targets in the rest pose, [N, 3], along which the limb moves away at any depth.
            None if it moves along its own normals, since at the groin the trunk's normals point along the thigh.
        required: Distance that the targets must keep from each tube [m], one array [N] per tube.
    """

    limbs: tuple[str, ...]
    tubes: tuple[Tube, ...]
    targets: np.ndarray
    carriers: np.ndarray
    normals: np.ndarray | None
    required: tuple[np.ndarray, ...]


def contacts(body: RestBody, gap: float) -> list[Contact]:
    """Contacts of upper arms and legs: thighs with the trunk, legs with each other, arms with all but shins and feet.

    Around a joint, a limb and the trunk always meet, so a vertex at distance d0 in the rest pose must only keep
    min(gap, SHARE * d0), and nothing if it touches in the rest pose.

    Args:
        body: The body.
        gap: Distance to keep away from joints [m].
    """
    import igl

    normals = np.asarray(igl.per_vertex_normals(body.vertices, body.faces.astype(np.int64)))
    carriers = body.bone_indices[np.arange(len(body.vertices)), body.bone_weights.argmax(1)]
    pairs = []

    def add(limbs: tuple[str, ...], tubes: list[Tube], targets: np.ndarray, own_normals: bool = False) -> None:
        targets = np.flatnonzero(targets)
        required = []
        for tube in tubes:
            distance = tube.distance(body.vertices[None, targets], body.joints[None, tube.bone], np.eye(3)[None])[0]
            required.append(np.where(distance > 0, np.minimum(gap, SHARE * distance), -np.inf))
        away = None if own_normals else normals[targets]
        pairs.append(Contact(limbs, tuple(tubes), targets, carriers[targets], away, tuple(required)))

    arms = body.weight_of("LeftArm", "RightArm")
    legs = body.weight_of("LeftUpLeg", "RightUpLeg")
    trunk = (arms < 0.05) & (legs < 0.05)
    shins = body.weight_of("LeftLeg", "RightLeg")
    for side in ("Left", "Right"):  # the skin folds at the groin, so the tube begins lower
        add((f"{side}UpLeg",), [fitted_tube(body, f"{side}UpLeg", f"{side}Leg", 0.3)], trunk, own_normals=True)
    thigh, shin = fitted_tube(body, "LeftUpLeg", "LeftLeg"), fitted_tube(body, "LeftLeg", "LeftFoot")
    other = body.weight_of("RightUpLeg") - body.weight_of("RightFoot")
    add(("LeftUpLeg", "RightUpLeg"), [thigh, shin], other > 0.95)
    for side in ("Left", "Right"):
        add((f"{side}Arm",), [fitted_tube(body, f"{side}Arm", f"{side}ForeArm")], (arms < 0.05) & (shins < 0.5))
    return pairs


def fitted_tube(body: RestBody, name: str, child: str, start: float = 0.15, rows: int = 12, angles: int = 16) -> Tube:
    """A tube around a bone whose radius is a weighted mean over the vertices near each place along and around it.

    Args:
        body: The body.
        name: Name of the bone.
        child: Name of the bone at which the tube ends.
        start: Share of the bone's length at which the tube begins, below the joint, whose bulge belongs to both parts.
        rows: Number of places along the bone.
        angles: Number of places around the bone.
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
    """Position of a bone's head in each frame [m], shape [F, 3]."""
    return transforms[:, bone, :, :3] @ body.joints[bone] + transforms[:, bone, :, 3]
