"""VTO (Santesteban, Otaduy, Casas, Eurographics 2019; Santesteban et al., CVPR 2021): one garment on SMPL bodies.

A sequence is a pickle, named as in ``tshirt_shape00_01_01.pkl``, of a dictionary:

- `vertices` [T, V, 3] and `faces` [F, 3] of the garment: metres, Y up, 30 frames per second;
- the body: `pose` [T, 72], `translation` [T, 3], `shape` [T, 10], as the authors' code reads them; their description
  calls them `poses` [T, 75] and `shapes` [T, 10], which is understood too, the last three taken for the translation;
- `sequence`, `subject`, and `conf`, the simulator's configuration.

The translation follows SMPL's own convention. The file does not contain the gender; other readers take it to be female,
and so does this one.

A pickle can run commands when it is opened in the usual way. It is not opened in that way here: `unpickle` reads arrays
of numbers and refuses everything else. `convert_vto` writes the data as .npz, so that the pickle is read only once.

The file has no rest shape. Without `rest=` the first frame takes its place, in which the garment is already on the
body: its stretch in that frame counts as none. The authors' other repositories hold the garment's mesh
(``tshirt.obj``).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.files import read_mesh
from warpgarment.io.npz import read_npz, write_npz

from .fields import betas, numbers
from .recording import Recording, recorded_garment
from .smpl import BodySource, SmplPoses, body_from
from .unpickle import read_pickle

FPS = 30.0
ALIASES = {"pose": ("pose", "poses"), "translation": ("translation",), "shape": ("shape", "shapes")}
NO_REST = "no rest shape: the first frame serves, and how the cloth is stretched there counts as none"


def read_vto(
    path: str | Path, *, body: BodySource = None, rest: str | Path | None = None, clean: bool = False
) -> Recording:
    """Reads a sequence, as published or as `convert_vto` wrote it. Nothing in it is executed.

    Args:
        path: File to read, .pkl or .npz.
        body: Motion of the body, or a function that makes it from the sequence's SMPL poses; see `smpl.body_from`.
        rest: Mesh file with the garment's rest shape [m], with its vertices in the order of the sequence.
        clean: Whether a rest mesh that is not valid for a garment is repaired; the frames follow.

    Raises:
        PickleRefused: The pickle holds something other than plain data, or is damaged.
        MeshError: Arrays are missing or do not fit each other.

    Warns:
        UserWarning: There is no rest shape.
    """
    path = Path(path)
    data = _load(path)
    frames, faces = _numbers(path, data, "vertices", 3), _numbers(path, data, "faces", 2)
    if faces.dtype.kind not in "iu" or faces.shape[1] != 3 or frames.shape[2] != 3:
        raise MeshError(
            f"{path}: vertices {list(frames.shape)} of {frames.dtype} and faces {list(faces.shape)} of {faces.dtype}; "
            "they must be [T,V,3], and [F,3] of integers."
        )
    if len(frames) == 0:
        raise MeshError(f"{path}: vertices hold no frame.")
    if rest is not None:
        still = read_mesh(Path(rest)).vertices
        if len(still) != frames.shape[1]:
            raise MeshError(f"{rest} has {len(still):,} vertices, the garment of {path.name} {frames.shape[1]:,}.")
    elif "rest_vertices" in data:
        still = numbers(f"{path}: rest_vertices", data["rest_vertices"], (2,))
    else:
        still = frames[0]
        warnings.warn(f"{path}: {NO_REST}. Give one with rest=.", UserWarning, stacklevel=2)
    name = path.stem.split("_")[0] or "garment"
    poses = _poses(path, data, len(frames))
    attributes = {key: str(data[key]) for key in ("sequence", "subject") if isinstance(data.get(key), (str, int))}
    if "sequence" in attributes:
        attributes["motion"] = attributes["sequence"]
    return Recording(
        (recorded_garment(name, still, faces, frames, where=str(path), clean=clean),),
        body_from(body, poses),
        FPS,
        source=f"VTO {path.stem}",
        poses=poses,
        attributes=attributes,
    )


def convert_vto(path: str | Path, output: str | Path, *, rest: str | Path | None = None, clean: bool = False) -> Path:
    """Writes a published sequence as .npz of plain arrays: `GarmentMotion.load` and `read_vto` read it.

    Args:
        path: Published file to read, .pkl.
        output: File to write, .npz; it is written completely or not at all.
        rest, clean: Rest shape and repair, as in `read_vto`.

    Returns:
        Path of the .npz file.

    Raises:
        PickleRefused, MeshError: As in `read_vto`.
    """
    path, output = Path(path), Path(output)
    if output.suffix.lower() != ".npz":
        raise MeshError(f"{output}: a converted sequence is an .npz file.")
    recording = read_vto(path, rest=rest, clean=clean)
    garment, poses = recording.garments[0], recording.poses
    arrays = {
        "vertices": garment.vertices,
        "faces": garment.rest.faces,
        "fps": np.array(recording.fps),
        "name": np.array(garment.rest.name),
    }
    if rest is not None:
        arrays["rest_vertices"] = garment.rest.vertices
    if poses is not None:
        arrays |= {"pose": poses.rotations.reshape(len(poses), -1), "translation": poses.trans, "shape": poses.betas}
    arrays |= {key: np.array(value) for key, value in recording.attributes.items() if key != "motion"}
    write_npz(output, arrays)
    return output


def _load(path: Path) -> Mapping[str, Any]:
    if path.suffix.lower() == ".npz":
        arrays = read_npz(path, required=("vertices", "faces"))
        return {key: value.item() if value.ndim == 0 else value for key, value in arrays.items()}
    data = read_pickle(path)
    if not isinstance(data, dict):
        raise MeshError(f"{path}: a {type(data).__name__}, not a dictionary; this is not a VTO sequence.")
    return data


def _numbers(path: Path, data: Mapping[str, Any], name: str, dimensions: int) -> np.ndarray:
    if name not in data:
        held = ", ".join(sorted(map(str, data))[:12]) or "nothing"
        raise MeshError(f"{path}: no {name!r} in it; this is not a VTO sequence. It holds {held}.")
    array = data[name]
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu" or array.ndim != dimensions:
        shape = list(array.shape) if isinstance(array, np.ndarray) else type(array).__name__
        raise MeshError(f"{path}: {name} must be an array of numbers with {dimensions} dimensions, it is {shape}.")
    return array


def _poses(path: Path, data: Mapping[str, Any], frames: int) -> SmplPoses | None:
    names = {ours: next((name for name in theirs if name in data), None) for ours, theirs in ALIASES.items()}
    if names["pose"] is None:
        return None
    pose = _numbers(path, data, names["pose"], 2)
    if names["translation"] is not None:
        trans = _numbers(path, data, names["translation"], 2)
    elif pose.shape[1] == 75:
        pose, trans = pose[:, :72], pose[:, 72:]
    else:
        raise MeshError(f"{path}: {names['pose']} has {pose.shape[1]} columns and there is no 'translation'.")
    if pose.shape != (frames, 72) or trans.shape != (frames, 3):
        raise MeshError(
            f"{path}: {frames:,} frames of the garment, {names['pose']} {list(pose.shape)} and translation "
            f"{list(trans.shape)}: they must be [T,72] and [T,3]."
        )
    shape = betas(f"{path}: {names['shape']}", data[names["shape"]], frames) if names["shape"] else np.zeros(10)
    rotations = pose.astype(np.float64).reshape(frames, 24, 3)
    return SmplPoses(rotations, trans.astype(np.float64), shape, "female", FPS, up="y", source=str(path))
