"""Motions made by formula: walking, running, turning, jumping, bending, lifting the arms.

They need no files, so the demo and users without motion capture can use them. Joint angles are low-order Fourier curves
of the gait phase that resemble normal gait data (hip about +-25 degrees, knee up to 60 in swing); the root's height
follows from the lower foot. These motions move cloth plausibly but do not replace motion capture.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from warpgarment.bodies.rest import RestBody
from warpgarment.bodies.skeleton import PoseSequence, about_y, bone_transforms

KINDS = ("walk", "run", "turn", "jump", "bend", "arms")


def procedural(body: RestBody, kind: str, frames: int, seed: int, fps: float = 30.0) -> PoseSequence:
    """A motion of one of :data:`KINDS`.

    Args:
        body: Body that moves.
        kind: Kind of motion, one of :data:`KINDS`.
        frames: Number of frames.
        seed: Seed from which speed, stride and sway are drawn.
        fps: Frames per second.

    Raises:
        ValueError: The kind is unknown.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown procedural motion {kind!r}; there are {', '.join(KINDS)}")
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    time = np.arange(frames) / fps
    ease = np.clip(time / 0.8, 0, 1)
    ease = ease * ease * (3 - 2 * ease)  # every motion starts from standing
    curves = {"run": _run, "jump": _jump, "bend": _bend, "arms": _arms}.get(kind, _walk)(time, ease, rng)
    if kind == "turn":
        curves["turn_rate"] = ease * rng.choice([-1, 1]) * np.radians(rng.uniform(40, 90))
    elif kind in ("walk", "run"):
        curves["turn_rate"] = ease * np.radians(rng.uniform(-15, 15)) * np.sin(2 * np.pi * 0.15 * time)
    return _assemble(body, curves, fps)


def _walk(time: np.ndarray, ease: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    cadence, stride = rng.uniform(0.8, 1.0), rng.uniform(0.8, 1.15)
    phase = 2 * np.pi * cadence * np.maximum(time - 0.4, 0)
    hip = np.radians(24) * stride * ease
    knee = np.radians(30) * stride * ease
    sides = {"Left": phase, "Right": phase + np.pi}
    curves: dict[str, np.ndarray] = {}
    for side, p in sides.items():
        curves[f"{side}UpLeg"] = -hip * np.cos(p) - 0.08 * ease
        curves[f"{side}Leg"] = knee * (1 - np.cos(p + 0.9)) * 0.5 * (1 + 0.9 * (np.sin(p) < 0) * -np.sin(p)) + 0.06
        curves[f"{side}Foot"] = -0.35 * curves[f"{side}Leg"] + np.radians(6) * ease * np.cos(p)
        curves[f"{side}Arm"] = np.radians(22) * stride * ease * np.cos(p)
        curves[f"{side}ForeArm"] = -np.radians(18) * ease * (1.2 - np.cos(p))
    curves["speed"] = ease * 1.25 * stride * cadence / 0.9
    curves["flight"] = np.zeros_like(time)
    curves["sway"] = 0.02 * ease * np.sin(phase)
    curves["twist"] = np.radians(7) * ease * np.cos(phase)
    curves["roll"] = np.radians(3) * ease * np.sin(phase)
    curves["lean"] = np.radians(3) * ease
    return curves


def _run(time: np.ndarray, ease: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    curves = _walk(time, ease, rng)
    cadence = rng.uniform(1.25, 1.45)
    phase = 2 * np.pi * cadence * np.maximum(time - 0.4, 0)
    for side, p in {"Left": phase, "Right": phase + np.pi}.items():
        swing = np.maximum(-np.sin(p), 0)
        curves[f"{side}UpLeg"] = ease * (-np.radians(34) * np.cos(p) - np.radians(14))
        curves[f"{side}Leg"] = ease * (np.radians(22) + np.radians(62) * swing**1.5) + 0.05
        curves[f"{side}Foot"] = ease * (-np.radians(8) + np.radians(14) * np.cos(p))
        curves[f"{side}Arm"] = ease * np.radians(30) * np.cos(p)
        curves[f"{side}ForeArm"] = -ease * np.radians(75)
    curves |= {
        "speed": ease * rng.uniform(2.2, 3.0), "flight": 0.04 * ease * (0.5 + 0.5 * np.cos(2 * phase)) ** 2,
        "sway": 0.012 * ease * np.sin(phase), "twist": np.radians(10) * ease * np.cos(phase),
        "roll": np.radians(3) * ease * np.sin(phase), "lean": np.radians(9) * ease,
    }  # fmt: skip
    return curves


def _still(time: np.ndarray) -> dict[str, np.ndarray]:
    names = [s + b for s in ("Left", "Right") for b in ("UpLeg", "Leg", "Foot", "Arm", "ForeArm")]
    return {name: np.zeros_like(time) for name in (*names, "speed", "flight", "sway", "twist", "roll", "lean")}


def _jump(time: np.ndarray, ease: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    curves = _still(time)
    period, height = rng.uniform(1.3, 1.8), rng.uniform(0.15, 0.3)
    t = np.maximum(time - 0.5, 0) % period / period
    air = np.clip((t - 0.45) / 0.3, 0, 1)
    crouch = np.where(t < 0.45, np.sin(np.pi * t / 0.45), 0) + np.where(t > 0.75, np.sin(np.pi * (t - 0.75) / 0.25), 0)
    crouch *= ease * rng.uniform(0.6, 0.9)
    for side in ("Left", "Right"):
        curves[f"{side}UpLeg"] = -crouch * np.radians(55)
        curves[f"{side}Leg"] = crouch * np.radians(95)
        curves[f"{side}Foot"] = -crouch * np.radians(40)
        curves[f"{side}Arm"] = crouch * np.radians(35)
    curves["flight"] = ease * 4 * height * air * (1 - air)
    curves["lean"] = crouch * np.radians(25)
    return curves


def _bend(time: np.ndarray, ease: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    curves = _still(time)
    rate, depth = rng.uniform(0.25, 0.45), rng.uniform(25, 50)
    phase = 2 * np.pi * rate * time
    curves["lean"] = ease * np.radians(depth) * 0.5 * (1 - np.cos(phase))
    curves["side_bend"] = ease * np.radians(rng.uniform(8, 20)) * np.sin(phase * 1.7 + 1.0)
    curves["twist"] = ease * np.radians(rng.uniform(10, 30)) * np.sin(phase * 1.3)
    return curves


def _arms(time: np.ndarray, ease: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    curves = _still(time)
    rate = rng.uniform(0.35, 0.6)
    phase = 2 * np.pi * rate * time
    curves["lift"] = ease * np.radians(rng.uniform(35, 60)) * 0.5 * (1 - np.cos(phase))
    curves["twist"] = ease * np.radians(rng.uniform(10, 25)) * np.sin(phase * 0.8)
    curves["sway"] = ease * 0.05 * np.sin(phase * 0.7)
    return curves


def _assemble(body: RestBody, curves: dict[str, np.ndarray], fps: float) -> PoseSequence:
    """World rotations from joint angles about the body's axes (X to its left, Y up, Z forward)."""
    frames = len(curves["lean"])
    zero = np.zeros(frames)

    def axis(x: np.ndarray = zero, y: np.ndarray = zero, z: np.ndarray = zero) -> np.ndarray:
        return Rotation.from_rotvec(np.stack([x + zero, y + zero, z + zero], 1)).as_matrix()

    lean, twist, roll = curves["lean"], curves["twist"], curves["roll"]
    side_bend, lift = curves.get("side_bend", zero), curves.get("lift", zero)
    drop = np.radians(22)  # the rest pose holds the arms out; hang them a little lower
    local = {
        "Hips": axis(y=-0.5 * twist, z=roll),
        "LowerBack": axis(x=0.3 * lean, y=0.4 * twist, z=-0.5 * roll + 0.3 * side_bend),
        "Spine": axis(x=0.3 * lean, y=0.6 * twist, z=-0.5 * roll + 0.4 * side_bend),
        "Spine1": axis(x=0.4 * lean, y=0.5 * twist, z=0.3 * side_bend),
        "Neck": axis(x=-0.3 * lean, y=-0.5 * twist),
    }
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        local[f"{side}UpLeg"] = axis(x=curves[f"{side}UpLeg"])
        local[f"{side}Leg"] = axis(x=curves[f"{side}Leg"])
        local[f"{side}Foot"] = axis(x=curves[f"{side}Foot"])
        local[f"{side}Arm"] = axis(x=curves[f"{side}Arm"]) @ axis(z=sign * (lift - drop))
        local[f"{side}ForeArm"] = axis(x=curves[f"{side}ForeArm"])
    yaw = np.cumsum(curves.get("turn_rate", zero)) / fps
    facing = about_y(yaw)
    rotations = np.empty((frames, len(body.bone_names), 3, 3))
    for bone, (name, parent) in enumerate(zip(body.bone_names, body.bone_parents, strict=True)):
        own = local.get(name, np.eye(3))
        rotations[:, bone] = facing @ own if parent < 0 else rotations[:, parent] @ own
    forward, left = facing[:, :, 2], facing[:, :, 0]
    root = np.cumsum(forward * curves["speed"][:, None], axis=0) / fps + left * curves["sway"][:, None]
    height = _standing(body, rotations, fps) + curves["flight"]
    root[:, 1] = gaussian_filter1d(height, 0.05 * fps, mode="nearest")  # no jolts when feet land, leave or alternate
    return PoseSequence(rotations, root, fps)


def _standing(body: RestBody, rotations: np.ndarray, fps: float) -> np.ndarray:
    """Height of the root at which the lower foot stands on the floor [m], shape [T]."""
    transforms = bone_transforms(body, PoseSequence(rotations, np.zeros((len(rotations), 3)), fps))[:, :, 1]
    feet = []
    for side in ("Left", "Right"):
        sole = body.vertices[body.weight_of(f"{side}Foot") > 0.5]
        foot = transforms[:, body.bone(f"{side}Foot")].astype(np.float64)
        feet.append((foot[:, :3] @ sole.T).min(1) + foot[:, 3])
    return -np.min(feet, axis=0)
