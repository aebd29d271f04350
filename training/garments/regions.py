"""The part of a body that a garment covers: fields on the body's shell that are positive inside the garment [m].

Heights (hems, waist) are measured at the garment, necklines and sleeves at the body point below it. Arms are
distinguished from the torso by skinning weight, not by position.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warpgarment.bodies.rest import RestBody

from .pattern import PINNED_NECKLINES, WITH_BODICE, WITH_LEGS, waist
from .shell import Shell

if TYPE_CHECKING:
    from .pattern import Pattern

_FAR = 9.0
_NECK = 0.075  # half of the narrowest neckline [m]
_WAIST_EASE = 0.012
_BAND = 0.08  # height of the part of a skirt that is cut from the body's surface [m]


def ease_field(body: RestBody, pattern: Pattern) -> np.ndarray:
    """Distance between body and garment at each body vertex [m], shape [U]."""
    ease = np.full(len(body.vertices), pattern.ease)
    x, y, _ = body.vertices.T
    for side in ("Left", "Right"):
        share = np.clip(_along_arm(body, body.vertices, side, 2.0), 0.0, 2.0)
        ease += pattern.sleeve_flare * share * _step(body.weight_of(f"{side}Arm"), 0.2, 0.6)
    if pattern.category in WITH_LEGS:
        top, foot = body.joint("LeftUpLeg")[1], body.joint("LeftFoot")[1]
        ease += pattern.leg_flare * np.clip((top - y) / (top - foot), 0.0, 1.0)
        # between the legs the ease is limited, so that a gap remains at the middle plane
        legs = _step(top - y, 0.0, 0.08)
        most = np.maximum(0.6 * np.abs(x), 0.008)
        inside = _step(-np.sign(x) * _normals(body)[:, 0], 0.0, 0.4) * legs
        ease = (1 - inside) * ease + inside * np.minimum(ease, most)
    if pattern.category in ("trousers", "skirt"):  # the waistband sits close
        tight = _step(y, waist(body, pattern) - 0.12, waist(body, pattern) - 0.02)
        ease = (1 - tight) * ease + tight * np.minimum(ease, _WAIST_EASE)
    if pattern.category == "hooded_jacket":
        ease += pattern.hood * _step(body.weight_of("Neck"), 0.1, 0.6)
    return ease


def bottom(body: RestBody, pattern: Pattern) -> float:
    """Height of the lower end of the part that is cut from the body's surface [m]; tubes continue from there."""
    hip = body.joint("LeftUpLeg")[1]
    if pattern.category in WITH_LEGS:
        return float(hip - pattern.leg * (hip - body.joint("LeftFoot")[1]))
    if pattern.category in ("skirt", "dress"):
        return waist(body, pattern) - (_BAND if pattern.category == "skirt" else 0.0)
    return float(hip + 0.02 - min(pattern.hem, 0.0))


def covered(body: RestBody, pattern: Pattern) -> np.ndarray:
    """Mask of the body vertices that the garment may cover, bool [U]; too many of them do no harm."""
    y = body.vertices[:, 1]
    end = "Arm" if pattern.category not in WITH_BODICE else "ForeArm" if pattern.sleeve <= 1.1 else "Hand"
    covered = (y > bottom(body, pattern) - 0.02) & (body.weight_of(f"Left{end}", f"Right{end}") < 0.5)
    if pattern.category not in WITH_BODICE:
        return covered & (y < waist(body, pattern) + 0.02)
    return covered if pattern.category == "hooded_jacket" else covered & (body.weight_of("Neck") < 0.95)


def keep_field(body: RestBody, pattern: Pattern, around: Shell) -> np.ndarray:
    """Field that is positive inside the garment [m], shape [V] for the vertices of the shell."""
    category, y = pattern.category, around.vertices[:, 1]
    arms = around.carried(body.weight_of("LeftArm", "RightArm"))
    on_arm = arms > 0.25
    keep = np.full(len(y), _FAR)
    if category in WITH_BODICE:
        keep = _neckline(body, pattern, around)
        if pattern.neckline not in PINNED_NECKLINES:
            keep = np.minimum(keep, _sleeves(body, pattern, around))
    if category in ("trousers", "skirt"):
        keep = np.minimum(waist(body, pattern) - y, 0.15 * (0.4 - arms))
    return np.minimum(keep, np.where(on_arm, _FAR, y - bottom(body, pattern)))


def _sleeves(body: RestBody, pattern: Pattern, around: Shell) -> np.ndarray:
    """Field that is positive up to the ends of the sleeves [m]."""
    keep = np.full(len(around.skin), _FAR)
    for side in ("Left", "Right"):
        arm = around.carried(body.weight_of(f"{side}Arm")) > 0.25
        along = _along_arm(body, around.vertices, side, pattern.sleeve)
        upper = np.linalg.norm(body.joint(f"{side}ForeArm") - body.joint(f"{side}Arm"))
        keep = np.where(arm, upper * (pattern.sleeve - along), keep)
    return keep


def _along_arm(body: RestBody, points: np.ndarray, side: str, longest: float) -> np.ndarray:
    """Places of points along an arm: 0 at the shoulder, 1 at the elbow, 2 at the wrist; shape [N].

    If `longest` is at most 1, the upper arm's axis alone decides, since in the bend of the elbow the axes of upper arm
    and forearm disagree.
    """
    shoulder, elbow, wrist = (body.joint(side + name) for name in ("Arm", "ForeArm", "Hand"))
    upper, lower = elbow - shoulder, wrist - elbow
    first = (points - shoulder) @ upper / (upper @ upper)
    if longest <= 1.0:
        return first
    second = 1.0 + (points - elbow) @ lower / (lower @ lower)
    bisector = upper / np.linalg.norm(upper) + lower / np.linalg.norm(lower)
    beyond = (points - elbow) @ bisector > 0
    return np.where(beyond, np.maximum(second, 1.0), np.minimum(first, 1.0))


def _neckline(body: RestBody, pattern: Pattern, around: Shell) -> np.ndarray:
    """Field that is positive below the neckline [m]."""
    x, y, z = around.skin.T
    head = around.carried(body.weight_of("Neck"))
    neck, shoulder = body.joint("Neck"), body.joint("LeftArm")
    if pattern.category == "hooded_jacket":
        return _face_opening(body, around)
    if pattern.neckline in PINNED_NECKLINES:
        arms = around.carried(body.weight_of("LeftArm", "RightArm"))
        below = shoulder[1] - 0.11 - pattern.neck - y
        keep = np.minimum(np.where(arms > 0.4, _FAR, below), 0.15 * (0.4 - arms))
        if pattern.neckline == "straps":
            strap = 0.5 * pattern.strap - np.abs(np.abs(x) - 0.58 * shoulder[0] - 0.5 * pattern.neck_width)
            keep = np.maximum(keep, np.minimum.reduce([strap, 0.15 * (0.3 - head), y - (shoulder[1] - 0.3)]))
        return keep
    half = _NECK + pattern.neck_width
    on_top = (np.abs(np.abs(body.vertices[:, 0]) - half) < 0.015) & (body.weight_of("Neck") < 0.3)
    top = body.vertices[on_top, 1].max() if on_top.any() else neck[1]
    power = {"v": 1.0, "round": 2.0, "wide": 4.0}[pattern.neckline]
    front = _step(z, neck[2] - 0.03, neck[2] + 0.05)
    depth = front * (0.02 + pattern.neck) + (1 - front) * (0.004 + 0.2 * pattern.neck)
    return top - depth * (1.0 - (np.abs(x) / half) ** power) - y


def _face_opening(body: RestBody, around: Shell) -> np.ndarray:
    """Field that is positive on torso, neck and head except the face [m]."""
    head = body.vertices[body.weight_of("Head") > 0.7]
    chin, top = head[:, 1].min(), head[:, 1].max()
    _, y, z = around.skin.T
    rim = head[:, 2].min() + 0.62 * np.ptp(head[:, 2])  # in front of the ears
    crown = 0.25 * (y - 0.5 * (chin + top))  # the hood extends further over the forehead
    on_face = 0.3 * (around.carried(body.weight_of("Head")) - 0.3)
    return np.maximum(rim + crown - z, -on_face)


def _step(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def _normals(body: RestBody) -> np.ndarray:
    import igl

    return np.asarray(igl.per_vertex_normals(body.vertices, body.faces.astype(np.int64)))
