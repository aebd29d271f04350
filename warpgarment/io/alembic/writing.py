"""Writes a mesh in motion as an Alembic archive (Ogawa)."""

from __future__ import annotations

import gc
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MissingExtra, OutputError
from warpgarment.geometry.checks import checked_faces, checked_fps, checked_positions
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.surface.record import NONE, Surface, of_triangles

CLOSED = b"Ogawa\xff"  # how an archive begins that was written to its end


def modules() -> tuple[Any, ...]:
    """Alembic's modules Abc, AbcCoreAbstract and AbcGeom, and imath.

    Raises:
        MissingExtra: alembic3d is not installed.
    """
    try:
        import imath
        from alembic3d import Abc, AbcCoreAbstract, AbcGeom
    except ImportError:
        raise MissingExtra("alembic", "Reading and writing Alembic") from None
    return Abc, AbcCoreAbstract, AbcGeom, imath


def write_alembic(
    path: Path,
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    fps: float,
    surface: Surface | None = None,
    *,
    start: float = 0.0,
) -> None:
    """Writes one mesh, completely or not at all, its polygons clockwise as Alembic has them.

    Args:
        path: The file.
        name: Name of the mesh.
        vertices: Positions [m], shape [T,V,3].
        faces: Vertex indices, counter-clockwise, shape [F,3].
        fps: Frames per second.
        surface: Polygons and texture coordinates, of which the first set is written; None: the triangles.
        start: Time of the first frame [s].

    Raises:
        MeshError: Other shapes, or indices out of range.
        MissingExtra: alembic3d is not installed.
        OutputError: The disk is full, or cannot be written to.
    """
    modules()
    path, fps = Path(path), checked_fps(fps)
    vertices = checked_positions(vertices, frames=True, finite=False)
    shown = surface or of_triangles(checked_faces(faces, vertices.shape[1]))
    shown = shown.turned(np.ones(len(shown.counts), dtype=bool))
    with atomic_file(path) as temporary:
        _reserve(temporary, vertices.shape, shown)
        try:
            _write(temporary, re.sub(r"[/\0]", "_", name) or "mesh", vertices, shown, fps, start)
        except RuntimeError as error:
            raise OutputError(f"{path}: Alembic cannot write it: {' '.join(str(error).split())[-200:]}") from error
        gc.collect()  # an archive is written to its end when nothing holds it any more
        with open(temporary, "rb") as file:
            if file.read(len(CLOSED)) != CLOSED:
                raise OutputError(f"{path}: Alembic could not write it to its end. Is there room on the disk?")


def _reserve(path: Path, shape: tuple[int, ...], surface: Surface) -> None:
    """Asks for room for a file before it is written, as Alembic ends the process where there is none at its end.

    Raises:
        OSError: The disk is full; `atomic_file` names it.
    """
    held = sum(2 * one.values.nbytes + one.corners.nbytes for one in surface.coordinates)
    size = (
        12 * shape[0] * shape[1] + 2 * (surface.corners.nbytes + surface.counts.nbytes) + held + 1024 * shape[0] + 8192
    )
    if hasattr(os, "posix_fallocate"):
        with open(path, "wb") as file:
            os.posix_fallocate(file.fileno(), 0, size)


def _write(path: Path, name: str, vertices: np.ndarray, surface: Surface, fps: float, start: float) -> None:
    Abc, AbcCoreAbstract, AbcGeom, imath = modules()
    archive = Abc.OArchive(str(path))
    sampling = archive.addTimeSampling(AbcCoreAbstract.TimeSampling(1.0 / fps, float(start)))
    schema = AbcGeom.OPolyMesh(archive.getTop(), name).getSchema()
    schema.setTimeSampling(sampling)
    corners = imath.IntArrayFromBuffer(np.array(surface.corners, dtype=np.int32))
    counts = imath.IntArrayFromBuffer(np.array(surface.counts, dtype=np.int32))
    more: list[Any] = []
    if surface.coordinates:
        one = surface.coordinates[0]
        values, places = one.values, one.corners
        if (places == NONE).any():  # Alembic wants a pair for every corner
            values = np.concatenate([values, np.zeros((1, 2), np.float32)])
            places = np.where(places == NONE, len(values) - 1, places)
        pairs = imath.V2fArrayFromBuffer(np.ascontiguousarray(values, dtype=np.float32))
        indices = imath.UnsignedIntArray(len(places))
        for corner, place in enumerate(places.tolist()):  # imath takes no buffer of this type
            indices[corner] = place
        more = [AbcGeom.OV2fGeomParamSample(pairs, indices, AbcGeom.GeometryScope.kFacevaryingScope)]
    for positions in vertices:
        points = imath.V3fArrayFromBuffer(np.ascontiguousarray(positions, dtype=np.float32))
        schema.set(AbcGeom.OPolyMeshSchemaSample(points, corners, counts, *more))
