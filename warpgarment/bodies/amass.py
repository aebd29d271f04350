"""The reader of AMASS motions: SMPL joint angles in .npz files, Z up.

No SMPL model is needed. Joint angles are taken from the T-pose, whose limb directions are those of any T-pose; the
offsets below are rounded lengths of an average adult, used for directions and for the ratio of leg lengths only.
Fingers and faces are left out; the 22 joints read are the first of SMPL, SMPL-H and SMPL-X alike.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from tokenize import TokenError
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import open_plain
from warpgarment.io.npz import array_header, read_npz

from .clip import Clip, checked_finite, frame_rate

# SMPL's joints in SMPL's order: name here, number of the parent, offset from the parent [m]; Y up, facing +Z.
_JOINTS = (
    ("Hips", -1, (0.0, 0.0, 0.0)),
    ("LeftUpLeg", 0, (0.06, -0.09, 0.0)),
    ("RightUpLeg", 0, (-0.06, -0.09, 0.0)),
    ("LowerBack", 0, (0.0, 0.12, -0.03)),
    ("LeftLeg", 1, (0.04, -0.38, 0.0)),
    ("RightLeg", 2, (-0.04, -0.38, 0.0)),
    ("Spine", 3, (0.0, 0.14, 0.0)),
    ("LeftFoot", 4, (-0.01, -0.40, -0.04)),
    ("RightFoot", 5, (0.01, -0.40, -0.04)),
    ("Spine1", 6, (0.0, 0.05, 0.03)),
    ("LeftToeBase", 7, (0.04, -0.06, 0.12)),
    ("RightToeBase", 8, (-0.04, -0.06, 0.12)),
    ("Neck", 9, (0.0, 0.21, -0.04)),
    ("LeftShoulder", 9, (0.08, 0.12, -0.02)),
    ("RightShoulder", 9, (-0.08, 0.12, -0.02)),
    ("Head", 12, (0.0, 0.09, 0.05)),
    ("LeftArm", 13, (0.09, 0.03, -0.01)),
    ("RightArm", 14, (-0.09, 0.03, -0.01)),
    ("LeftForeArm", 16, (0.26, -0.01, -0.02)),
    ("RightForeArm", 17, (-0.26, -0.01, -0.02)),
    ("LeftHand", 18, (0.25, 0.01, 0.0)),
    ("RightHand", 19, (-0.25, 0.01, 0.0)),
)
_WIDTHS = {66: "22 joints", 72: "SMPL", 156: "SMPL-H", 165: "SMPL-X"}
_RATES = ("mocap_framerate", "mocap_frame_rate", "framerate")
_UNREADABLE = (
    OSError, ValueError, EOFError, AttributeError, TypeError, KeyError, RuntimeError, TokenError, zipfile.BadZipFile,
    zlib.error,
)  # fmt: skip
LARGEST = 1e6  # of an angle [rad] and a position [m]
NAMES = tuple(name for name, _, _ in _JOINTS)
_PELVIS = np.array([0.0, -0.22, 0.03])  # rest position of the average body's root [m]; translations start from it
_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class Recorded(NamedTuple):
    """What an AMASS file holds, in its own axes: Z up.

    Attributes:
        poses: Axis-angle of each joint of its model relative to its parent [rad], shape [T, J, 3].
        trans: Translation [m], shape [T, 3].
        betas: Coefficients of the model's shapes, shape [S]; empty where the file has none.
        fps: Frames per second.
    """

    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray
    fps: float


def read_amass(path: str | Path, up: str = "z") -> Clip:
    """Reads an AMASS-style .npz: `poses` [T, 66, 72, 156 or 165] axis-angles [rad], `trans` [T, 3] [m], a frame rate.

    Gender and shape do not matter; nothing in the file is unpickled. `up` is the axis that points up in it, "y" or "z".

    Raises:
        MeshError: The file is no .npz, keys are missing or have other shapes, a number is not finite, or the frame
            rate is unknown.
    """
    recorded = read_recorded(path)
    poses, trans = recorded.poses, recorded.trans
    turns = Rotation.from_rotvec(poses[:, : len(_JOINTS)].reshape(-1, 3)).as_matrix()
    rotations = turns.reshape(len(poses), len(_JOINTS), 3, 3)
    turn = _Z_UP_TO_Y_UP if up == "z" else np.eye(3)
    rotations[:, 0] = turn @ rotations[:, 0]  # the root turns SMPL's axes, Y up, to those of the file
    for joint, (_, parent, _) in enumerate(_JOINTS[1:], start=1):
        rotations[:, joint] = rotations[:, parent] @ rotations[:, joint]
    return Clip(
        names=NAMES,
        offsets=np.array([offset for _, _, offset in _JOINTS]),
        rotations=rotations,
        root=(trans + _PELVIS) @ turn.T,
        fps=recorded.fps,
        up=up,
    )


def read_recorded(path: str | Path) -> Recorded:
    """Reads what an AMASS file holds, in its own axes.

    Raises:
        MeshError: As of :func:`read_amass`.
    """
    path = Path(path)
    arrays = _opened(path, ("poses", "trans", "betas"))
    poses, trans = arrays["poses"], arrays["trans"]
    _check_shape(path, poses.shape, poses.dtype)
    if trans.shape != (len(poses), 3) or trans.dtype.kind not in "fiu":
        raise MeshError(f"{path.name}: trans must be [T,3], T = {len(poses):,} as in poses, got {list(trans.shape)}.")
    checked_finite(poses, path.name)
    checked_finite(trans, path.name)
    largest = max(float(np.abs(array).max(initial=0.0)) for array in (poses, trans))
    if largest > LARGEST:
        raise MeshError(
            f"{path.name}: a number of {largest:g} in poses or trans, beyond {LARGEST:,.0f}. It is damaged."
        )
    betas = arrays.get("betas", np.zeros(0))
    if betas.dtype.kind not in "fiu" or betas.ndim != 1 or not (np.abs(betas) <= LARGEST).all():
        raise MeshError(f"{path.name}: betas must be finite numbers [S], got {betas.dtype} {list(betas.shape)}.")
    turns = poses.astype(np.float64).reshape(len(poses), -1, 3)
    return Recorded(turns, trans.astype(np.float64), betas.astype(np.float64), arrays["rate"])


def amass_length(path: str | Path) -> tuple[int, float]:
    """Number of frames and frames per second of an AMASS file, from its headers.

    Raises:
        MeshError: As in :func:`read_amass`, as far as the fault is visible in the headers.
    """
    path = Path(path)
    rate = _opened(path, ())["rate"]
    try:
        with zipfile.ZipFile(path) as archive, archive.open("poses.npy") as member:
            shape, _, dtype = array_header(member)
    except _UNREADABLE as error:
        raise MeshError(f"{path.name} is not an .npz file of plain arrays ({error}).") from error
    _check_shape(path, shape, dtype)
    return shape[0], rate


def _opened(path: Path, names: tuple[str, ...]) -> dict:
    """The named arrays and `rate`, a number."""
    try:
        with open_plain(path) as file, zipfile.ZipFile(file) as archive:
            there = [name.removesuffix(".npy") for name in archive.namelist()]
        rates = [name for name in _RATES if name in there]
        missing = [name for name in ("poses", "trans") if name not in there]
        if missing or not rates:
            raise MeshError(
                f"{path.name} is no AMASS motion: it lacks {', '.join(missing) or 'mocap_framerate'}; "
                f"it holds {', '.join(there[:8]) or 'nothing'}."
            )
        try:
            arrays = read_npz(path, wanted={*names, rates[0]}.__contains__)
        except MeshError as error:
            raise MeshError(f"{path.name} is not an .npz file of plain arrays ({error})") from None
        rate = arrays.pop(rates[0])
    except (MeshError, FileNotFoundError):
        raise
    except _UNREADABLE as error:
        raise MeshError(f"{path.name} is not an .npz file of plain arrays ({error}).") from error
    if rate.size != 1 or rate.dtype.kind not in "fiu":
        raise MeshError(f"{path.name}: {rates[0]} must be one number, got {rate.dtype} {list(rate.shape)}.")
    return arrays | {"rate": frame_rate(float(rate.reshape(())), path.name)}


def _check_shape(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> None:
    if len(shape) != 2 or shape[0] == 0 or shape[1] not in _WIDTHS or dtype.kind != "f":
        known = ", ".join(f"{width} ({name})" for width, name in _WIDTHS.items())
        raise MeshError(f"{path.name}: poses must be numbers [T,D] with D one of {known}, got {dtype} {list(shape)}.")
