"""Reads one mesh of an Alembic archive over time: its points, and transforms of its parents."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.data import Holds
from warpgarment.io.disk.plain import open_plain
from warpgarment.io.polygons import triangulate_counts
from warpgarment.io.surface.record import NONE, Coordinates, Material, Surface, worth_keeping
from warpgarment.io.times import moments
from warpgarment.progress import parts

from .structure import check_structure
from .writing import CLOSED, modules

LARGEST = 4 << 30  # bytes of the positions of all frames
MOST = 1_000_000  # samples
DEEPEST = 100  # objects within each other
EXACT = 1e-14  # relative error of times, which are float64


class AlembicMesh(NamedTuple):
    """One mesh of an archive, in world space and the numbers of the file.

    Attributes:
        name: Its name.
        vertices: Positions, float32 [T,V,3].
        faces: Vertex indices, counter-clockwise seen from outside, int64 [F,3].
        fps: Frames per second; None for a single one, or where the times are not even.
        start: Time of the first frame [s].
        surface: Its polygons and texture coordinates; None: triangles alone.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    fps: float | None
    start: float
    surface: Surface | None


class _Found(NamedTuple):
    """A mesh in an archive: its path, its schema, and the schemas of the transforms above it, the innermost first."""

    path: str
    schema: Any
    above: tuple[Any, ...]


def read_alembic(path: Path, *, mesh: str | None = None, frames: bool = True) -> AlembicMesh:
    """Reads one mesh (polygons, or those of a subdivision surface) of an archive.

    Frames are the samples of its points, or where these stand still, of the transform above it that has the most.
    Transforms that are sampled at other times are interpolated in a straight line.

    Args:
        path: The file.
        mesh: Name or path of the mesh; may be left out where the archive holds one.
        frames: All frames, or the first only.

    Raises:
        MeshError: No Ogawa archive, damaged, no mesh, several and none named, faces that do not fit their points, or
            that change with time.
        MissingExtra: alembic3d is not installed.
        FileNotFoundError: There is no such file.
    """
    with _opened(Path(path)) as archive:
        return _read(_chosen(archive, mesh, path), path, frames)


def alembic_holds(path: Path) -> Holds:
    """Meshes of an archive, by path where two have the same name; raises as `read_alembic`."""
    with _opened(Path(path)) as archive:
        paths = [found.path for found in _meshes(archive)]
    names = [found.rsplit("/", 1)[-1] for found in paths]
    return Holds(tuple(n if names.count(n) == 1 else p for n, p in zip(names, paths, strict=True)))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The archive of a file; what Alembic finds damaged, also when a value is read, is named."""
    Abc, *_ = modules()
    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    with open_plain(path) as file:
        head = file.read(len(CLOSED))
    if head[:5] != CLOSED[:5]:
        kind = (
            "an Alembic file of the old kind (HDF5); export it as Ogawa" if head[1:4] == b"HDF" else "no Alembic file"
        )
        raise MeshError(f"{path} is {kind}.")
    if head != CLOSED:
        raise MeshError(f"{path}: was not written to its end. Export it again.")
    check_structure(path)
    try:
        yield Abc.IArchive(str(path))
    except (RuntimeError, MemoryError, UnicodeDecodeError) as error:
        said = "" if isinstance(error, UnicodeDecodeError) else f": {' '.join(str(error).split())[-200:]}"
        raise MeshError(f"{path}: Alembic cannot read it{said}. It is damaged or cut short.") from error


def _meshes(archive: Any) -> list[_Found]:
    """The meshes of an archive, in its order."""
    *_, AbcGeom, _ = modules()
    found: list[_Found] = []

    def look(parent: Any, above: tuple[Any, ...], depth: int) -> None:
        for number in range(parent.getNumChildren() if depth < DEEPEST else 0):
            header = parent.getChildHeader(number)
            for kind in (AbcGeom.IPolyMesh, AbcGeom.ISubD):
                if kind.matches(header):
                    found.append(_Found(header.getFullName(), kind(parent, header.getName()).getSchema(), above))
            moved = above
            if AbcGeom.IXform.matches(header):
                schema = AbcGeom.IXform(parent, header.getName()).getSchema()
                moved = (schema, *(above if schema.getInheritsXforms() else ()))
            look(parent.getChild(number), moved, depth + 1)

    look(archive.getTop(), (), 0)
    return found


def _chosen(archive: Any, mesh: str | None, path: Path) -> _Found:
    every = _meshes(archive)
    if not every:
        raise MeshError(f"{path}: no mesh in this archive.")
    named = [one for one in every if mesh is None or mesh in (one.path, one.path.rsplit("/", 1)[-1])]
    if len(named) == 1:
        return named[0]
    problem = f"{len(named)} meshes: " if mesh is None else f"{len(named)} meshes named {mesh!r}; the archive holds "
    have = ", ".join(one.path for one in (named or every)[:8])
    more = f", and {len(named or every) - 8} more" if len(named or every) > 8 else ""
    raise MeshError(f"{path}: {problem}{have}{more}. Name one with mesh=.")


def _read(found: _Found, path: Path, frames: bool) -> AlembicMesh:
    name = found.path.rsplit("/", 1)[-1]
    where = f"{path}: mesh {name!r}"
    points = _times(found.schema, where)
    moves = max((_times(schema, where) for schema in found.above), key=len, default=points)
    times = points if len(points) > 1 or len(moves) < 2 else moves
    times = times if frames else times[:1]
    counts, corners, first = _topology(found.schema, 0, where)
    if 12 * len(times) * len(first) > LARGEST:
        raise MeshError(f"{where}: {len(times):,} samples of {len(first):,} points are more than {LARGEST:,} bytes.")
    vertices = np.empty((len(times), len(first), 3), np.float32)
    fixed = found.schema.getFaceIndicesProperty().isConstant() and found.schema.getFaceCountsProperty().isConstant()
    for k in parts(range(len(times)), "reading"):
        sample = k if len(points) > 1 else 0
        placed = first
        if sample and fixed:
            placed = np.array(found.schema.getValue(sample).getPositions(), dtype=np.float32).reshape(-1, 3)
        elif sample:
            *other, placed = _topology(found.schema, sample, where)
            if not (np.array_equal(other[0], counts) and np.array_equal(other[1], corners)):
                raise MeshError(f"{where}: its faces change with time (first: sample {sample}).")
        if len(placed) != len(first):
            raise MeshError(f"{where}: the number of its points changes with time (first: sample {sample}).")
        matrix = _matrix(found.above, float(times[k]), where)
        vertices[k] = placed if matrix is None else placed @ matrix[:3, :3] + matrix[3, :3]
    return _made(found, name, where, vertices, times, counts, corners)


def _made(
    found: _Found,
    name: str,
    where: str,
    vertices: np.ndarray,
    times: np.ndarray,
    counts: np.ndarray,
    corners: np.ndarray,
) -> AlembicMesh:
    clockwise = Surface(counts, corners)
    plain = clockwise.turned(np.ones(len(counts), dtype=bool))
    try:
        faces = triangulate_counts(vertices[0], plain.counts, plain.corners)
    except MeshError as error:
        raise MeshError(f"{where}: {error}") from None
    surface = worth_keeping(where, lambda: _surface(found.schema, counts, corners, vertices.shape[1]))
    matrix = _matrix(found.above, float(times[0]), where)
    if matrix is not None and np.linalg.det(matrix[:3, :3]) < 0:  # mirrored: inside out
        mirrored = faces[:, ::-1].copy()
        surface = None if surface is None else surface.following(faces, mirrored)
        faces = mirrored
    clock = moments(times, EXACT, where)
    return AlembicMesh(name, vertices, faces, clock.fps, clock.start, surface)


def _times(schema: Any, where: str) -> np.ndarray:
    """Times of the samples of a schema [s]."""
    count, sampling = schema.getNumSamples(), schema.getTimeSampling()
    if count > MOST:
        raise MeshError(f"{where}: {count:,} samples; {MOST:,} are the most that are read.")
    return np.array([sampling.getSampleTime(k) for k in range(max(count, 1))])


def _topology(schema: Any, sample: int, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners of each polygon, vertices of the corners, clockwise, and points of a sample."""
    if schema.getNumSamples() == 0:
        raise MeshError(f"{where} has no points.")
    value = schema.getValue(sample)
    counts = np.array(value.getFaceCounts(), dtype=np.int64).reshape(-1)
    corners = np.array(value.getFaceIndices(), dtype=np.int64).reshape(-1)
    points = np.array(value.getPositions(), dtype=np.float32).reshape(-1, 3)
    if len(counts) == 0 or (counts < 3).any() or counts.sum() != len(corners):
        raise MeshError(f"{where} has no faces, or face counts that do not fit its indices.")
    if len(points) == 0 or corners.min() < 0 or corners.max() >= len(points):
        raise MeshError(f"{where}: faces name points beyond the {len(points):,} it has.")
    return counts, corners, points


def _matrix(above: tuple[Any, ...], time: float, where: str) -> np.ndarray | None:
    """The transform into the world at a time, for rows, float64 [4,4]; None: none."""
    world: np.ndarray | None = None
    for schema in above:
        times = _times(schema, where)
        after = int(np.clip(np.searchsorted(times, time), 0, len(times) - 1))
        before = max(after - 1, 0)
        gap = times[after] - times[before]
        share = min(max((time - times[before]) / gap, 0.0), 1.0) if gap > 0 else 1.0
        mine = _rows(schema, after)
        if share < 1.0:
            mine = share * mine + (1.0 - share) * _rows(schema, before)
        world = mine if world is None else world @ mine
    return None if world is None or np.array_equal(world, np.eye(4)) else world


def _rows(schema: Any, sample: int) -> np.ndarray:
    if schema.getNumSamples() == 0:
        return np.eye(4)
    matrix = schema.getValue(sample).getMatrix()
    return np.array([[matrix[i][j] for j in range(4)] for i in range(4)], dtype=np.float64)


def _surface(schema: Any, counts: np.ndarray, corners: np.ndarray, points: int) -> Surface:
    """Polygons and texture coordinates, counter-clockwise."""
    sets: tuple[Coordinates, ...] = ()
    param = schema.getUVsParam()
    if param.valid() and param.getNumSamples():
        value = param.getIndexedValue(0)
        pairs = np.array(value.getVals(), dtype=np.float32).reshape(-1, 2)
        places = np.fromiter(value.getIndices(), dtype=np.int64)
        if len(places) == points != len(corners):  # of points
            places = places[corners]
        sets = (Coordinates("", pairs, places),)
    names, material = _materials(schema, len(counts))
    found = Surface(counts, corners, sets, tuple(map(Material, names)), material)
    return found.turned(np.ones(len(counts), dtype=bool))


def _materials(schema: Any, polygons: int) -> tuple[list[str], np.ndarray]:
    """Sets of faces, by name, and the one of each polygon; none where they overlap, as those of materials do not."""
    names: list[str] = []
    of_polygon = np.full(polygons, NONE)
    for name in schema.getFaceSetNames():
        faces = schema.getFaceSet(name).getSchema()
        if not faces.getNumSamples():
            continue
        mine = np.array(faces.getValue(0).getFaces(), dtype=np.int64).reshape(-1)
        if len(mine) and (mine.min() < 0 or mine.max() >= polygons):
            raise MeshError(f"a set of faces, {name!r}, names polygons beyond the {polygons:,} there are.")
        if (of_polygon[mine] != NONE).any():
            return [], np.full(polygons, NONE)
        of_polygon[mine] = len(names)
        names.append(name)
    return names, of_polygon
