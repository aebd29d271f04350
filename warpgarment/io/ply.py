"""PLY, ASCII and binary: vertices in the file's order, polygons of any shape."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias, cast

import numpy as np

from warpgarment.errors import MeshError

from .atomic import atomic_file
from .data import Format, MeshData, ReadOptions
from .polygons import triangulate_counts

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
CORNERS = ("vertex_indices", "vertex_index")
Column: TypeAlias = "np.ndarray | tuple[np.ndarray, np.ndarray]"  # numbers, or lists: their lengths, values end to end


class _Element:
    """One element of the header: its name, count, and properties as (name, type, type of the list's length or None)."""

    def __init__(self, name: str, count: int):
        self.name, self.count = name, count
        self.properties: list[tuple[str, str, str | None]] = []


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a PLY file; other elements and properties (normals, texture, colour) are skipped.

    Args:
        path: The file.

    Returns:
        Vertices float32 [V,3] in the file's unit, faces int64 [F,3].

    Raises:
        MeshError: Not a PLY file, cut short, or a face names a vertex that does not exist.
    """
    path = Path(path)
    data = path.read_bytes()
    try:
        order, elements, body = _header(data)
        cursor = _Ascii(body) if order == "" else _Binary(body, order)
        tables = {element.name: cursor.read(element) for element in elements}
        table = tables["vertex"]
        vertices = np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64)
        counts, indices = next(tables["face"][key] for key in CORNERS if key in tables["face"])
    except (ValueError, KeyError, IndexError, StopIteration, UnicodeDecodeError) as error:
        raise MeshError(
            f"{path}: not a readable PLY mesh ({type(error).__name__}: {error}). "
            "It is damaged, cut short, or of another kind."
        ) from None
    if len(vertices) == 0 or len(counts) == 0:
        raise MeshError(f"{path}: {len(vertices):,} vertices and {len(counts):,} faces; this is not a mesh.")
    if (counts < 3).any() or indices.min() < 0 or indices.max() >= len(vertices):
        raise MeshError(f"{path}: faces with fewer than three corners, or beyond the {len(vertices):,} vertices.")
    return vertices.astype(np.float32), triangulate_counts(vertices, counts, indices)


def _header(data: bytes) -> tuple[str, list[_Element], bytes]:
    head, found, body = data.partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii").splitlines() if line.strip()]
    if not found or not lines or lines[0] != ["ply"]:
        raise ValueError("no PLY header")
    body = body[2:] if body.startswith(b"\r\n") else body[1:]
    order, elements = None, []
    for words in lines[1:]:
        if words[0] == "format":
            order = ORDERS[words[1]]
        elif words[0] == "element":
            elements.append(_Element(words[1], int(words[2])))
        elif words[0] == "property" and words[1] == "list":
            elements[-1].properties.append((words[4], TYPES[words[3]], TYPES[words[2]]))
        elif words[0] == "property":
            elements[-1].properties.append((words[2], TYPES[words[1]], None))
    if order is None:
        raise ValueError("no format line")
    return order, elements, body


class _Binary:
    """Reads rows of fixed size at once, and rows with lists too as long as these have the first row's lengths."""

    def __init__(self, body: bytes, order: str):
        self.body, self.order, self.at = body, order, 0

    def take(self, kind: str, count: int = 1) -> np.ndarray:
        dtype = np.dtype(self.order + kind)
        if self.at + dtype.itemsize * count > len(self.body):
            raise ValueError(f"{len(self.body):,} bytes of data are too few")
        values = np.frombuffer(self.body, dtype, count, self.at)
        self.at += dtype.itemsize * count
        return values

    def read(self, element: _Element) -> dict:
        return self._uniform(element) or _collect(element, self.take)

    def _uniform(self, element: _Element) -> dict[str, Column] | None:
        start = self.at
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for name, kind, length in element.properties if element.count else ():
            if length is None:
                fields.append((name, self.order + kind))
                self.take(kind)
            else:
                size = int(self.take(length)[0])
                fields += [(f"{name}#", self.order + length), (name, self.order + kind, (size,))]
                self.take(kind, size)
        self.at = start
        dtype = np.dtype(fields)
        if not fields or start + dtype.itemsize * element.count > len(self.body):
            return None
        rows = np.frombuffer(self.body, dtype, element.count, start)
        table: dict[str, Column] = {}
        for name, _, length in element.properties:
            table[name] = rows[name]
            if length is not None:
                if (rows[f"{name}#"] != rows[name].shape[1]).any():
                    return None
                table[name] = (rows[f"{name}#"].astype(np.int64), rows[name].reshape(-1))
        self.at = start + dtype.itemsize * element.count
        return table


class _Ascii:
    """Reads numbers one after another: line breaks mean nothing more than spaces do."""

    def __init__(self, body: bytes):
        self.words, self.at = body.split(), 0

    def take(self, kind: str, count: int = 1) -> np.ndarray:
        words = self.words[self.at : self.at + count]
        if len(words) < count:
            raise ValueError("too few numbers")
        self.at += count
        return np.array(words, dtype=np.float64).astype(np.dtype(kind))

    def read(self, element: _Element) -> dict:
        if element.properties and all(length is None for _, _, length in element.properties):
            columns = self.take("f8", element.count * len(element.properties)).reshape(element.count, -1).T
            return {name: column for (name, _, _), column in zip(element.properties, columns, strict=True)}
        return _collect(element, self.take)


def _collect(element: _Element, take: Callable[..., np.ndarray]) -> dict[str, Column]:
    """Row by row; lists become (lengths, values end to end)."""
    rows: dict[str, list[np.ndarray]] = {name: [] for name, _, _ in element.properties}
    for _ in range(element.count):
        for name, kind, length in element.properties:
            rows[name].append(take(kind, 1 if length is None else int(take(length)[0])))
    table: dict[str, Column] = {}
    for name, kind, length in element.properties:
        values = np.concatenate([np.zeros(0, dtype=kind), *rows[name]])
        sizes = np.array([len(row) for row in rows[name]], dtype=np.int64)
        table[name] = values if length is None else (sizes, values)
    return table


def _read(path: Path, options: ReadOptions) -> MeshData:
    return MeshData(*read_ply(path))


def _write(path: Path, data: MeshData) -> None:
    import trimesh

    content = cast(bytes, trimesh.Trimesh(data.vertices, data.faces, process=False).export(file_type="ply"))
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)


FORMAT = Format(read_mesh=_read, write_mesh=_write)
