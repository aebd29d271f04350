"""Wavefront OBJ: one vertex per `v` line, in the file's order, whatever its texture seams, groups and materials.

Own reader, because readers made for rendering split vertices at seams and meshes at materials, and motion is per
vertex.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError

from .atomic import atomic_file
from .data import Format, MeshData, ReadOptions
from .polygons import triangulate


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of an OBJ file.

    Reads `v` (further numbers such as colours are ignored) and `f` with `a`, `a/b`, `a//c` or `a/b/c`, negative
    indices, lines continued with a backslash; everything else is skipped.

    Args:
        path: The file.

    Returns:
        Vertices float32 [V,3] in the file's unit, faces int64 [F,3].

    Raises:
        MeshError: Not an OBJ file, cut short, or a face names a vertex that does not exist; with the line.
    """
    vertices, polygons = read_polygons(path)
    return vertices.astype(np.float32), triangulate(vertices, polygons)


def read_polygons(path: Path) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices, float64 [V,3], and corners of each polygon of an OBJ file; otherwise as `read_obj`."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        try:
            if words[0] == "v":
                position = [float(word) for word in words[1:4]]
                if len(position) < 3:
                    raise ValueError("a vertex needs three numbers")
                vertices.append(position)
            elif words[0] == "f":
                polygons.append(_corners(words[1:], len(vertices)))
        except ValueError as error:
            raise MeshError(f"{path}, line {number}: {error}. The file is damaged or cut short.") from None
    if not vertices or not polygons:
        raise MeshError(
            f"{path}: {len(vertices):,} vertices and {len(polygons):,} faces; is this an OBJ file of a mesh?"
        )
    positions = np.array(vertices, dtype=np.float64)
    beyond = [p for p in polygons if max(p) >= len(vertices)]
    if beyond:
        raise MeshError(
            f"{path}: {len(beyond):,} of {len(polygons):,} faces name vertices beyond the {len(vertices):,} of the "
            f"file (first: vertex {max(beyond[0]) + 1}). The file is damaged or cut short."
        )
    return positions, polygons


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments, continued ones joined."""
    try:
        text = path.read_text(encoding="utf-8", errors="surrogateescape")
    except IsADirectoryError:
        raise MeshError(f"{path} is a folder, not an OBJ file.") from None
    if "\0" in text[:4096]:
        raise MeshError(f"{path}: binary data; this is not an OBJ file.")
    pending = ""
    start: int | None = None
    for number, line in enumerate(text.splitlines(), 1):
        line = line.split("#", 1)[0]
        start = start or number
        if line.rstrip().endswith("\\"):
            pending += line.rstrip()[:-1] + " "
            continue
        yield start, pending + line
        pending, start = "", None
    if pending and start is not None:
        yield start, pending


def _corners(words: list[str], count: int) -> list[int]:
    if len(words) < 3:
        raise ValueError(f"a face needs three corners, got {len(words)}")
    corners = []
    for word in words:
        index = int(word.split("/", 1)[0])
        index = index - 1 if index > 0 else count + index if index < 0 else -1
        if index < 0:
            raise ValueError(f"corner {word!r} names a vertex before the first")
        corners.append(index)
    return corners


def obj_text(vertices: np.ndarray, faces: np.ndarray, name: str = "") -> str:
    """An OBJ file's text; nine digits give every float32 back."""
    lines = [f"o {name.split()[0]}"] if name.split() else []
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
    return "\n".join(lines) + "\n"


def _read(path: Path, options: ReadOptions) -> MeshData:
    return MeshData(*read_obj(path))


def _write(path: Path, data: MeshData) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text(obj_text(data.vertices, data.faces, data.name), encoding="utf-8")


FORMAT = Format(read_mesh=_read, write_mesh=_write)
