"""CLOTH3D (Bertiche, Madadi, Escalera, ECCV 2020): garments simulated on SMPL bodies that move as CMU's actors did.

A sample is a folder, named after the clip and the subject (01_01_s0):

- ``info.mat`` (MATLAB 5): `poses` [72, T] and `trans` [3, T] (vectors where T = 1), `shape` [10], `gender` (0 female,
  1 male), `zrot` (turn of everything about the vertical [rad]), `tightness` [2], and `outfit`, a struct with one field
  a garment, each with its `fabric` (cotton, silk, denim, leather) and texture;
- ``<Garment>.obj``: the rest shape, mostly quads, around the body in rest pose (pelvis at the origin, legs spread by
  0.15 rad each), already turned by `zrot`;
- ``<Garment>.pc16``: positions relative to the pelvis, not yet turned, as 16-bit floats (see `pc16`).

Units are metres with Z up. A garment's positions are Rz(zrot) (V + trans). SMPL's pelvis is moved to the origin before
posing, so `trans` is its position. This is known from the data set's description and its authors' public tools (the
starter kit; DeePSD for the turned rest shapes).

The data set does not specify which garment is worn over which (the order of `outfit` is kept), the numbers behind a
fabric's name (`attributes` keeps the name, `materials` are unknown), and the rate, which is taken to be 30 fps.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError
from warpgarment.io.obj import read_obj

from .axes import y_up
from .fields import betas, numbers
from .matlab import read_mat
from .pc16 import read_pc16
from .recording import RecordedGarment, Recording, recorded_garment
from .smpl import BodySource, SmplPoses, body_from

INFO = "info.mat"
VARIABLES = ("poses", "trans", "shape", "gender", "zrot", "outfit", "tightness")


def read_cloth3d(folder: str | Path, *, body: BodySource = None, fps: float = 30.0, clean: bool = False) -> Recording:
    """Reads a sample. Garments are in the positions that the data set's own tools give them, but with Y up.

    Args:
        folder: Folder of the sample.
        body: Motion of the body, or a function that makes it from the sample's SMPL poses; see `smpl.body_from`.
        fps: Frames per second.
        clean: Whether rest meshes that are not valid for a garment are repaired; the frames follow.

    Raises:
        MeshError: A file is missing, truncated or of another version, or files do not fit each other.
    """
    folder = Path(folder)
    if not (folder / INFO).is_file():
        raise MeshError(f"{folder} holds no {INFO}: it is not the folder of a CLOTH3D sample.")
    info = read_mat(folder / INFO, VARIABLES, required=("poses", "trans"))
    outfit = info["outfit"] if isinstance(info.get("outfit"), dict) else {}
    names = list(outfit) or sorted(path.stem for path in folder.glob("*.pc16"))
    _check_files(folder, names)
    turn = Rotation.from_rotvec([0.0, 0.0, _number(folder, info, "zrot")])
    poses = _poses(folder, info, turn, fps)
    garments = tuple(_garment(folder, name, turn, poses.trans, clean) for name in names)
    attributes: dict[str, Any] = {
        "motion": re.sub(r"_s\d+$", "", folder.name),  # samples are named after CMU's clip: 01_01_s0
        "garments": {name: _fabric(outfit.get(name)) for name in names},
    }
    if "tightness" in info:
        attributes["tightness"] = np.ravel(
            numbers(f"{folder / INFO}: tightness", info["tightness"], (0, 1, 2))
        ).tolist()
    return Recording(
        garments,
        body_from(body, poses),
        fps,
        source=f"CLOTH3D {folder.name}",
        poses=poses,
        attributes=attributes,
    )


def _check_files(folder: Path, names: list[str]) -> None:
    if not names:
        raise MeshError(f"{folder}: {INFO} names no outfit and there is no .pc16 file.")
    if any(name != Path(name).name for name in names):
        raise MeshError(f"{folder / INFO}: an outfit with names that are no file names.")
    needed = [f"{name}{suffix}" for name in names for suffix in (".obj", ".pc16")]
    missing = [name for name in needed if not (folder / name).is_file()]
    if missing:
        raise MeshError(
            f"{folder}: {len(missing)} of {len(needed)} files of the outfit are missing: {', '.join(missing)}. "
            "Unpack the sample again."
        )


def _garment(folder: Path, name: str, turn: Rotation, trans: np.ndarray, clean: bool) -> RecordedGarment:
    """One garment. `trans` [m] is turned already; the positions of the cache are not."""
    cache, mesh = folder / f"{name}.pc16", folder / f"{name}.obj"
    frames, (rest, faces) = read_pc16(cache), read_obj(mesh)
    if frames.shape[1] != len(rest):
        raise MeshError(f"{cache} has {frames.shape[1]:,} points and {mesh.name} {len(rest):,} vertices.")
    if len(frames) != len(trans):
        raise MeshError(f"{cache} has {len(frames):,} frames and {INFO} {len(trans):,}: one of them is cut short.")
    with np.errstate(invalid="ignore"):  # frames that are not finite are named below
        moved = frames @ turn.as_matrix().T + trans[:, None]
    return recorded_garment(name, y_up(turn.inv().apply(rest)), faces, y_up(moved), where=str(cache), clean=clean)


def _poses(folder: Path, info: dict[str, Any], turn: Rotation, fps: float) -> SmplPoses:
    """The SMPL parameters, turned by zrot."""
    rotations = _columns(folder, info, "poses", 72).reshape(-1, 24, 3)
    trans = _columns(folder, info, "trans", 3)
    if len(rotations) != len(trans):
        raise MeshError(f"{folder / INFO}: {len(rotations):,} poses and {len(trans):,} translations.")
    poses = SmplPoses(
        rotations,
        trans,
        betas=np.ravel(betas(f"{folder / INFO}: shape", info.get("shape", np.zeros(10)), 1)),
        gender="male" if _number(folder, info, "gender") else "female",
        fps=fps,
        up="z",
        centred=True,
        source=str(folder / INFO),
    )
    return poses.turned(turn)


def _columns(folder: Path, info: dict[str, Any], name: str, rows: int) -> np.ndarray:
    """A variable of shape [rows, T], or [rows] for one frame, as float64 [T, rows]."""
    array = np.asarray(info[name])
    if array.dtype.kind not in "fiu" or array.ndim not in (1, 2) or array.shape[0] != rows:
        raise MeshError(
            f"{folder / INFO}: {name} has shape {list(array.shape)} of {array.dtype}; "
            f"it must hold numbers of shape [{rows},T]."
        )
    return array.reshape(rows, -1).T.astype(np.float64)


def _number(folder: Path, info: dict[str, Any], name: str) -> float:
    """A scalar variable; 0 if it is missing."""
    array = np.ravel(np.asarray(info.get(name, 0.0)))
    if array.size != 1 or array.dtype.kind not in "fiub" or not np.isfinite(array[0]):
        raise MeshError(f"{folder / INFO}: {name} must be one finite number.")
    return float(array[0])


def _fabric(garment: Any) -> dict[str, str]:
    fabric = garment.get("fabric") if isinstance(garment, dict) else None
    return {"fabric": fabric} if isinstance(fabric, str) else {}
