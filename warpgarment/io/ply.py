"""PLY, ASCII and binary: vertices in the file's order, polygons of any shape."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, TypeAlias, cast

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.plain import read_plain
from warpgarment.io.surface.record import NONE, Coordinates, Surface, say_left_out, worth_keeping

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
TEXTURE = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
Table: TypeAlias = "dict[str, np.ndarray | tuple[np.ndarray, np.ndarray]]"  # numbers; lists: lengths, values end to end
_NONE = np.zeros(0, dtype=np.int64)


class _Element:
    """One element of the header: its name, count, and properties as (name, type, type of the list's length or None)."""

    def __init__(self, name: str, count: int):
        self.name, self.count = name, count
        self.properties: list[tuple[str, str, str | None]] = []


def read_ply(path: Path) -> MeshData:
    """The mesh of a PLY file, with texture coordinates of vertices or of corners; normals and colours are skipped.

    Args:
        path: The file.

    Returns:
        Vertices float32 [V,3] in the file's unit, faces int64 [F,3], and the surface where it says more.

    Raises:
        MeshError: Not a PLY file, cut short, or a face names a vertex that does not exist.
    """
    path = Path(path)
    data = read_plain(path)
    try:
        order, elements, body = _header(data)
        source = _Ascii(body) if order == "" else _Binary(body, order)
        tables = {element.name: source.read(element) for element in elements}
        vertices = np.stack([_numbers(tables["vertex"], axis) for axis in "xyz"], axis=1).astype(np.float64)
        counts, indices = _corners(tables["face"], len(vertices))
        faces = triangulate_counts(vertices, counts, indices)
    except (ValueError, KeyError, IndexError, UnicodeDecodeError) as error:
        raise MeshError(
            f"{path}: not a readable PLY mesh ({type(error).__name__}: {error}). "
            "It is damaged, cut short, or of another kind."
        ) from None
    surface = worth_keeping(path, lambda: Surface(counts, indices, _coordinates(tables, counts, indices)))
    with np.errstate(over="ignore"):
        return MeshData(vertices.astype(np.float32), faces, surface=surface)


def _coordinates(tables: dict[str, Table], counts: np.ndarray, corners: np.ndarray) -> tuple[Coordinates, ...]:
    """Texture coordinates: of corners, a list of as many pairs as a face has corners, else of vertices."""
    wedges = tables["face"].get("texcoord")
    if isinstance(wedges, tuple):
        lengths, values = wedges
        if ((lengths != 2 * counts) & (lengths != 0)).any():
            raise ValueError("lists of texture coordinates that are not two numbers a corner")
        places = np.full(len(corners), NONE)
        has = np.repeat(lengths > 0, counts)
        places[has] = np.arange(np.count_nonzero(has))
        return (Coordinates("", values.reshape(-1, 2), places),) if has.any() else ()
    for u, v in TEXTURE:
        if u in tables["vertex"] and v in tables["vertex"]:
            return (Coordinates("", np.stack([_numbers(tables["vertex"], axis) for axis in (u, v)], axis=1), corners),)
    return ()


def _numbers(table: Table, name: str) -> np.ndarray:
    column = table[name]
    if isinstance(column, tuple):
        raise ValueError(f"{name} is a list")
    return column


def _corners(table: Table, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of corners [P], and vertices of the corners end to end."""
    name = next((key for key in CORNERS if key in table), None)
    if name is None:
        raise ValueError("the faces have no vertex_indices")
    column = table[name]
    if not isinstance(column, tuple):
        raise ValueError(f"{name} is no list")
    counts, indices = column
    if vertex_count == 0 or len(counts) == 0:
        raise ValueError(f"{vertex_count:,} vertices and {len(counts):,} faces; this is not a mesh")
    if (counts < 3).any():
        raise ValueError(f"face {int((counts < 3).argmax())} has {int(counts.min())} corners")
    wrong = ~((indices >= 0) & (indices < vertex_count))  # NaN is neither
    if wrong.any():
        raise ValueError(f"a face names vertex {indices[wrong][0]:g}, and there are {vertex_count:,}")
    if indices.dtype.kind == "f" and (indices != np.floor(indices)).any():
        raise ValueError(f"a face names vertex {indices[indices != np.floor(indices)][0]:g}, which is a fraction")
    return counts, indices.astype(np.int64)


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
            if elements[-1].count < 0:
                raise ValueError(f"{words[2]} elements {words[1]}")
        elif words[0] == "property" and words[1] == "list":
            if TYPES[words[2]][0] == "f":
                raise ValueError(f"the lengths of {words[4]} are of type {words[2]}")
            elements[-1].properties.append((words[4], TYPES[words[3]], TYPES[words[2]]))
        elif words[0] == "property":
            elements[-1].properties.append((words[2], TYPES[words[1]], None))
    if order is None:
        raise ValueError("no format line")
    return order, elements, body


class _Source:
    """Elements one after another, in units of bytes or words; `at` is where the next begins.

    Each reader has the sizes of its types (`size_of`), a list's length at a place (`length_at`), values of rows that
    are equally long (`block`) and values gathered from places (`gather`). Rows that are as long as the first are read
    at once, others after one pass over their lengths alone.
    """

    at = 0
    end = 0

    def size_of(self, kind: str) -> int:
        raise NotImplementedError

    def length_at(self, kind: str, at: int) -> int:
        raise NotImplementedError

    def block(self, kind: str, at: int, row: int, shape: tuple[int, int]) -> np.ndarray:
        raise NotImplementedError

    def gather(self, kind: str, places: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def read(self, element: _Element) -> Table:
        """Columns of an element; the number of elements is believed only as far as the file has room for them."""
        smallest = sum(self.size_of(length or kind) for _, kind, length in element.properties)
        if smallest * element.count > self.end - self.at:
            raise ValueError(f"{element.count:,} elements {element.name} do not fit into what is left of the file")
        if not element.properties or not element.count:
            return {name: (_NONE, _NONE) if length else _NONE for name, _, length in element.properties}
        return self._alike(element) or self._each(element)

    def _alike(self, element: _Element) -> Table | None:
        """All rows at once, where each is as long as the first; otherwise None."""
        places, row, sizes = [], 0, []
        for _, kind, length in element.properties:
            places.append(row)
            sizes.append(self._length(length, self.at + row) if length else 1)
            row += (self.size_of(length) if length else 0) + sizes[-1] * self.size_of(kind)
        if row * element.count > self.end - self.at:
            return None
        table: Table = {}
        for (name, kind, length), place, size in zip(element.properties, places, sizes, strict=True):
            at = self.at + place
            if length is None:
                table[name] = self.block(kind, at, row, (element.count, 1)).reshape(-1)
                continue
            if (self.block(length, at, row, (element.count, 1)) != size).any():
                return None
            values = self.block(kind, at + self.size_of(length), row, (element.count, size)).reshape(-1)
            table[name] = (np.full(element.count, size, dtype=np.int64), values)
        self.at += row * element.count
        return table

    def _each(self, element: _Element) -> Table:
        """Rows of different lengths: where each value lies, then all values of a property together."""
        steps = [(self.size_of(kind), length, self.size_of(length) if length else 0)
                 for _, kind, length in element.properties]  # fmt: skip
        places: list[list[int]] = [[] for _ in steps]
        lengths: list[list[int]] = [[] for _ in steps]
        at = self.at
        for _ in range(element.count):
            for k, (size, length, own) in enumerate(steps):
                count = self._length(length, at) if length else 1
                places[k].append(at + own)
                lengths[k].append(count)
                at += own + count * size
        if at > self.end:
            raise ValueError("too few numbers")
        self.at = at
        table: Table = {}
        for k, (name, kind, length) in enumerate(element.properties):
            first, counts = np.array(places[k]), np.array(lengths[k])
            within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            values = self.gather(kind, np.repeat(first, counts) + steps[k][0] * within)
            table[name] = values if length is None else (counts, values)
        return table

    def _length(self, kind: str, at: int) -> int:
        count = self.length_at(kind, at) if at + self.size_of(kind) <= self.end else -1
        if not 0 <= count <= self.end - at:
            raise ValueError("a list longer than what is left of the file")
        return count


class _Binary(_Source):
    def __init__(self, body: bytes, order: str):
        self.body, self.bytes, self.order, self.end = body, np.frombuffer(body, np.uint8), order, len(body)

    def size_of(self, kind: str) -> int:
        return int(kind[1])

    def length_at(self, kind: str, at: int) -> int:
        order: Literal["little", "big"] = "little" if self.order == "<" else "big"
        return int.from_bytes(self.body[at : at + int(kind[1])], order, signed=kind[0] == "i")

    def block(self, kind: str, at: int, row: int, shape: tuple[int, int]) -> np.ndarray:
        return np.ndarray(shape, self.order + kind, self.body, at, (row, int(kind[1])))

    def gather(self, kind: str, places: np.ndarray) -> np.ndarray:
        size = int(kind[1])
        if len(places) and places[-1] + size > self.end:
            raise ValueError(f"{self.end:,} bytes of data are too few")
        return self.bytes[places[:, None] + np.arange(size)].reshape(-1).view(self.order + kind)


class _Ascii(_Source):
    """Numbers one after another: line breaks mean nothing more than spaces do."""

    def __init__(self, body: bytes):
        self.words = np.array(body.split(), dtype=np.float64)
        self.end = len(self.words)

    def size_of(self, kind: str) -> int:
        return 1

    def length_at(self, kind: str, at: int) -> int:
        count = self.words[at]
        if count != np.floor(count) or not np.isfinite(count):  # NaN is not equal to itself
            raise ValueError(f"a list of {count:g} numbers")
        return int(count)

    def block(self, kind: str, at: int, row: int, shape: tuple[int, int]) -> np.ndarray:
        return np.ndarray(shape, self.words.dtype, self.words, 8 * at, (8 * row, 8))

    def gather(self, kind: str, places: np.ndarray) -> np.ndarray:
        if len(places) and places[-1] >= self.end:
            raise ValueError("too few numbers")
        return self.words[places]


def _read(path: Path, options: ReadOptions) -> MeshData:
    return read_ply(path)


def _write(path: Path, data: MeshData) -> None:
    import trimesh

    say_left_out(path, data.surface, polygons="polygons became triangles")

    content = cast(bytes, trimesh.Trimesh(data.vertices, data.faces, process=False).export(file_type="ply"))
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)


FORMAT = Format(read_mesh=_read, write_mesh=_write)
