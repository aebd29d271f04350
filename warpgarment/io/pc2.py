"""PC2 point caches: 32 bytes of header, then float32 positions frame after frame (the format of Blender's mesh cache).

char[12] "POINTCACHE2\\0" | int32 version = 1 | int32 points | float32 start frame | float32 frames per sample | int32
samples
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import open_plain
from warpgarment.progress import parts

from .caches.beside import covered, holds_beside, mesh_of, write_covered
from .data import Format, MotionData, ReadOptions

HEADER = struct.Struct("<12siiffi")
SIGNATURE = b"POINTCACHE2\0"


class PointCache(NamedTuple):
    """Positions [T,V,3], float32 in the file's unit; frame of the first sample, and frames from one to the next."""

    vertices: np.ndarray
    start: float
    sampling: float


def read_pc2(path: Path) -> PointCache:
    """A PC2 file.

    Raises:
        MeshError: Another signature or version, fewer bytes than the header says, or a sampling that is not positive.
    """
    path = Path(path)
    with open_plain(path) as file:
        head, length = file.read(HEADER.size), os.fstat(file.fileno()).st_size
    if len(head) < HEADER.size or not head.startswith(SIGNATURE[:11]):
        raise MeshError(f"{path}: does not start with POINTCACHE2; this is not a PC2 file, or it is cut short.")
    _, version, points, start, sampling, samples = HEADER.unpack(head)
    if version != 1 or points < 1 or samples < 1:
        raise MeshError(
            f"{path}: version {version} with {points:,} points and {samples:,} samples; only version 1 is known."
        )
    size = HEADER.size + 12 * points * samples
    if length != size:
        raise MeshError(
            f"{path}: {length:,} bytes where {samples:,} samples of {points:,} points need {size:,}. "
            "The file is damaged or cut short."
        )
    if not (np.isfinite(start) and 1e-3 <= sampling <= 1e3):
        raise MeshError(
            f"{path}: the header says that samples are {sampling:g} frames apart, from frame {start:g}. Write it again."
        )
    vertices = np.fromfile(path, dtype="<f4", count=3 * points * samples, offset=HEADER.size)
    if vertices.size != 3 * points * samples:
        raise MeshError(f"{path}: became shorter while it was read.")
    return PointCache(vertices.reshape(samples, points, 3).astype(np.float32, copy=False), start, sampling)


def write_pc2_to(path: Path, vertices: np.ndarray, *, start: float = 0.0, sampling: float = 1.0) -> None:
    """Writes positions [T,V,3] to exactly this path; see `io.disk.atomic` for how to make it appear at once.

    Args:
        path: The file.
        vertices: Positions, shape [T,V,3].
        start: Frame of the first sample.
        sampling: Frames from one sample to the next.
    """
    frames, count = vertices.shape[:2]
    with open(path, "wb") as file:
        file.write(HEADER.pack(SIGNATURE, 1, count, start, sampling, frames))
        for frame in parts(vertices, "writing"):
            file.write(np.ascontiguousarray(frame, dtype="<f4").tobytes())


def _read(path: Path, options: ReadOptions) -> MotionData:
    mesh_of(path)
    cache = read_pc2(path)
    vertices, faces, surface = covered(path, cache.vertices, options)
    return MotionData(vertices, faces, step=cache.sampling, start=cache.start / cache.sampling, surface=surface)


def _write(path: Path, data: MotionData) -> None:
    write_covered(path, data, lambda cache: write_pc2_to(cache, data.vertices, start=data.start or 0.0))


FORMAT = Format(read_motion=_read, write_motion=_write, named=True, holds=holds_beside)
