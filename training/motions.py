"""Motion clips: the BVH reader, and retargeting to a body by world-space rotations.

Retargeting copies each source bone's rotation from its zero pose, in the world, after turning the zero pose of the
limbs onto the target's rest pose. Root translation is scaled by the ratio of leg lengths, so file units do not matter.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError

from .bodies import RestBody
from .skeleton import PoseSequence

# What the DAZ-friendly CMU release calls the bones of the MotionBuilder-friendly one; None takes the parent's rotation.
_DAZ = {
    "Hips": "hip", "LowerBack": "hip", "Spine": "abdomen", "Spine1": "chest", "Neck": "neck", "Neck1": "neck",
    "Head": "head",
    "LeftUpLeg": "lThigh", "LeftLeg": "lShin", "LeftFoot": "lFoot",
    "RightUpLeg": "rThigh", "RightLeg": "rShin", "RightFoot": "rFoot",
    "LeftShoulder": "lCollar", "LeftArm": "lShldr", "LeftForeArm": "lForeArm", "LeftHand": "lHand",
    "RightShoulder": "rCollar", "RightArm": "rShldr", "RightForeArm": "rForeArm", "RightHand": "rHand",
}  # fmt: skip
_LIMBS = {
    "LeftUpLeg": "LeftLeg", "LeftLeg": "LeftFoot", "RightUpLeg": "RightLeg", "RightLeg": "RightFoot",
    "LeftArm": "LeftForeArm", "LeftForeArm": "LeftHand", "RightArm": "RightForeArm", "RightForeArm": "RightHand",
}  # fmt: skip
_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True)
class Clip:
    """A motion on its own skeleton, Y up, in the file's units.

    Attributes:
        names: Joint names, root first.
        offsets: Offset of each joint from its parent in the zero pose, shape [J, 3].
        rotations: World rotation of each joint, shape [T, J, 3, 3].
        root: Position of the root, shape [T, 3].
        fps: Frames per second.
    """

    names: tuple[str, ...]
    offsets: np.ndarray
    rotations: np.ndarray
    root: np.ndarray
    fps: float


def read_bvh(path: str | Path) -> Clip:
    """Reads a BVH file; a Z-up file (the mean head is above the hips along Z) is turned Y up.

    Raises:
        MeshError: The file is not BVH, or its numbers do not match its hierarchy.
    """
    path = Path(path)
    tokens = path.read_text(errors="replace").split()
    if not tokens or tokens[0] != "HIERARCHY" or "MOTION" not in tokens:
        raise MeshError(f"{path.name} is not a BVH file: it has no HIERARCHY and MOTION sections.")
    motion = tokens.index("MOTION")
    names, parents, offsets, channels = _hierarchy(tokens[1:motion])
    try:
        frames, frame_time = int(tokens[motion + 2]), float(tokens[motion + 5])
        values = np.array(tokens[motion + 6 :], dtype=np.float64)
    except (ValueError, IndexError) as error:
        raise MeshError(f"{path.name}: the MOTION section holds something that is not a number.") from error
    width = sum(map(len, channels))
    if len(values) != frames * width or frames == 0 or frame_time <= 0:
        raise MeshError(f"{path.name}: {frames:,} frames of {width} channels announced, {len(values):,} numbers found.")
    rotations, positions = _forward(parents, offsets, channels, values.reshape(frames, width))
    head = next((i for i, n in enumerate(names) if n.lower() == "head"), len(names) - 1)
    up = int(np.abs((positions[:, head] - positions[:, 0]).mean(0)).argmax())
    turn = _Z_UP_TO_Y_UP if up == 2 else np.eye(3)
    return Clip(
        names=tuple(names),
        offsets=offsets @ turn.T,
        rotations=turn @ rotations @ turn.T,
        root=positions[:, 0] @ turn.T,
        fps=1.0 / frame_time,
    )


def _hierarchy(tokens: list[str]):
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    stack: list[int] = []
    current, i = -1, 0
    while i < len(tokens):
        word = tokens[i]
        if word in ("ROOT", "JOINT"):
            names.append(tokens[i + 1])
            parents.append(stack[-1] if stack else -1)
            offsets.append([0.0, 0.0, 0.0])
            channels.append([])
            current = len(names) - 1
            i += 2
        elif word == "End":
            current = -2  # an end site has an offset but is no joint
            i += 2
        elif word == "{":
            stack.append(current)
            i += 1
        elif word == "}":
            stack.pop()
            i += 1
        elif word == "OFFSET":
            if stack[-1] >= 0:
                offsets[stack[-1]] = [float(v) for v in tokens[i + 1 : i + 4]]
            i += 4
        elif word == "CHANNELS":
            count = int(tokens[i + 1])
            channels[stack[-1]] = tokens[i + 2 : i + 2 + count]
            i += 2 + count
        else:
            i += 1
    return names, parents, np.array(offsets), channels


def _forward(parents, offsets, channels, values):
    """World rotations [T, J, 3, 3] and positions [T, J, 3] by forward kinematics."""
    frames, joints = len(values), len(parents)
    rotations, positions = np.empty((frames, joints, 3, 3)), np.empty((frames, joints, 3))
    column = 0
    for j, parent in enumerate(parents):
        own = values[:, column : column + len(channels[j])]
        column += len(channels[j])
        local = np.tile(offsets[j], (frames, 1))
        axes, angles = "", []
        for channel, value in zip(channels[j], own.T, strict=True):
            if channel.endswith("position"):
                local[:, "XYZ".index(channel[0])] = value
            else:
                axes += channel[0]
                angles.append(value)
        turn = Rotation.from_euler(axes, np.stack(angles, 1), degrees=True).as_matrix() if axes else np.eye(3)[None]
        if parent < 0:
            rotations[:, j], positions[:, j] = turn, local
        else:
            rotations[:, j] = rotations[:, parent] @ turn
            positions[:, j] = positions[:, parent] + np.einsum("tij,tj->ti", rotations[:, parent], local)
    return rotations, positions


def retarget(clip: Clip, body: RestBody, fps: float = 30.0) -> PoseSequence:
    """The clip on another body, resampled to `fps` by nearest frames.

    Raises:
        MeshError: The clip's joints are named neither as CMU MotionBuilder nor as DAZ names them.
    """
    source = {name: name if name in clip.names else _DAZ.get(name) for name in body.bone_names}
    source = {name: s if s in clip.names else None for name, s in source.items()}
    missing = [name for name in ("Hips", *_LIMBS) if source[name] is None]
    if missing:
        raise MeshError(
            f"{len(missing)} bones have no joint in the clip (first: {missing[0]}); its joints are "
            f"{', '.join(clip.names[:6])}, ... Names of the CMU MotionBuilder or DAZ releases are understood."
        )
    frames = np.round(np.arange(0, len(clip.root) - 1e-6, clip.fps / fps)).astype(int)
    frames = frames[frames < len(clip.root)]
    rotations = np.empty((len(frames), len(body.bone_names), 3, 3))
    alignment = {a: _limb_alignment(clip, body, source, a, b) for a, b in _LIMBS.items()}
    alignment |= {"LeftHand": alignment["LeftForeArm"], "RightHand": alignment["RightForeArm"]}
    for bone, name in enumerate(body.bone_names):
        joint = source[name]
        if joint is None:
            rotations[:, bone] = rotations[:, body.bone_parents[bone]]
        else:
            rotations[:, bone] = clip.rotations[frames, clip.names.index(joint)] @ alignment.get(name, np.eye(3))
    return PoseSequence(rotations, clip.root[frames] * _leg_ratio(clip, body, source), fps)


def _limb_alignment(clip: Clip, body: RestBody, source, bone: str, child: str) -> np.ndarray:
    """Smallest rotation from the target's rest direction of a limb to the source's zero-pose direction."""
    a = body.joint(child) - body.joint(bone)
    b = clip.offsets[clip.names.index(source[child])]
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, a @ b)).as_matrix()


def _leg_ratio(clip: Clip, body: RestBody, source) -> float:
    bones = ("LeftUpLeg", "LeftLeg", "LeftFoot")
    target = sum(np.linalg.norm(body.joint(b) - body.joint(a)) for a, b in itertools.pairwise(bones))
    own = sum(np.linalg.norm(clip.offsets[clip.names.index(source[b])]) for b in bones[1:])
    return float(target / own)
