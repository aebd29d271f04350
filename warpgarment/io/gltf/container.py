"""glTF 2.0 files: the JSON document, its buffers, and accessors as arrays, every index and size checked."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from warpgarment.io.disk.plain import read_plain

from .schema import DOCUMENT, KINDS, WIDTHS, Damaged

LOOKS = ("KHR_mesh_quantization", "KHR_lights_punctual", "KHR_xmp_json_ld")
EMPTY = 4_000_000  # numbers of accessors without data: zeros, which a few bytes could ask for without end


class Document:
    """A glTF document.

    All that is read of it is checked by `schema` first, so that what is no glTF is `Damaged` and never an error of
    Python, which would be a fault of this package.

    Attributes:
        json: The document.
        size: Bytes of the document and its buffers.

    Args:
        path: A .glb or .gltf file; other files that it names must lie in or below its folder.

    Raises:
        Damaged: It is no such document, or one that needs a compression.
    """

    def __init__(self, path: Path):
        data = read_plain(path)
        self._folder, binary = path.parent, None
        if data.startswith(b"glTF"):
            data, binary = _chunks(data)
        try:
            self.json = json.loads(data.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise Damaged(f"no JSON: {str(error)[:100]}") from None
        DOCUMENT("the document", self.json)
        if not self.json["asset"]["version"].startswith("2"):
            raise Damaged("no glTF 2 document")
        needed = [name for name in self.json.get("extensionsRequired", []) if not _is_looks(name)]
        if needed:
            raise Damaged(f"it needs {', '.join(needed)}, which is not read; export it without compression")
        self._buffers = [self._buffer(entry, binary if k == 0 else None)
                         for k, entry in enumerate(self.json.get("buffers", []))]  # fmt: skip
        self._arrays: dict[int, np.ndarray] = {}
        self._empty = 0
        self.size = len(data) + sum(map(len, self._buffers))

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """An entry of a list of the document, such as `nodes`."""
        entries = self.json.get(kind, [])
        if not 0 <= index < len(entries):
            raise Damaged(f"{kind} has no entry {index!r}")
        return entries[index]

    def array(self, index: Any) -> np.ndarray:
        """An accessor's values, [N] or [N,width]; integers that stand for fractions become these."""
        entry = self.item("accessors", index)
        if index not in self._arrays:
            count, width = whole(entry.get("count", 0)), WIDTHS[entry["type"]]
            if "bufferView" in entry:
                found = self._values(entry, entry["componentType"], width, count)
            else:
                self._empty += count * width
                if self._empty > EMPTY:
                    raise Damaged(f"accessors of {self._empty:,} values without data")
                found = np.zeros((count, width), KINDS[entry["componentType"]])
            if "sparse" in entry:
                found = self._replaced(found, entry["sparse"], entry["componentType"])
            if entry.get("normalized") and found.dtype.kind in "iu":
                found = np.maximum(found / np.iinfo(found.dtype).max, -1.0)
            self._arrays[index] = found[:, 0] if width == 1 else found
        return self._arrays[index]

    def _values(self, entry: dict[str, Any], kind: int, width: int, count: int) -> np.ndarray:
        view = self.item("bufferViews", entry["bufferView"])
        buffer = whole(view["buffer"])
        if buffer >= len(self._buffers):
            raise Damaged(f"there is no buffer {buffer}")
        dtype = np.dtype(KINDS[kind])
        stride = whole(view.get("byteStride", 0)) or dtype.itemsize * width
        start, inside = whole(view.get("byteOffset", 0)), whole(entry.get("byteOffset", 0))
        length, data = whole(view["byteLength"]), self._buffers[buffer]
        if (count and inside + (count - 1) * stride + dtype.itemsize * width > length) or start + length > len(data):
            raise Damaged(f"an accessor of {count:,} values does not fit into its {length:,} bytes")
        if count == 0:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, data, start + inside, (stride, dtype.itemsize))

    def _replaced(self, values: np.ndarray, sparse: dict[str, Any], kind: int) -> np.ndarray:
        count, values = whole(sparse["count"]), values.copy()
        places = self._values(sparse["indices"], sparse["indices"]["componentType"], 1, count)[:, 0]
        if places.dtype.kind not in "u" or (count and places.max() >= len(values)):
            raise Damaged("a sparse accessor replaces values that there are not")
        values[places] = self._values(sparse["values"], kind, values.shape[1], count)
        return values

    def _buffer(self, entry: dict[str, Any], binary: bytes | None) -> bytes:
        uri, length = entry.get("uri"), whole(entry["byteLength"])
        if uri is None:
            data = b"" if binary is None else binary
        elif uri.startswith("data:"):
            try:
                data = base64.b64decode(uri.partition(",")[2], validate=True)
            except ValueError as error:
                raise Damaged(f"a buffer that is no text in base64: {error}") from None
        else:
            data = read_plain(self._beside(uri))
        if len(data) < length:
            raise Damaged(f"a buffer of {length:,} bytes holds {len(data):,}")
        return data

    def _beside(self, uri: str) -> Path:
        """The file of a buffer, in or below the folder of the document."""
        try:
            path = (self._folder / unquote(uri)).resolve()
            if path.is_relative_to(self._folder.resolve()) and path.is_file():
                return path
        except (OSError, ValueError):  # a name that is too long, or holds a zero
            pass
        raise Damaged(f"its buffer {uri[:80]!r} is not in its folder")


def whole(number: Any) -> int:
    """A count or offset, which JSON may have as 12.0."""
    return int(number)


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a .glb."""
    if len(data) < 12:
        raise Damaged(f"{len(data)} bytes")
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2 or length > len(data):
        raise Damaged(f"version {version}, {len(data):,} of {length:,} bytes")
    at, found = 12, []
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise Damaged("a chunk is longer than the file")
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if not found or found[0][0] != 0x4E4F534A:
        raise Damaged("the first chunk is no JSON")
    return found[0][1], next((chunk for kind, chunk in found[1:] if kind == 0x004E4942), None)


def _is_looks(extension: str) -> bool:
    """Whether an extension changes nothing of where vertices are."""
    return "material" in extension or "texture" in extension or extension in LOOKS
