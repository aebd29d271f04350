"""USD: one mesh of a stage, moved by its points, its transforms or its skeleton; ``pip install "warpgarment[usd]"``."""

from pathlib import Path

import numpy as np

from warpgarment.io.data import Format, MeshData, MotionData, ReadOptions
from warpgarment.io.surface.record import say_left_out

from .reading import UsdMesh, read_usd, usd_holds
from .writing import write_usd

__all__ = ["FORMAT", "UsdMesh", "read_usd", "write_usd"]

KEEPS, MANY = "materials, objects, groups", 1_000_000  # what a stage holds; sets of texture coordinates without end


def _read_mesh(path: Path, options: ReadOptions) -> MeshData:
    found = read_usd(path, mesh=options.mesh, frames=False, convert=options.unit is None, turn=options.up is None)
    return MeshData(found.vertices[0], found.faces, surface=found.surface)


def _write_mesh(path: Path, data: MeshData) -> None:
    say_left_out(path, data.surface, sets=MANY, keeps=KEEPS)
    write_usd(path, [(data.name or "garment", np.asarray(data.vertices)[None], data.faces)], 30.0, [data.surface])


def _read_motion(path: Path, options: ReadOptions) -> MotionData:
    found = read_usd(path, mesh=options.mesh, convert=options.unit is None, turn=options.up is None)
    if found.fps is None:
        return MotionData(found.vertices, found.faces, name=found.name, seconds=found.start, surface=found.surface)
    return MotionData(found.vertices, found.faces, found.fps, name=found.name, start=found.start, surface=found.surface)


def _write_motion(path: Path, data: MotionData) -> None:
    fps, start = 30.0 if data.fps is None else data.fps, data.start or 0.0
    say_left_out(path, data.surface, sets=MANY, keeps=KEEPS)
    write_usd(path, [(data.name or "mesh", data.vertices, data.faces)], fps, [data.surface], start=start)


FORMAT = Format(
    "usd",
    _read_mesh,
    _write_mesh,
    _read_motion,
    _write_motion,
    only_read=(".usdz",),
    named=True,
    axis=True,
    holds=usd_holds,
)
