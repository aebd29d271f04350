"""MDD point caches of LightWave, Maya, Houdini, Modo and Blender: big-endian numbers, without a signature.

int32 frames | int32 points | float32 time of each frame [s] | float32 positions, frame after frame
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.data import Format, MotionData, ReadOptions
from warpgarment.io.disk.plain import open_plain
from warpgarment.io.times import moments
from warpgarment.progress import parts

from .beside import covered, holds_beside, mesh_of, write_covered

HEADER = struct.Struct(">ii")


class Mdd(NamedTuple):
    """Positions [T,V,3], float32 in the file's unit, and time of each frame [s], float32 [T]."""

    vertices: np.ndarray
    times: np.ndarray


def read_mdd(path: Path) -> Mdd:
    """An MDD file.

    Raises:
        MeshError: No frames or no points, or another number of bytes than these take.
    """
    path = Path(path)
    with open_plain(path) as file:
        head, length = file.read(HEADER.size), os.fstat(file.fileno()).st_size
        if len(head) < HEADER.size:
            raise MeshError(f"{path}: {length:,} bytes are no MDD file, or it is cut short.")
        frames, points = HEADER.unpack(head)
        size = HEADER.size + 4 * frames + 12 * frames * points
        if frames < 1 or points < 1 or length != size:
            raise MeshError(
                f"{path}: {length:,} bytes where {frames:,} frames of {points:,} points need {size:,}. "
                "This is no MDD file, or it is damaged or cut short."
            )
        data = file.read(size - HEADER.size)
    if len(data) != size - HEADER.size:
        raise MeshError(f"{path}: became shorter while it was read.")
    numbers = np.frombuffer(data, dtype=">f4").astype(np.float32)
    return Mdd(numbers[frames:].reshape(frames, points, 3), numbers[:frames])


def write_mdd_to(path: Path, vertices: np.ndarray, times: np.ndarray) -> None:
    """Writes positions [T,V,3] at times [T] in seconds to exactly this path."""
    frames, count = vertices.shape[:2]
    with open(path, "wb") as file:
        file.write(HEADER.pack(frames, count))
        file.write(np.asarray(times, dtype=">f4").tobytes())
        for frame in parts(vertices, "writing"):
            file.write(np.asarray(frame, dtype=">f4").tobytes())


def _read(path: Path, options: ReadOptions) -> MotionData:
    mesh_of(path)
    cache = read_mdd(path)
    vertices, faces, surface = covered(path, cache.vertices, options)
    found = moments(cache.times, float(np.finfo(np.float32).eps), str(path))
    return MotionData(vertices, faces, found.fps, seconds=found.start, surface=surface)


def _write(path: Path, data: MotionData) -> None:
    fps = 30.0 if data.fps is None else data.fps
    start = data.seconds if data.seconds is not None else (data.start or 0.0) / fps
    times = start + np.arange(len(data.vertices)) / fps
    write_covered(path, data, lambda cache: write_mdd_to(cache, data.vertices, times))


FORMAT = Format(read_motion=_read, write_motion=_write, named=True, holds=holds_beside)
