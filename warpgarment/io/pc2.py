"""PC2 point caches: 32 bytes of header, then float32 positions frame after frame (the format of Blender's mesh cache).

char[12] "POINTCACHE2\\0" | int32 version = 1 | int32 points | float32 start frame | float32 frames per sample | int32
samples
"""

from __future__ import annotations

import os
import struct
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.atomic import atomic_files
from warpgarment.io.disk.plain import open_plain
from warpgarment.io.surface.obj import OBJ_KEEPS, obj_files
from warpgarment.io.surface.record import say_left_out

from .data import Format, Holds, MotionData, ReadOptions
from .obj import chosen_polygons, obj_holds, read_polygons, surface_of
from .parts import unnamed
from .ply import read_ply
from .polygons import triangulate_counts

HEADER = struct.Struct("<12siiffi")
SIGNATURE = b"POINTCACHE2\0"
FAR = 2.0  # how much an edge is stretched, beyond which it is another one


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
        for frame in vertices:
            file.write(np.ascontiguousarray(frame, dtype="<f4").tobytes())


def _read(path: Path, options: ReadOptions) -> MotionData:
    """The cache, with the faces of the mesh of the same name beside it."""
    beside = [path.with_suffix(suffix) for suffix in (".obj", ".OBJ", ".ply", ".PLY")]
    mesh = next((candidate for candidate in beside if candidate.exists()), None)
    if mesh is None:
        raise MeshError(
            f"{path}: a point cache has no faces; put {path.stem}.obj, with the same vertex order, beside it."
        )
    cache = read_pc2(path)
    if mesh.suffix.lower() == ".ply":
        unnamed(path, options.mesh)
        ply = read_ply(mesh)
        rest, faces, surface = ply.vertices, ply.faces, ply.surface
        count, used = len(rest), np.arange(len(rest))
    else:
        found = read_polygons(mesh)
        used, rest, counts, corners = chosen_polygons(mesh, found, options.mesh)
        count, faces = len(found.vertices), triangulate_counts(rest, counts, corners)
        surface = surface_of(mesh, found, options.mesh, used)
    if count != cache.vertices.shape[1]:
        raise MeshError(f"{path} has {cache.vertices.shape[1]:,} points and {mesh.name} {count:,} vertices.")
    vertices = cache.vertices[:, used]
    _warn_about_order(path, mesh, rest, vertices[0], faces)
    return MotionData(vertices, faces, step=cache.sampling, start=cache.start / cache.sampling, surface=surface)


def _warn_about_order(path: Path, mesh: Path, rest: np.ndarray, first: np.ndarray, faces: np.ndarray) -> None:
    """Warns where the edges of the first frame are far from those of the mesh, as they are in another order.

    What the two have in common is looked for in the ratios of lengths: cloth and skin stretch by some per cent, and a
    unit changes all of them alike.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    before, after = (np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (rest.astype(float), first))
    real = (before > 0) & np.isfinite(after)
    if not real.any():
        return
    ratio = after[real] / before[real]
    middle = float(np.median(ratio))
    odd = (ratio > FAR * middle) | (ratio < middle / FAR)
    if middle == 0 or odd.mean() > 0.2:
        warnings.warn(
            f"{path}: {np.count_nonzero(odd):,} of {len(ratio):,} edges have another length in the first frame than in "
            f"{mesh.name}, by more than a factor of {FAR:g}: its vertices seem to be in another order.",
            UserWarning,
            stacklevel=6,
        )


def _write(path: Path, data: MotionData) -> None:
    """The cache, and its first frame as .obj of the same name beside it, which holds what a cache cannot."""
    say_left_out(path, data.surface, sets=1, keeps=OBJ_KEEPS)
    texts = obj_files(path.with_suffix(".obj"), data.vertices[0], data.faces, data.name, data.surface)
    with atomic_files(*texts, path) as (*files, cache):
        for file, text in zip(files, texts.values(), strict=True):
            file.write_text(text, encoding="utf-8")
        write_pc2_to(cache, data.vertices, start=data.start or 0.0)


def _holds(path: Path) -> Holds:
    beside = next((p for p in (path.with_suffix(".obj"), path.with_suffix(".OBJ")) if p.exists()), None)
    return obj_holds(beside) if beside else Holds()


FORMAT = Format(read_motion=_read, write_motion=_write, named=True, holds=_holds)
