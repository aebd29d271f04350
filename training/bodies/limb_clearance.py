"""Clearance: limbs turned away from the torso and from each other, so that there is space for clothes between them.

Motion capture, on another body than the actor's, presses upper arms into the chest and thighs into each other; cloth in
between can only be crushed or pushed into the body. D-LAYERS keeps a gap of 4 mm between body parts and discards the
frames where that fails; so does this module, with a gap that the clothes need.

Distances are those of `limbs.py`. A limb that is too close is turned about its joint, in the plane of the limb and the
direction away from the part it touches, by the least angle that suffices; these angles are widened and smoothed in time
so that no frame gets less than it needs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from warpgarment.bodies.rest import RestBody
from warpgarment.bodies.skeleton import PoseSequence, bone_transforms, longest_run
from warpgarment.geometry.skinning import linear_blend_skinning

from .limbs import Contact, contacts, heads

TOLERANCE = 1e-3  # lack of distance that is accepted [m]
_EASE = 0.27  # half the time over which a turn comes and goes [s]
_AHEAD = 0.03  # vertices this much further away count for the direction, too [m]
_CANDIDATES = 12  # number of angles tried per frame, between which is interpolated
_PASSES = 4
_BLOCK = 64  # number of frames measured at once


@dataclass(frozen=True)
class Clearance:
    """Result of :func:`resolve_clearance` for T frames.

    Attributes:
        poses: The motion with limbs turned away; frames without contacts are not changed.
        unresolved: Whether limbs stay closer than the gap, bool [T].
        gap_before: Least distance between parts in the given motion [m], increased near joints by the part of the gap
            that is not required there, shape [T].
        gap_after: Least distance between parts in the new motion [m], measured as `gap_before`, shape [T].
        turned: Largest angle by which a limb was turned [degrees], shape [T].
    """

    poses: PoseSequence
    unresolved: np.ndarray
    gap_before: np.ndarray
    gap_after: np.ndarray
    turned: np.ndarray

    @property
    def longest(self) -> slice:
        """The longest run of resolved frames; empty if there is none."""
        return longest_run(self.unresolved)


def resolve_clearance(body: RestBody, poses: PoseSequence, gap: float = 0.02, limit: float = 40.0) -> Clearance:
    """Turns upper arms and legs away from the torso, the head and each other.

    Forearms and hands are ignored: cloth does not collide with them (:meth:`RestBody.collider_faces`).

    Args:
        body: Body that moves.
        poses: Motion of the body, which is not changed.
        gap: Distance to keep between parts [m]: about twice the thickness of the clothes, and a margin.
        limit: Largest angle by which a limb may be turned in any frame [degrees].

    Returns:
        The new motion and, per frame, whether the gap is kept. Frames in which it is not should be cut out.

    Raises:
        ValueError: There are no frames, or the gap or the limit is not positive.
    """
    if not len(poses) or gap <= 0 or limit <= 0:
        raise ValueError(f"need frames, a positive gap and limit; got {len(poses)} frames, {gap} m, {limit} degrees")
    possible = contacts(body, gap)
    half = max(1, round(_EASE * poses.fps))
    before = _least_gap(body, poses, possible, gap)
    now, after = poses, before
    for _ in range(_PASSES):
        if (after >= gap - TOLERANCE).all():
            break
        for contact in possible:
            now = _turned_away(body, now, contact, poses, np.radians(limit), half)
        after = _least_gap(body, now, possible, gap)
    turned = np.degrees(np.max([_angle(body, poses, now, limb) for c in possible for limb in c.limbs], axis=0))
    unresolved = (after < gap - TOLERANCE) | (turned > limit + 1e-6)
    return Clearance(now, unresolved, before, after, turned)


def _blocks(count: int) -> Iterator[slice]:
    return (slice(k, min(k + _BLOCK, count)) for k in range(0, count, _BLOCK))


def _measured(body: RestBody, poses: PoseSequence, contact: Contact) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Yields blocks of F frames: their slice, posed targets [m], [F, N, 3], and bone transforms, [F, B, 3, 4]."""
    targets = contact.targets
    for block in _blocks(len(poses)):
        transforms = bone_transforms(body, poses[block])
        points = linear_blend_skinning(
            body.vertices[targets], body.bone_indices[targets], body.bone_weights[targets], transforms
        )
        yield block, points, transforms


def _least_gap(body: RestBody, poses: PoseSequence, possible: list[Contact], gap: float) -> np.ndarray:
    """Least distance over all contacts [m], increased near joints by the part of the gap not required, shape [T]."""
    least = np.full(len(poses), np.inf)
    for contact in possible:
        for block, points, transforms in _measured(body, poses, contact):
            short = _shortage(body, contact, points, transforms, None, None)
            least[block] = np.minimum(least[block], gap - short)
    return least


def _shortage(
    body: RestBody,
    contact: Contact,
    points: np.ndarray,
    transforms: np.ndarray,
    turn: np.ndarray | None,
    back: np.ndarray | None,
) -> np.ndarray:
    """Largest lack of distance in each frame [m], shape [F].

    Args:
        body: The body.
        contact: Contact that is measured.
        points: Posed targets [m], shape [F, N, 3].
        transforms: Transforms of the bones, shape [F, B, 3, 4].
        turn: Rotation of the first limb about its joint, shape [F, 3, 3]; None for no rotation.
        back: Rotation of the second limb, which holds the targets, shape [F, 3, 3]; None for no rotation.
    """
    pivot = heads(body, transforms, body.bone(contact.limbs[0]))
    if back is not None:
        other = heads(body, transforms, body.bone(contact.limbs[1]))[:, None]
        points = (points - other) @ back.transpose(0, 2, 1) + other
    short = np.full(len(points), -np.inf)
    for tube, required in zip(contact.tubes, contact.required, strict=True):
        head, rotation = heads(body, transforms, tube.bone), transforms[:, tube.bone, :, :3]
        if turn is not None:
            head, rotation = np.einsum("fij,fj->fi", turn, head - pivot) + pivot, turn @ rotation
        short = np.maximum(short, (required - tube.distance(points, head, rotation)).max(1, initial=-np.inf))
    return short


def _turned_away(
    body: RestBody, poses: PoseSequence, contact: Contact, original: PoseSequence, limit: float, half: int
) -> PoseSequence:
    """The motion with the limbs of a contact turned away where they are too close."""
    short = np.empty(len(poses))
    away = np.empty((len(poses), 3))
    for block, points, transforms in _measured(body, poses, contact):
        short[block] = _shortage(body, contact, points, transforms, None, None)
        away[block] = _direction(body, contact, points, transforms)
    close = short > TOLERANCE / 2
    if not close.any():
        return poses
    bone = body.bone(contact.limbs[0])
    parent = poses.rotations[:, body.bone_parents[bone]]
    away = np.einsum("tji,tj->ti", parent, away)  # in the parent's frame, in which limbs move slowly
    away = np.einsum("tij,tj->ti", parent, _smoothed(away, 2 * half))
    axes = [_axis(body, poses, limb, sign * away) for limb, sign in zip(contact.limbs, (1.0, -1.0), strict=False)]
    left = np.maximum(limit - np.max([_angle(body, original, poses, limb) for limb in contact.limbs], axis=0), 0.0)
    needed = np.zeros(len(poses))
    for block, points, transforms in _measured(body, poses, contact):
        some = np.flatnonzero(close[block])
        if len(some):
            at = np.arange(len(poses))[block][some]
            turns = [axis[at] for axis in axes]
            needed[at] = _least_angle(body, contact, points[some], transforms[some], turns, left[at])
    angle = np.minimum(_smoothed(maximum_filter1d(needed, 2 * half + 1, mode="nearest"), half), left)
    moved = np.flatnonzero(angle > 0)
    rotations = poses.rotations.copy()
    for limb, axis in zip(contact.limbs, axes, strict=True):
        turn = Rotation.from_rotvec(axis[moved] * angle[moved, None]).as_matrix()
        for below in body.chain(limb):
            rotations[moved, below] = turn @ rotations[moved, below]
    return replace(poses, rotations=rotations)


def _direction(body: RestBody, contact: Contact, points: np.ndarray, transforms: np.ndarray) -> np.ndarray:
    """Direction in which a limb should turn, away from vertices that are or nearly are too close, shape [F, 3].

    The vector is the longer, the closer they are.
    """
    total = np.zeros((len(points), 3))
    for tube, required in zip(contact.tubes, contact.required, strict=True):
        head, rotation = heads(body, transforms, tube.bone), transforms[:, tube.bone, :, :3]
        weight = np.maximum(required + _AHEAD - tube.distance(points, head, rotation), 0.0) ** 2
        if contact.normals is None:
            total += np.einsum("fn,fnc->fc", weight, tube.inwards(points, head, rotation))
            continue
        for bone in np.unique(contact.carriers):
            own = contact.carriers == bone
            total += np.einsum("fij,fj->fi", transforms[:, bone, :, :3], weight[:, own] @ contact.normals[own])
    return total


def _axis(body: RestBody, poses: PoseSequence, limb: str, away: np.ndarray) -> np.ndarray:
    """Unit axis about which a limb turns towards a direction, shape [T, 3]; zero where the direction is zero."""
    bone = body.bone(limb)
    child = body.bone_parents.index(bone)
    along = np.einsum("tij,j->ti", poses.rotations[:, bone], body.joints[child] - body.joints[bone])
    axis = np.cross(along, away)
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    return np.divide(axis, length, out=np.zeros_like(axis), where=length > 1e-12)


def _least_angle(
    body: RestBody,
    contact: Contact,
    points: np.ndarray,
    transforms: np.ndarray,
    axes: Sequence[np.ndarray],
    left: np.ndarray,
) -> np.ndarray:
    """Smallest angle up to `left` [rad] that keeps the distance, otherwise the one that comes closest, shape [F]."""
    count = len(points)
    before = np.full(count, np.inf)
    best, angle = before.copy(), np.zeros(count)
    open_ = np.arange(count)
    for share in np.linspace(0.0, 1.0, _CANDIDATES):
        turns = [Rotation.from_rotvec(axis[open_] * (share * left[open_])[:, None]).as_matrix() for axis in axes]
        back = turns[1] if len(turns) > 1 else None
        short = _shortage(body, contact, points[open_], transforms[open_], turns[0], back)
        better = short < best[open_] - TOLERANCE
        best[open_[better]], angle[open_[better]] = short[better], share
        enough = (short <= 0.0) & (share > 0)
        a, b = before[open_[enough]], short[enough]
        angle[open_[enough]] = share - b / np.minimum(b - a, -1e-12) / (_CANDIDATES - 1)
        before[open_] = short
        open_ = open_[~enough]
        if not len(open_):
            break
    return angle * left


def _angle(body: RestBody, before: PoseSequence, after: PoseSequence, limb: str) -> np.ndarray:
    """Angle by which a limb is turned relative to its parent [rad], shape [T]."""
    bone = body.bone(limb)
    parent = body.bone_parents[bone]
    a, b = (p.rotations[:, parent].transpose(0, 2, 1) @ p.rotations[:, bone] for p in (before, after))
    same = (a == b).all((1, 2))
    return np.where(same, 0.0, Rotation.from_matrix(a.transpose(0, 2, 1) @ b).magnitude())


def _smoothed(values: np.ndarray, half: int) -> np.ndarray:
    """Weighted mean over 2 * half + 1 frames with a window that decays to zero; values of zero stay exactly zero."""
    window = np.hanning(2 * half + 3)[1:-1]
    return convolve1d(values, window / window.sum(), axis=0, mode="nearest")
