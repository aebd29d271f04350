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

KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
LOOKS = ("KHR_mesh_quantization", "KHR_lights_punctual", "KHR_xmp_json_ld")
EMPTY = 4_000_000  # numbers of an accessor without data: zeros, which a few bytes could ask for without end


class Document:
    """A glTF document.

    Errors are those of Python (ValueError, KeyError, ...); `gltf.read` makes one of them that names the file.

    Attributes:
        json: The document.
        size: Bytes of the document and its buffers.

    Args:
        path: A .glb or .gltf file; other files that it names must lie in or below its folder.
    """

    def __init__(self, path: Path):
        data = read_plain(path)
        self._folder, binary = path.parent, None
        if data.startswith(b"glTF"):
            data, binary = _chunks(data)
        self.json = json.loads(data.decode("utf-8-sig"))
        if not isinstance(self.json, dict) or not str(self.json.get("asset", {}).get("version", "")).startswith("2"):
            raise ValueError("no glTF 2 document")
        needed = [name for name in self.json.get("extensionsRequired", []) if not _is_looks(str(name))]
        if needed:
            raise ValueError(
                f"it needs {', '.join(map(str, needed))}, which is not read; export it without compression"
            )
        self._buffers = [self._buffer(entry, binary if k == 0 else None)
                         for k, entry in enumerate(self.json.get("buffers", []))]  # fmt: skip
        self._arrays: dict[int, np.ndarray] = {}
        self.size = len(data) + sum(map(len, self._buffers))

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """An entry of a list of the document, such as `nodes`."""
        entries = self.json.get(kind, [])
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(entries):
            raise ValueError(f"{kind} has no entry {index!r}")
        if not isinstance(entries[index], dict):
            raise ValueError(f"entry {index} of {kind} is no object")
        return entries[index]

    def array(self, index: Any) -> np.ndarray:
        """An accessor's values, [N] or [N,width]; integers that stand for fractions become these."""
        entry = self.item("accessors", index)
        if index not in self._arrays:
            count, width = whole(entry.get("count", 0)), WIDTHS[entry["type"]]
            if "bufferView" in entry:
                found = self._values(entry, entry["componentType"], width, count)
            elif count * width > EMPTY:
                raise ValueError(f"an accessor of {count:,} values without data")
            else:
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
            raise ValueError(f"there is no buffer {buffer}")
        dtype = np.dtype(KINDS[kind])
        stride = whole(view.get("byteStride", 0)) or dtype.itemsize * width
        start, inside = whole(view.get("byteOffset", 0)), whole(entry.get("byteOffset", 0))
        length, data = whole(view["byteLength"]), self._buffers[buffer]
        if (count and inside + (count - 1) * stride + dtype.itemsize * width > length) or start + length > len(data):
            raise ValueError(f"an accessor of {count:,} values does not fit into its {length:,} bytes")
        return np.ndarray((count, width), dtype, data, start + inside, (stride, dtype.itemsize))

    def _replaced(self, values: np.ndarray, sparse: dict[str, Any], kind: int) -> np.ndarray:
        count, values = whole(sparse["count"]), values.copy()
        places = self._values(sparse["indices"], sparse["indices"]["componentType"], 1, count)[:, 0]
        if places.dtype.kind not in "u" or (count and places.max() >= len(values)):
            raise ValueError("a sparse accessor replaces values that there are not")
        values[places] = self._values(sparse["values"], kind, values.shape[1], count)
        return values

    def _buffer(self, entry: dict[str, Any], binary: bytes | None) -> bytes:
        uri, length = entry.get("uri"), whole(entry["byteLength"])
        if uri is None:
            data = b"" if binary is None else binary
        elif str(uri).startswith("data:"):
            data = base64.b64decode(str(uri).partition(",")[2], validate=True)
        else:
            path = (self._folder / unquote(str(uri))).resolve()
            if not path.is_relative_to(self._folder.resolve()) or not path.is_file():
                raise ValueError(f"its buffer {uri!r} is not in its folder")
            data = read_plain(path)
        if len(data) < length:
            raise ValueError(f"a buffer of {length:,} bytes holds {len(data):,}")
        return data


def whole(number: Any) -> int:
    """A count or offset.

    Raises:
        ValueError: It is no whole number, or negative.
    """
    if isinstance(number, bool) or not isinstance(number, (int, float)) or number != int(number) or number < 0:
        raise ValueError(f"{number!r} is no count")
    return int(number)


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a .glb."""
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2 or length > len(data):
        raise ValueError(f"version {version}, {len(data):,} of {length:,} bytes")
    at, found = 12, []
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise ValueError("a chunk is longer than the file")
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if not found or found[0][0] != 0x4E4F534A:
        raise ValueError("the first chunk is no JSON")
    return found[0][1], next((chunk for kind, chunk in found[1:] if kind == 0x004E4942), None)


def _is_looks(extension: str) -> bool:
    """Whether an extension changes nothing of where vertices are."""
    return "material" in extension or "texture" in extension or extension in LOOKS
