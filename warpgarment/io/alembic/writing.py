"""Writes meshes in motion as an Alembic archive (Ogawa)."""

from __future__ import annotations

import gc
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from warpgarment.errors import MeshError, MissingExtra, OutputError
from warpgarment.geometry.checks import checked_faces, checked_fps, checked_positions
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.surface.record import NONE, Surface, of_triangles
from warpgarment.progress import parts

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
    meshes: Sequence[tuple[str, np.ndarray, np.ndarray]],
    fps: float,
    surfaces: Sequence[Surface | None] = (),
    *,
    start: float = 0.0,
) -> None:
    """Writes meshes as one archive, completely or not at all, their polygons clockwise as Alembic has them.

    Each material becomes a set of faces with its name, which is how programs assign materials in Alembic.

    Args:
        path: The file.
        meshes: Name, vertices [T,V,3] in metres and faces [F,3], counter-clockwise, of each; the same T for all.
        fps: Frames per second.
        surfaces: Polygons, texture coordinates (of which the first set is written) and materials of each mesh; None, or
            none for all: the triangles.
        start: Time of the first frame [s].

    Raises:
        MeshError: Other shapes, indices out of range, or different numbers of frames.
        MissingExtra: alembic3d is not installed.
        OutputError: The disk is full, or cannot be written to.
    """
    modules()
    path, fps = Path(path), checked_fps(fps)
    if not meshes:
        raise MeshError("No mesh to write.")
    checked: list[_Mesh] = []
    looks = surfaces or [None] * len(meshes)
    for (name, points, faces), surface in zip(meshes, looks, strict=True):
        vertices = checked_positions(points, name=f"vertices of {name!r}", frames=True, finite=False)
        triangles = checked_faces(faces, vertices.shape[1], name=f"faces of {name!r}")
        shown = surface or of_triangles(triangles)
        free = _free(name, {one.name for one in checked})
        checked.append(_Mesh(free, vertices, shown.turned(np.ones(len(shown.counts), dtype=bool))))
    frames = {len(one.vertices) for one in checked}
    if len(frames) > 1:
        raise MeshError(f"The meshes have {' and '.join(map(str, sorted(frames)))} frames. Give them the same number.")
    with atomic_file(path) as temporary:
        _reserve(temporary, checked)
        try:
            _write(temporary, checked, fps, start)
        except RuntimeError as error:
            raise OutputError(f"{path}: Alembic cannot write it: {' '.join(str(error).split())[-200:]}") from error
        gc.collect()  # an archive is written to its end when nothing holds it any more
        with open(temporary, "rb") as file:
            if file.read(len(CLOSED)) != CLOSED:
                raise OutputError(f"{path}: Alembic could not write it to its end. Is there room on the disk?")


class _Mesh(NamedTuple):
    """A mesh as Alembic has it: its polygons are clockwise."""

    name: str
    vertices: np.ndarray
    surface: Surface


def _free(name: str, taken: set[str]) -> str:
    """A name that Alembic allows and that is not taken yet."""
    plain = found = re.sub(r"[/\0]", "_", name) or "mesh"
    number = 2
    while found in taken:
        found, number = f"{plain}_{number}", number + 1
    return found


def _reserve(path: Path, meshes: Sequence[_Mesh]) -> None:
    """Asks for room for a file before it is written, as Alembic ends the process where there is none at its end.

    Raises:
        OSError: The disk is full; `atomic_file` names it.
    """
    size = 8192
    for _, vertices, surface in meshes:
        held = sum(2 * one.values.nbytes + one.corners.nbytes for one in surface.coordinates)
        size += 12 * vertices.shape[0] * vertices.shape[1] + 1024 * vertices.shape[0] + held + 4096
        size += 2 * (surface.corners.nbytes + surface.counts.nbytes) + 512 * len(surface.materials)
    if hasattr(os, "posix_fallocate"):
        with open(path, "wb") as file:
            os.posix_fallocate(file.fileno(), 0, size)


def _write(path: Path, meshes: Sequence[_Mesh], fps: float, start: float) -> None:
    Abc, AbcCoreAbstract, *_ = modules()
    archive = Abc.OArchive(str(path))
    sampling = archive.addTimeSampling(AbcCoreAbstract.TimeSampling(1.0 / fps, float(start)))
    for mesh in meshes:
        _write_mesh(archive, sampling, mesh)


def _write_mesh(archive: Any, sampling: int, mesh: _Mesh) -> None:
    _, _, AbcGeom, imath = modules()
    surface = mesh.surface
    schema = AbcGeom.OPolyMesh(archive.getTop(), mesh.name).getSchema()
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
    for positions in parts(mesh.vertices, f"writing {mesh.name}"):
        points = imath.V3fArrayFromBuffer(np.ascontiguousarray(positions, dtype=np.float32))
        schema.set(AbcGeom.OPolyMeshSchemaSample(points, corners, counts, *more))
    taken: set[str] = set()
    for number, material in enumerate(surface.materials):
        mine = np.flatnonzero(surface.material == number)
        if not len(mine):
            continue
        name = _free(material.name or "material", taken)
        taken.add(name)
        faces = schema.createFaceSet(name).getSchema()
        faces.setFaceExclusivity(AbcGeom.FaceSetExclusivity.kFaceSetExclusive)
        sample = AbcGeom.OFaceSetSchemaSample()
        sample.setFaces(imath.IntArrayFromBuffer(mine.astype(np.int32)))
        faces.set(sample)
