"""NumPy archives, never with pickled objects in them."""

from __future__ import annotations

import math
import re
import struct
import zipfile
from collections.abc import Callable, Mapping, Sequence
from io import BufferedIOBase
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.skinning import linear_blend_skinning
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.plain import open_plain
from warpgarment.io.surface.arrays import PREFIX, from_arrays, to_arrays
from warpgarment.io.surface.record import Surface, worth_keeping

from .data import Format, MeshData, MotionData, ReadOptions
from .parts import ALL, Parts, named

MAGIC = b"\x93NUMPY"
LARGE, RATIO = 64 << 20, 100  # bytes of an array from which on it is asked how much smaller it is in the file
RATE = re.compile(r".*fps|.*framerate|framespersecond|sampl(e|ing)rate")  # letters of the names that rates have
TIMES = ("start", "start_frame", "last")  # of the first frame [s], or its number; see `MotionData.last`
SKINNED = ("rest_vertices", "faces", "bone_indices", "bone_weights", "bone_transforms")


def read_npz(
    path: Path, required: Sequence[str] = (), wanted: Callable[[str], bool] | None = None
) -> dict[str, np.ndarray]:
    """Arrays of an archive. Sizes are checked before anything is allocated for them.

    Args:
        path: The file.
        required: Names that must be there.
        wanted: Which names to read; others are not even unpacked. None: all.

    Raises:
        MeshError: Not an archive, cut short, holding pickled objects or records, an array of another size than its
            header says or than a file like this can hold, or without a required array.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    with open_plain(path) as file:
        if file.read(len(MAGIC)) == MAGIC:
            raise MeshError(f"{path} is a single array, not an .npz archive.")
    try:
        with zipfile.ZipFile(path) as archive:
            members = {m.filename.removesuffix(".npy"): m for m in archive.infolist()}
            missing = [key for key in required if key not in members]
            if missing:
                names = ", ".join(sorted(members)) or "nothing"
                raise MeshError(f"{path}: no array named {missing[0]!r}; the file holds {names}.")
            return {key: _array(path, archive, m) for key, m in members.items() if wanted is None or wanted(key)}
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, struct.error) as error:
        if isinstance(error, MeshError):
            raise
        raise MeshError(
            f"{path}: not a readable .npz archive of plain arrays. It is damaged, cut short, or of another kind."
        ) from None


def array_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape of an array, whether it lies by columns, and its type, from the beginning of a .npy file.

    Raises:
        ValueError: The file does not begin as one, or its header is no header. NumPy parses it as Python's syntax, with
            every error that Python's parsers have.
    """
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = read(file)
    except OSError:
        raise
    except Exception as error:  # TokenError, SyntaxError, RecursionError, OverflowError, ...
        raise ValueError(f"no header of an array ({type(error).__name__}: {str(error)[:100]})") from None
    if any(isinstance(size, bool) or size < 0 for size in shape):  # True is an integer to NumPy's check of a header
        raise ValueError(f"no header of an array (its shape is {list(shape)})")
    return shape, by_columns, dtype


def _array(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """One array; whatever the libraries underneath make of a damaged one becomes a MeshError."""
    name = member.filename
    if member.file_size > max(LARGE, RATIO * member.compress_size):
        raise MeshError(
            f"{path}: {name} would unpack {member.compress_size:,} bytes into {member.file_size:,}; above "
            f"{LARGE:,} bytes, arrays that shrink to less than a {RATIO}th are refused. Save it without compression."
        )
    try:
        with archive.open(member) as file:
            shape, by_columns, dtype = array_header(file)
            header = file.tell()
            if dtype.hasobject or dtype.names or dtype.itemsize == 0:
                raise ValueError("pickled objects or records")
            size = dtype.itemsize * math.prod(shape)
            if size != member.file_size - header:
                raise ValueError(f"shape {list(shape)} where there are {member.file_size - header:,} bytes")
            data = bytearray(size)
            if cast(BufferedIOBase, file).readinto(data) != size or file.read(1):
                raise ValueError("cut short")
    except Exception as error:  # zlib.error, TokenError, SyntaxError, RuntimeError, ...: there is no end of them
        raise MeshError(
            f"{path}: {name} is not a readable plain array ({type(error).__name__}: {str(error)[:100]}). "
            "The file is damaged, cut short, or of another kind."
        ) from None
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C")


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays uncompressed, completely or not at all. Object arrays are refused with TypeError."""
    for key, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise TypeError(f"{key} is an object array, which would need pickle")
    named: dict[str, Any] = dict(arrays)  # Any: NumPy's stub would have each of them fit `allow_pickle` too
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **named)


def _read_mesh(path: Path, options: ReadOptions) -> MeshData:
    known = {"vertices", "faces", "pins", "name"}
    arrays = read_npz(path, ("vertices", "faces"), lambda key: key in known or key.startswith(PREFIX))
    _check_name(path, arrays, options.mesh)
    return MeshData(arrays["vertices"], arrays["faces"], arrays.get("pins"), _name(arrays), _surface(path, arrays))


def _read_motion(path: Path, options: ReadOptions) -> MotionData:
    """Positions, or a rest mesh with bones that move it."""
    known = {"vertices", "collider_faces", *TIMES, *SKINNED}
    arrays = read_npz(
        path,
        ("faces",),
        lambda key: key in known or key == "name" or key.startswith(("status_", PREFIX)) or _is_rate(key),
    )
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
    _check_name(path, arrays, options.mesh)
    fps = _rate(path, arrays)
    seconds, start, last = (_number(path, key, arrays[key]) if key in arrays else None for key in TIMES)
    for key, value in zip(TIMES, (seconds, start, last), strict=True):
        if value is not None and not math.isfinite(value):
            raise MeshError(f"{path}: {key} must be finite, not {value}.")
    others = {key for key in arrays if key in known or _is_rate(key) or key.startswith(PREFIX)}
    extra = {key: array for key, array in arrays.items() if key not in others}
    whole = MotionData(vertices, arrays["faces"], fps, arrays.get("collider_faces"), _name(arrays), extra)
    return whole._replace(start=start, seconds=seconds, last=last, surface=_surface(path, arrays))


def _surface(path: Path, arrays: Mapping[str, np.ndarray]) -> Surface | None:
    def make() -> Surface | None:
        found = from_arrays(arrays)
        if found is not None:
            found.check_vertices(arrays["vertices"].shape[-2])
        return found

    return worth_keeping(path, make)


def _is_rate(key: str) -> bool:
    return RATE.fullmatch(re.sub(r"[^a-z]", "", key.lower())) is not None


def _rate(path: Path, arrays: Mapping[str, np.ndarray]) -> float | None:
    """Frames per second under one of the names that people use; None where there is none."""
    found: dict[str, float] = {}
    for key in filter(_is_rate, arrays):
        found[key] = _number(path, key, arrays[key])
    if len(set(found.values())) > 1:
        listed = ", ".join(f"{key} {rate:g}" for key, rate in found.items())
        raise MeshError(f"{path}: rates that differ: {listed}. Keep one of them.")
    return next(iter(found.values()), None)


def _number(path: Path, key: str, array: np.ndarray) -> float:
    try:
        return float(array.reshape(()))
    except (TypeError, ValueError):
        raise MeshError(f"{path}: {key} must be a single number.") from None


def _check_name(path: Path, arrays: Mapping[str, np.ndarray], mesh: str | None) -> None:
    if mesh not in (None, ALL):
        named(path, mesh, Parts([_name(arrays)], np.zeros(1, dtype=int)))


def _name(arrays: Mapping[str, np.ndarray]) -> str:
    return str(arrays["name"]) if "name" in arrays else ""


def _write_mesh(path: Path, data: MeshData) -> None:
    pins = {} if data.pins is None or len(data.pins) == 0 else {"pins": data.pins}
    write_npz(
        path,
        {
            "vertices": data.vertices,
            "faces": data.faces,
            "name": np.array(data.name),
            **pins,
            **to_arrays(data.surface),
        },
    )


def _write_motion(path: Path, data: MotionData) -> None:
    times = {"fps": data.fps, "start": data.seconds, "last": data.last}
    told = {key: np.array(value, dtype=np.float64) for key, value in times.items() if value is not None}
    arrays = {"vertices": data.vertices, "faces": data.faces, "name": np.array(data.name), **told, **data.extra}
    write_npz(path, arrays | to_arrays(data.surface))


FORMAT = Format(None, _read_mesh, _write_mesh, _read_motion, _write_motion, named=True)
