"""Wavefront OBJ: one vertex per `v` line, in the file's order, whatever its texture seams, groups and materials.

Own reader, because readers made for rendering split vertices at seams and meshes at materials, and motion is per
vertex.
"""

from __future__ import annotations

import codecs
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.atomic import atomic_files
from warpgarment.io.disk.plain import read_plain
from warpgarment.io.surface.obj import OBJ_KEEPS, Around, Looks, obj_files, text_around, without_unused
from warpgarment.io.surface.record import Labels, Surface, of_triangles, say_left_out, worth_keeping

from .data import Format, Holds, MeshData, ReadOptions
from .parts import ALL, Parts, connected_pieces, listed, named, unconnected, used_only
from .polygons import triangulate_counts

CONTINUED = ("v", "f", "vt", "vn", "vp", "l", "p")  # lines of numbers, which a backslash at the end continues


class ObjMesh(NamedTuple):
    """What an OBJ file holds.

    Attributes:
        vertices: Positions, float64 [V,3].
        counts: Corners of each polygon [P].
        corners: Vertices of the corners, end to end.
        objects: By the `o` line above each polygon.
        groups: By the `g` line above each polygon.
        looks: Texture coordinates and materials.
    """

    vertices: np.ndarray
    counts: np.ndarray
    corners: np.ndarray
    objects: Parts
    groups: Parts
    looks: Looks


def read_obj(path: Path, mesh: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of an OBJ file.

    Reads `v` (further numbers such as colours are ignored), `f` with `a`, `a/b`, `a//c` or `a/b/c`, negative indices,
    lines of numbers continued with a backslash, `o` and `g`; everything else is skipped.

    Args:
        path: The file.
        mesh: Name of an object, else of a group; "*" reads everything as one mesh.

    Returns:
        Vertices float32 [V,3] in the file's unit, faces int64 [F,3]. Where a part is read, those vertices that its
        faces name, in the file's order.

    Raises:
        MeshError: Not an OBJ file, cut short, or a face names a vertex that does not exist, with the line; no such
            part; or several objects that are not connected, and none was named.

    Warns:
        UserWarning: Several groups that are not connected, and none was named.
    """
    found = _mesh(path, read_polygons(path), mesh)
    return found.vertices, found.faces


def _mesh(path: Path, found: ObjMesh, mesh: str | None) -> MeshData:
    used, vertices, counts, corners = chosen_polygons(path, found, mesh)
    faces = _triangles(path, vertices, counts, corners)
    with np.errstate(over="ignore"):
        return MeshData(vertices.astype(np.float32), faces, surface=surface_of(path, found, mesh, used))


def _triangles(path: Path, vertices: np.ndarray, counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    try:
        return triangulate_counts(vertices, counts, corners)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None


def chosen_polygons(
    path: Path, found: ObjMesh, mesh: str | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The part that `read_obj` reads: indices of its vertices in the file, and vertices, counts, corners."""
    everything = np.arange(len(found.vertices)), found.vertices, found.counts, found.corners
    if mesh == ALL:
        return everything
    if mesh is None:
        pieces = connected_pieces(len(found.vertices), found.counts, found.corners)
        objects = found.objects.used()
        if unconnected(found.objects, pieces):
            raise MeshError(
                f"{path}: {len(objects)} objects: {listed(objects)}. Name one with mesh=, or read them as one with "
                f'mesh="{ALL}".'
            )
        if len(objects) < 2 and unconnected(found.groups, pieces):  # they may as well be panels of one garment
            names = found.groups.used()
            warnings.warn(
                f"{path}: {len(names)} groups that are not connected are read as one mesh: {listed(names)}. "
                "Name one with mesh=.",
                UserWarning,
                stacklevel=7,
            )
        return everything
    polygons = named(path, mesh, found.objects, found.groups)
    used, corners = used_only(len(found.vertices), found.corners[np.repeat(polygons, found.counts)])
    return used, found.vertices[used], found.counts[polygons], corners


def surface_of(path: Path, found: ObjMesh, mesh: str | None, used: np.ndarray) -> Surface | None:
    """The surface of the part that `chosen_polygons` has chosen, whose vertices in the file are `used`."""

    def make() -> Surface:
        objects, groups = (Labels(tuple(p.names)[1:], p.of_polygon - 1) for p in (found.objects, found.groups))
        whole = found.looks.surface(path, found.counts, found.corners, objects, groups)
        if mesh in (None, ALL):
            return without_unused(whole)
        part = whole.only(named(path, str(mesh), found.objects, found.groups))
        return without_unused(replace(part, corners=np.searchsorted(used, part.corners)))

    return worth_keeping(path, make)


def read_polygons(path: Path, *, dressed: bool = True) -> ObjMesh:
    """An OBJ file as it is, or without its looks; raises as `read_obj`."""
    vertices: list[list[float]] = []
    counts: list[int] = []
    corners: list[int] = []
    objects, groups = {"": 0}, {"": 0}
    of_object: list[int] = []
    of_group: list[int] = []
    name = group = 0
    looks = Looks()
    for number, line in _lines(path):
        words = line.split()
        try:
            if words[0] == "v":
                position = [float(word) for word in words[1:4]]
                if len(position) < 3:
                    raise ValueError("a vertex needs three numbers")
                vertices.append(position)
            elif words[0] == "f":
                corners += _corners(words[1:], len(vertices))
                counts.append(len(words) - 1)
                of_object.append(name)
                of_group.append(group)
                if dressed:
                    looks.face(words[1:])
            elif words[0] == "o":
                name = objects.setdefault(" ".join(words[1:]), len(objects))
            elif words[0] == "g":
                group = groups.setdefault(" ".join(words[1:]), len(groups))
            elif dressed:
                looks.line(number, line)
        except ValueError as error:
            raise MeshError(f"{path}, line {number}: {error}. The file is damaged or cut short.") from None
    if not vertices or not counts:
        raise MeshError(f"{path}: {len(vertices):,} vertices and {len(counts):,} faces; is this an OBJ file of a mesh?")
    indices = np.array(corners, dtype=np.int64)
    starts = (np.cumsum(counts) - counts).astype(np.int64)
    beyond = np.add.reduceat(indices >= len(vertices), starts) > 0
    if beyond.any():
        raise MeshError(
            f"{path}: {beyond.sum():,} of {len(counts):,} faces name vertices beyond the {len(vertices):,} of the "
            f"file (first: vertex {indices[indices >= len(vertices)][0] + 1}). The file is damaged or cut short."
        )
    named_objects = Parts(list(objects), np.array(of_object))
    named_groups = Parts(list(groups), np.array(of_group), several=True)
    return ObjMesh(np.array(vertices, dtype=np.float64), np.array(counts), indices, named_objects, named_groups, looks)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines that say something, without comments; lines of numbers with those that continue them."""
    data = read_plain(path, text=True)
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = data.decode("utf-16" if wide else "utf-8-sig", errors="replace" if wide else "surrogateescape")
    if "\0" in text[:4096]:
        raise MeshError(f"{path}: binary data; this is not an OBJ file.")
    pending, start = "", 0
    for number, line in enumerate(text.splitlines(), 1):
        line = line.split("#", 1)[0].strip()
        line = f"{pending} {line}" if pending else line
        start = start if pending else number
        if line.endswith("\\") and line.split(None, 1)[0] in CONTINUED:
            pending = line[:-1].rstrip()
            continue
        pending = ""
        if line:
            yield start, line
    if pending:
        yield start, pending


def _corners(words: list[str], count: int) -> list[int]:
    if len(words) < 3:
        raise ValueError(f"a face needs three corners, got {len(words)}")
    corners = []
    for word in words:
        index = int(word.split("/", 1)[0])
        index = index - 1 if index > 0 else count + index if index < 0 else -1
        if not 0 <= index < 2**31:
            raise ValueError(f"corner {word!r} names a vertex before the first or beyond any last")
        corners.append(index)
    return corners


def obj_text(vertices: np.ndarray, faces: np.ndarray, name: str = "", around: Around | None = None) -> str:
    """An OBJ file's text.

    Args:
        vertices: Positions [V,3].
        faces: Triangles [F,3].
        name: Of the object.
        around: What to write beside the vertices instead of the triangles and the name.
    """
    return (around or text_around(of_triangles(faces), name)).of(vertices)


def obj_holds(path: Path) -> Holds:
    """Names of the objects of an OBJ file that have faces, or of its groups where it has no two objects."""
    objects: dict[str, None] = {}
    groups: dict[str, None] = {}
    name = group = ""
    for _, line in _lines(path):
        if line.startswith("f"):
            objects[name] = groups[group] = None
        elif line.startswith(("o ", "o\t")):
            name = " ".join(line.split()[1:])
        elif line.startswith(("g ", "g\t")):
            group = " ".join(line.split()[1:])
    named = [[name for name in kind if name] for kind in (objects, groups)]
    return Holds(tuple(named[1] if len(named[0]) < 2 and len(named[1]) > 1 else named[0]))


def _read(path: Path, options: ReadOptions) -> MeshData:
    return _mesh(path, read_polygons(path), options.mesh)


def _write(path: Path, data: MeshData) -> None:
    say_left_out(path, data.surface, sets=1, keeps=OBJ_KEEPS)
    texts = obj_files(path, data.vertices, data.faces, data.name, data.surface)
    with atomic_files(*texts) as temporary:
        for file, text in zip(temporary, texts.values(), strict=True):
            file.write_text(text, encoding="utf-8")


FORMAT = Format(read_mesh=_read, write_mesh=_write, named=True, holds=obj_holds)
