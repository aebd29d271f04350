"""Motions from files: clips are read by suffix, and transferred to a body by world-space rotations.

Retargeting copies the rotation of each source bone from its zero pose, in world axes, after turning the zero pose of
the limbs onto the target's rest pose. Root translation is scaled by the ratio of leg lengths, so file units do not
matter.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.bodies.rest import RestBody
from warpgarment.bodies.skeleton import PoseSequence
from warpgarment.errors import MeshError

from .amass import amass_length, read_amass
from .bvh import bvh_length, read_bvh
from .clip import Clip, resampled, resampled_length

__all__ = ["Clip", "clip_frames", "jumps", "list_clips", "read_amass", "read_bvh", "read_clip", "resampled", "retarget"]

# What the DAZ-friendly CMU release calls the bones of the MotionBuilder-friendly one; None takes the parent's rotation.
_DAZ = {
    "Hips": "hip", "LowerBack": "hip", "Spine": "abdomen", "Spine1": "chest", "Neck": "neck", "Neck1": "neck",
    "Head": "head",
    "LeftUpLeg": "lThigh", "LeftLeg": "lShin", "LeftFoot": "lFoot",
    "RightUpLeg": "rThigh", "RightLeg": "rShin", "RightFoot": "rFoot",
    "LeftShoulder": "lCollar", "LeftArm": "lShldr", "LeftForeArm": "lForeArm", "LeftHand": "lHand",
    "RightShoulder": "rCollar", "RightArm": "rShldr", "RightForeArm": "rForeArm", "RightHand": "rHand",
}  # fmt: skip
_MIXAMO = {"LowerBack": "Spine", "Spine": "Spine1", "Spine1": "Spine2"}  # the trunk, where it starts with Spine
_LIMBS = {
    "LeftUpLeg": "LeftLeg", "LeftLeg": "LeftFoot", "RightUpLeg": "RightLeg", "RightLeg": "RightFoot",
    "LeftArm": "LeftForeArm", "LeftForeArm": "LeftHand", "RightArm": "RightForeArm", "RightForeArm": "RightHand",
}  # fmt: skip
_LEG = ("LeftUpLeg", "LeftLeg", "LeftFoot")
_READERS = {".bvh": (read_bvh, bvh_length), ".npz": (read_amass, amass_length)}
_FASTEST_ROOT = 12.0  # m/s, the speed of a sprinter
_FASTEST_BONE = 1800.0  # degrees/s, twice the speed of a runner's shin


def list_clips(folder: str | Path) -> list[Path]:
    """The clips in a folder (.bvh and .npz files, without subfolders), sorted by name; no file is opened."""
    return sorted(p for p in Path(folder).iterdir() if p.suffix.lower() in _READERS and p.is_file())


def read_clip(path: str | Path) -> Clip:
    """Reads a clip by its suffix: .bvh or AMASS .npz.

    Raises:
        MeshError: The suffix is another, or the file is damaged.
    """
    return _reader(path)[0](path)


def clip_frames(path: str | Path, fps: float = 30.0) -> int:
    """Number of frames of a clip after :func:`retarget` to a frame rate; only the file's header is read.

    Raises:
        MeshError: The suffix is another, or there is no header.
    """
    frames, rate = _reader(path)[1](path)
    return resampled_length(frames, rate, fps)


def _reader(path: str | Path) -> tuple[Callable[..., Clip], Callable[[str | Path], tuple[int, float]]]:
    path = Path(path)
    if path.suffix.lower() not in _READERS:
        raise MeshError(f"{path.name}: motions are read from .bvh and AMASS .npz files, not from {path.suffix!r}.")
    return _READERS[path.suffix.lower()]


def retarget(clip: Clip, body: RestBody, fps: float = 30.0, metres: float | None = None) -> PoseSequence:
    """The clip on another body, resampled to `fps` frames per second.

    Args:
        clip: The clip.
        body: The body.
        fps: Frames per second of the result.
        metres: Metres in a unit of the clip, by which its root moves. None: :func:`metres_by_legs`.

    Raises:
        MeshError: The clip's joints have the names neither of CMU MotionBuilder, Mixamo nor DAZ.
    """
    source = _sources(clip, body)
    clip = resampled(clip, fps)
    rotations = np.empty((len(clip), len(body.bone_names), 3, 3))
    alignment = {a: _limb_alignment(clip, body, source, a, b) for a, b in _LIMBS.items()}
    alignment |= {"LeftHand": alignment["LeftForeArm"], "RightHand": alignment["RightForeArm"]}
    for bone, name in enumerate(body.bone_names):
        joint = source[name]
        if joint is None:
            rotations[:, bone] = rotations[:, body.bone_parents[bone]]
        else:
            rotations[:, bone] = clip.rotations[:, clip.names.index(joint)] @ alignment.get(name, np.eye(3))
    return PoseSequence(rotations, clip.root * (metres or _leg_ratio(clip, body, source)), fps)


def metres_by_legs(clip: Clip, body: RestBody) -> tuple[float, float]:
    """Metres in a unit of a clip with which its legs are as long as those of the body, and the length of these [m].

    Raises:
        MeshError: As of :func:`retarget`.
    """
    ratio = _leg_ratio(clip, body, _sources(clip, body))
    return ratio, _leg_length(body)


def _sources(clip: Clip, body: RestBody) -> dict[str, str | None]:
    """The joint of the clip for each bone of the body; None takes the rotation of the bone's parent.

    Raises:
        MeshError: A limb has none.
    """
    plain = {name.rpartition(":")[2]: name for name in reversed(clip.names)}  # mixamorig:LeftLeg
    three = _MIXAMO if "Spine2" in plain and "LowerBack" not in plain else {}
    wanted = {name: three.get(name, name) for name in body.bone_names}
    named = {name: s if s in plain else _DAZ.get(name) for name, s in wanted.items()}
    source = {name: None if s is None else plain.get(s) for name, s in named.items()}
    missing = [name for name in ("Hips", *_LIMBS) if source[name] is None]
    if missing:
        raise MeshError(
            f"{len(missing)} bones have no joint in the clip (first: {missing[0]}); its joints are "
            f"{', '.join(clip.names[:6])}, ... Names of the CMU MotionBuilder or DAZ releases are understood, and "
            "those of Mixamo."
        )
    return source


def jumps(body: RestBody, poses: PoseSequence) -> np.ndarray:
    """Frames that the body cannot have reached from the frame before, bool [T]: markers were lost or swapped.

    In these frames the root is faster than 12 m/s, or a bone of the trunk, head, thighs, shins or arms is faster than
    1,800 degrees per second. Hands, feet and toes are ignored: their few markers often flicker, but they move little
    cloth.
    """
    carried = {b for name in ("Hand", "Foot") for side in ("Left", "Right") for b in body.chain(side + name)}
    bones = [b for b in range(len(body.bone_names)) if b not in carried]
    relative = poses.rotations[:-1, bones].transpose(0, 1, 3, 2) @ poses.rotations[1:, bones]
    cosine = 0.5 * (np.trace(relative, axis1=2, axis2=3).min(axis=1, initial=3.0) - 1.0)
    turned = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    moved = np.linalg.norm(np.diff(poses.root, axis=0), axis=1)
    too_fast = (turned > _FASTEST_BONE / poses.fps) | (moved > _FASTEST_ROOT / poses.fps)
    return np.concatenate([[False], too_fast])


def _limb_alignment(clip: Clip, body: RestBody, source: dict[str, str | None], bone: str, child: str) -> np.ndarray:
    """The smallest rotation from the rest direction of the target's limb to its direction in the source's zero pose."""
    a = body.joint(child) - body.joint(bone)
    b = clip.offsets[clip.names.index(source[child])]
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, a @ b)).as_matrix()


def _leg_ratio(clip: Clip, body: RestBody, source: dict[str, str | None]) -> float:
    own = sum(np.linalg.norm(clip.offsets[clip.names.index(source[bone])]) for bone in _LEG[1:])
    if own <= 0:
        raise MeshError("the legs of the clip have no length. Repair what wrote it.")
    return float(_leg_length(body) / own)


def _leg_length(body: RestBody) -> float:
    return float(sum(np.linalg.norm(body.joint(b) - body.joint(a)) for a, b in itertools.pairwise(_LEG)))
