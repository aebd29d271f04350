"""Poses: world rotations of the bones, and the bone transforms that pose a rest body.

A pose is the rotation of each bone from the rest pose, in world axes (`rotations` [T, B, 3, 3], identity at rest), and
the position of the root [m], [T, 3]. All other bones are attached to their parents.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.geometry.skinning import linear_blend_skinning

from .anny import RestBody


@dataclass(frozen=True)
class PoseSequence:
    """Poses of one body over time.

    Attributes:
        rotations: World rotation of each bone from its rest orientation, shape [T, B, 3, 3].
        root: Position of the root bone's head [m], shape [T, 3].
        fps: Frames per second.
    """

    rotations: np.ndarray
    root: np.ndarray
    fps: float = 30.0

    def __len__(self) -> int:
        return len(self.root)

    def __getitem__(self, frames: slice) -> PoseSequence:
        return replace(self, rotations=self.rotations[frames], root=self.root[frames])


def bone_transforms(body: RestBody, poses: PoseSequence) -> np.ndarray:
    """Rest-to-posed transform [R | t] of each bone, t in metres, float32 [T, B, 3, 4]."""
    rotations = poses.rotations
    heads = np.empty((*rotations.shape[:2], 3))
    for bone, parent in enumerate(body.bone_parents):
        if parent < 0:
            heads[:, bone] = poses.root
        else:
            heads[:, bone] = heads[:, parent] + rotations[:, parent] @ (body.joints[bone] - body.joints[parent])
    translation = heads - np.einsum("tbij,bj->tbi", rotations, body.joints)
    return np.concatenate([rotations, translation[..., None]], axis=3).astype(np.float32)


def posed(body: RestBody, poses: PoseSequence) -> tuple[np.ndarray, np.ndarray]:
    """The body in every frame, with its feet on the floor in most frames.

    Returns:
        Vertices [m], float32 [T, U, 3], and the bone transforms from which they result, float32 [T, B, 3, 4].
    """
    transforms = bone_transforms(body, poses)
    frames = linear_blend_skinning(body.vertices, body.bone_indices, body.bone_weights, transforms)
    lift = np.quantile(frames[:, :, 1].min(1), 0.05)
    transforms[:, :, 1, 3] -= lift
    frames[:, :, 1] -= lift
    return frames, transforms


def longest_run(bad: np.ndarray) -> slice:
    """The longest run of frames that are not marked in the mask `bad`, bool [T]; empty if there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], bad, [True]]).astype(int)))
    starts, ends = edges[::2], edges[1::2]
    if not len(starts):
        return slice(0, 0)
    k = int((ends - starts).argmax())
    return slice(int(starts[k]), int(ends[k]))


def heading(rotations: np.ndarray) -> np.ndarray:
    """Angle of the rotation about +Y that is nearest to each rotation [..., 3, 3], [rad], shape [...]."""
    return np.arctan2(rotations[..., 0, 2] - rotations[..., 2, 0], rotations[..., 0, 0] + rotations[..., 2, 2])


def about_y(angle: np.ndarray) -> np.ndarray:
    """Rotations [..., 3, 3] about +Y by the given angles [rad]."""
    return Rotation.from_rotvec(np.asarray(angle)[..., None] * np.array([0.0, 1.0, 0.0])).as_matrix()


def turned(poses: PoseSequence, angle: float) -> PoseSequence:
    """The motion, turned about the vertical through the origin by an angle [rad]."""
    turn = about_y(np.array(angle))
    return replace(poses, rotations=turn @ poses.rotations, root=poses.root @ turn.T)


def facing_forward(poses: PoseSequence) -> PoseSequence:
    """The motion, moved and turned so that it starts above the origin and faces +Z."""
    start = poses.root[0] * np.array([1.0, 0.0, 1.0])
    moved = replace(poses, root=poses.root - start)
    return turned(moved, -float(heading(poses.rotations[0, 0])))


def arms_abducted(body: RestBody, poses: PoseSequence, degrees: float) -> PoseSequence:
    """The motion with the upper arms lifted about the chest's forward axis, so that they do not pinch cloth."""
    rotations = poses.rotations.copy()
    forward = rotations[:, body.bone("Spine1")] @ np.array([0.0, 0.0, 1.0])
    for arm, side in (("LeftArm", 1.0), ("RightArm", -1.0)):
        lift = Rotation.from_rotvec(forward * np.radians(degrees) * side).as_matrix()
        for bone in body.chain(arm):
            rotations[:, bone] = lift @ rotations[:, bone]
    return replace(poses, rotations=rotations)


def blended_in(body: RestBody, poses: PoseSequence, frames: int) -> PoseSequence:
    """Prepends a smooth transition from the rest pose to the first pose, which takes a number of frames.

    Each bone turns relative to its parent; root position and heading are those of the first pose throughout.
    """
    parents = body.bone_parents
    first = poses.rotations[0]
    turn = about_y(heading(first[0]))
    relative = np.stack([turn.T @ first[b] if p < 0 else first[p].T @ first[b] for b, p in enumerate(parents)])
    vectors = Rotation.from_matrix(relative).as_rotvec()
    rest_height = body.joints[0, 1]
    rotations = np.empty((frames, *first.shape))
    root = np.empty((frames, 3))
    for k in range(frames):
        s = k / frames
        s = s * s * (3.0 - 2.0 * s)
        local = Rotation.from_rotvec(vectors * s).as_matrix()
        for b, p in enumerate(parents):
            rotations[k, b] = turn @ local[b] if p < 0 else rotations[k, p] @ local[b]
        root[k] = poses.root[0]
        root[k, 1] = (1 - s) * rest_height + s * poses.root[0, 1]
    return replace(
        poses, rotations=np.concatenate([rotations, poses.rotations]), root=np.concatenate([root, poses.root])
    )


def mirrored(body: RestBody, poses: PoseSequence) -> PoseSequence:
    """The mirror image of the motion: left and right are exchanged about the YZ plane."""
    names = list(body.bone_names)

    def twin(name: str) -> int:
        for a, b in (("Left", "Right"), ("LHip", "RHip"), ("LThumb", "RThumb")):
            if name.startswith(a):
                return names.index(b + name[len(a) :])
            if name.startswith(b):
                return names.index(a + name[len(b) :])
        return names.index(name)

    flip = np.diag([-1.0, 1.0, 1.0])
    order = [twin(name) for name in names]
    return replace(poses, rotations=flip @ poses.rotations[:, order] @ flip, root=poses.root @ flip)
