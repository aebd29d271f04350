"""PC2 point caches: 32 bytes of header, then float32 positions frame after frame (the format of Blender's mesh cache).

char[12] "POINTCACHE2\\0" | int32 version = 1 | int32 points | float32 start frame | float32 frames per sample | int32
samples
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError

from .atomic import atomic_files
from .data import Format, MotionData, ReadOptions
from .obj import obj_text, read_obj
from .ply import read_ply

HEADER = struct.Struct("<12siiffi")
SIGNATURE = b"POINTCACHE2\0"


def read_pc2(path: Path) -> np.ndarray:
    """Positions of a PC2 file in its unit, float32, shape [T,V,3].

    Raises:
        MeshError: Another signature or version, or fewer bytes than the header says.
    """
    data = Path(path).read_bytes()
    if len(data) < HEADER.size or not data.startswith(SIGNATURE[:11]):
        raise MeshError(f"{path}: does not start with POINTCACHE2; this is not a PC2 file, or it is cut short.")
    _, version, points, _, _, samples = HEADER.unpack_from(data)
    if version != 1 or points < 1 or samples < 1:
        raise MeshError(
            f"{path}: version {version} with {points:,} points and {samples:,} samples; only version 1 is known."
        )
    size = HEADER.size + 12 * points * samples
    if len(data) != size:
        raise MeshError(
            f"{path}: {len(data):,} bytes where {samples:,} samples of {points:,} points need {size:,}. "
            "The file is damaged or cut short."
        )
    return np.frombuffer(data, dtype="<f4", offset=HEADER.size).reshape(samples, points, 3).astype(np.float32)


def write_pc2_to(path: Path, vertices: np.ndarray, *, start: float = 0.0, sampling: float = 1.0) -> None:
    """Writes positions [T,V,3] to exactly this path; see `io.atomic` for how to make it appear at once.

    Args:
        path: The file.
        vertices: Positions, shape [T,V,3].
        start: Frame of the first sample.
        sampling: Frames from one sample to the next.
    """
    frames, count = vertices.shape[:2]
    with open(path, "wb") as file:
        file.write(HEADER.pack(SIGNATURE, 1, count, start, sampling, frames))
        for frame in vertices:
            file.write(np.ascontiguousarray(frame, dtype="<f4").tobytes())


def _read(path: Path, options: ReadOptions) -> MotionData:
    """The cache, with the faces of the mesh of the same name beside it."""
    readers = {path.with_suffix(".obj"): read_obj, path.with_suffix(".ply"): read_ply}
    mesh = next((candidate for candidate in readers if candidate.exists()), None)
    if mesh is None:
        raise MeshError(
            f"{path}: a point cache has no faces; put {path.stem}.obj, with the same vertex order, beside it."
        )
    vertices, (rest, faces) = read_pc2(path), readers[mesh](mesh)
    if len(rest) != vertices.shape[1]:
        raise MeshError(f"{path} has {vertices.shape[1]:,} points and {mesh.name} {len(rest):,} vertices.")
    return MotionData(vertices, faces)


def _write(path: Path, data: MotionData) -> None:
    """The cache, and its first frame as .obj of the same name beside it."""
    with atomic_files(path.with_suffix(".obj"), path) as (mesh, cache):
        mesh.write_text(obj_text(data.vertices[0], data.faces, data.name), encoding="utf-8")
        write_pc2_to(cache, data.vertices)


FORMAT = Format(read_motion=_read, write_motion=_write)
