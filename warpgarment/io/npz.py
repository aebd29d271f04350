"""NumPy archives, never with pickled objects in them."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.skinning import linear_blend_skinning

from .atomic import atomic_file
from .data import Format, MeshData, MotionData, ReadOptions

SKINNED = ("rest_vertices", "faces", "bone_indices", "bone_weights", "bone_transforms")


def read_npz(path: Path, required: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """All arrays of an archive.

    Args:
        path: The file.
        required: Names that must be there.

    Raises:
        MeshError: Not an archive, cut short, holding pickled objects, or without a required array.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise MeshError(f"{path} is a single array, not an .npz archive.")
            data = {key: archive[key] for key in archive.files}
    except FileNotFoundError:
        raise
    except MeshError:
        raise
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, TypeError, AttributeError):
        raise MeshError(
            f"{path}: not a readable .npz archive of plain arrays. It is damaged, cut short, or of another kind."
        ) from None
    missing = [key for key in required if key not in data]
    if missing:
        raise MeshError(
            f"{path}: no array named {missing[0]!r}; the file holds {', '.join(sorted(data)) or 'nothing'}."
        )
    return data


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays uncompressed, completely or not at all. Object arrays are refused with TypeError."""
    for key, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise TypeError(f"{key} is an object array, which would need pickle")
    named: dict[str, Any] = dict(arrays)  # Any: NumPy's stub would have each of them fit `allow_pickle` too
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **named)


def _read_mesh(path: Path, options: ReadOptions) -> MeshData:
    arrays = read_npz(path, required=("vertices", "faces"))
    return MeshData(arrays["vertices"], arrays["faces"], arrays.get("pins"), _name(arrays))


def _read_motion(path: Path, options: ReadOptions) -> MotionData:
    """Positions, or a rest mesh with bones that move it."""
    arrays = read_npz(path, required=("faces",))
    if "vertices" in arrays:
        vertices = arrays["vertices"]
        vertices = vertices[None] if vertices.ndim == 2 else vertices
    else:
        missing = [key for key in SKINNED if key not in arrays]
        if missing:
            raise MeshError(
                f"{path}: neither 'vertices' nor {missing[0]!r} in it; it holds {', '.join(sorted(arrays))}."
            )
        try:
            vertices = linear_blend_skinning(*(arrays[k] for k in ("rest_vertices", *SKINNED[2:])))
        except MeshError as error:
            raise MeshError(f"{path}: {error}") from None
    try:
        fps = float(arrays["fps"]) if "fps" in arrays else None
    except (TypeError, ValueError):
        raise MeshError(f"{path}: fps must be a single number.") from None
    known = {"vertices", "fps", "collider_faces", *SKINNED}
    extra = {key: array for key, array in arrays.items() if key not in known}
    return MotionData(vertices, arrays["faces"], fps, arrays.get("collider_faces"), _name(arrays), extra)


def _name(arrays: Mapping[str, np.ndarray]) -> str:
    return str(arrays["name"]) if "name" in arrays else ""


def _write_mesh(path: Path, data: MeshData) -> None:
    pins = {} if data.pins is None or len(data.pins) == 0 else {"pins": data.pins}
    write_npz(path, {"vertices": data.vertices, "faces": data.faces, "name": np.array(data.name), **pins})


def _write_motion(path: Path, data: MotionData) -> None:
    rate = {} if data.fps is None else {"fps": np.array(data.fps, dtype=np.float64)}
    write_npz(path, {"vertices": data.vertices, "faces": data.faces, "name": np.array(data.name), **rate, **data.extra})


FORMAT = Format(read_mesh=_read_mesh, write_mesh=_write_mesh, read_motion=_read_motion, write_motion=_write_motion)
