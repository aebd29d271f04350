"""Alembic: meshes of an archive, moved by their points and transforms; ``pip install "warpgarment[alembic]"``.

Alembic's polygons run clockwise, seen from outside: they are turned round when they are read and written. It says
neither unit nor axis; metres and Y up are what is written, and assumed. Materials are sets of faces, by name.
"""

from pathlib import Path

import numpy as np

from warpgarment.io.data import Format, MeshData, MotionData, ReadOptions
from warpgarment.io.surface.record import say_left_out

from .reading import alembic_holds, read_alembic
from .writing import write_alembic

__all__ = ["FORMAT", "KEEPS", "read_alembic", "write_alembic"]

KEEPS = "names of materials"
"""What is kept of materials, see `say_left_out`."""


def _read_mesh(path: Path, options: ReadOptions) -> MeshData:
    found = read_alembic(path, mesh=options.mesh, frames=False)
    return MeshData(found.vertices[0], found.faces, name=found.name, surface=found.surface)


def _write_mesh(path: Path, data: MeshData) -> None:
    say_left_out(path, data.surface, sets=1, keeps=KEEPS)
    write_alembic(path, [(data.name, np.asarray(data.vertices)[None], data.faces)], 30.0, [data.surface])


def _read_motion(path: Path, options: ReadOptions) -> MotionData:
    found = read_alembic(path, mesh=options.mesh)
    return MotionData(
        found.vertices, found.faces, found.fps, name=found.name, seconds=found.start, surface=found.surface
    )


def _write_motion(path: Path, data: MotionData) -> None:
    fps = 30.0 if data.fps is None else data.fps
    start = data.seconds if data.seconds is not None else (data.start or 0.0) / fps
    say_left_out(path, data.surface, sets=1, keeps=KEEPS)
    write_alembic(path, [(data.name, data.vertices, data.faces)], fps, [data.surface], start=start)


FORMAT = Format("alembic", _read_mesh, _write_mesh, _read_motion, _write_motion, named=True, holds=alembic_holds)
