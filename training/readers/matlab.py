"""MATLAB 5 files as plain dictionaries.

SciPy reads them, and trusts what is inside: a size that lies can end the process. So the variables that are wanted are
walked through first, after "MAT-File Format", The MathWorks, chapter 1: every element lies within the one around it,
and every array has as many numbers or letters as its dimensions say.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import read_plain

LARGEST = 1 << 28  # of a file, and of what a variable unpacks to [bytes]; an info.mat has some hundred thousand
DEEPEST = 16  # structs and cells within each other
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8}  # type of numbers -> bytes of one
_TEXTS = {16: "utf-8", 17: "utf-16", 18: "utf-32"}
_NUMBERS, _TEXT, _TEXT_KINDS = range(6, 16), 4, (1, 2, 4)
_MATRIX, _COMPRESSED, _STRUCT, _CELL = 14, 15, 2, 1


def read_mat(path: str | Path, names: Sequence[str], required: Sequence[str] = ()) -> dict[str, Any]:
    """Variables of a MATLAB 5 file by name; structs become dictionaries, single elements scalars.

    SciPy's reader supports numbers, text and structs only: nothing in such a file is executed.

    Args:
        path: File to read.
        names: Names of the variables to read, if the file has them.
        required: Names of the variables that the file must have.

    Raises:
        MeshError: The file is of another kind, damaged, too large, or lacks a required variable.
        FileNotFoundError: There is no such file.
    """
    from scipy.io import loadmat, whosmat

    path = Path(path)
    data = read_plain(path, LARGEST)
    try:
        _check(data, names)
        present = [name for name, _, _ in whosmat(str(path), appendmat=False)]
        data = loadmat(str(path), simplify_cells=True, variable_names=list(names), appendmat=False)
    except FileNotFoundError:
        raise
    except Exception as error:  # SciPy's reader raises errors of many classes
        raise MeshError(
            f"{path}: not a readable MATLAB 5 file ({type(error).__name__}: {error}). "
            "It is damaged, cut short, or of another version; MATLAB 7.3 files must be saved again as version 7."
        ) from None
    missing = [name for name in required if name not in data]
    if missing:
        raise MeshError(f"{path}: no variable named {missing[0]!r}; the file holds {', '.join(present) or 'nothing'}.")
    return {name: data[name] for name in names if name in data}


def _check(data: bytes, names: Sequence[str]) -> None:
    """Raises ValueError unless the variables of a file that have these names are whole."""
    if len(data) < 128 or data[126:128] not in (b"IM", b"MI"):
        raise ValueError("no header of MATLAB 5")
    order = "<" if data[126:128] == b"IM" else ">"
    for kind, element in _elements(data[128:], order, padded=False):
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            element = unpacker.decompress(element, LARGEST)
            if unpacker.unconsumed_tail or not unpacker.eof:
                raise ValueError("a variable that is cut short, or unpacks to too much")
            kind, element = next(_elements(element, order), (0, b""))
        if kind != _MATRIX:
            raise ValueError(f"an element of type {kind} where a variable should be")
        _matrix(element, order, 0, names)


def _elements(data: bytes, order: str, padded: bool = True) -> Iterator[tuple[int, bytes]]:
    """Types and bytes of the elements in some bytes."""
    at = 0
    while at < len(data):
        if at + 8 > len(data):
            raise ValueError("half an element")
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:  # a small element: both numbers in one word, and the data behind it
            kind, size, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
            if size > 4:
                raise ValueError("a small element of more than four bytes")
        else:
            start = at + 8
            end = start + size + (-size % 8 if padded or kind != _COMPRESSED else 0)
        if start + size > len(data):
            raise ValueError("an element that is longer than what it lies in")
        yield kind, data[start : start + size]
        at = end


def _matrix(data: bytes, order: str, depth: int, names: Sequence[str] | None) -> None:
    """Raises ValueError unless an array, a text, a struct or a cell is whole; others of `names` are not looked into."""
    if not data:
        return  # an array of nothing
    parts = _elements(data, order)
    flags, sizes, name = (_part(parts, kinds) for kinds in ((6,), (5,), (1, 2)))
    if len(flags) != 8 or len(sizes) < 8 or len(sizes) % 4 or depth > DEEPEST:
        raise ValueError("no flags or dimensions, or arrays that are too deep")
    word, shape = struct.unpack_from(f"{order}I", flags)[0], struct.unpack(f"{order}{len(sizes) // 4}i", sizes)
    if min(shape) < 0 or math.prod(shape) > LARGEST:
        raise ValueError(f"an array of shape {list(shape)}")
    if names is not None and name.decode("latin-1") not in names:
        return
    kind, count = word & 0xFF, math.prod(shape)
    if kind in _NUMBERS:
        for _ in range(2 if word & 0x0800 else 1):
            _numbers(parts, count)
    elif kind == _TEXT:
        _letters(parts, count)
    elif kind in (_STRUCT, _CELL):
        fields = _fields(parts, order) if kind == _STRUCT else 1
        for _ in range(count * fields):
            _matrix(_part(parts, (_MATRIX,)), order, depth + 1, None)
    else:
        raise ValueError(f"an array of class {kind}, which is neither numbers, text, struct nor cell")


def _part(parts: Iterator[tuple[int, bytes]], kinds: Sequence[int]) -> bytes:
    """The next element, which must be of one of these types."""
    kind, data = next(parts, (0, b""))
    if kind not in kinds:
        raise ValueError(f"an element of type {kind} where one of {', '.join(map(str, kinds))} should be")
    return data


def _numbers(parts: Iterator[tuple[int, bytes]], count: int) -> None:
    kind, data = next(parts, (0, b""))
    if kind not in _SIZES or len(data) != count * _SIZES[kind]:
        raise ValueError(f"{len(data)} bytes of type {kind} for {count:,} numbers")


def _letters(parts: Iterator[tuple[int, bytes]], count: int) -> None:
    kind, data = next(parts, (0, b""))
    if kind in _TEXTS:
        found = len(data.decode(_TEXTS[kind]))
    elif kind in _TEXT_KINDS:
        found = len(data) // _SIZES[kind]
    else:
        raise ValueError(f"an element of type {kind} where text should be")
    if found != count:
        raise ValueError(f"{found:,} letters of {count:,}")


def _fields(parts: Iterator[tuple[int, bytes]], order: str) -> int:
    """Number of the fields of a struct, from the length of each name and the names."""
    length, names = _part(parts, (5,)), _part(parts, (1, 2))
    size = struct.unpack(f"{order}i", length)[0] if len(length) == 4 else 0
    if size < 1 or len(names) % size:
        raise ValueError(f"names of {size} letters in {len(names)} bytes")
    return len(names) // size
