"""Damage within the structure of a file, so that the rest of it is sound: JSON, .npy, archives, .glb, safetensors."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np

from .damage import BYTES, Damage

VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1.5, 1e308, 2**31, 2**63, 10**400, float("nan"), float("inf"), "", "x", "../x", "\0", [], {},
    [[]], {"a": {}}, [1, "x"], "|<b>`", "9" * 500, ["x"] * 50, [0.0] * 50, 10**9,
)  # fmt: skip
_EXTREME = (np.nan, np.inf, -np.inf, 1e30, -1.0, 0.0)


def any_value(value: Any, rng: Random) -> Any:
    """The document, with something in it missing, of another type, doubled, renamed, or nested deeply."""
    places: list[tuple[Any, Any]] = []
    level: list[Any] = [value]
    while level:
        part = level.pop()
        keys = list(part) if isinstance(part, dict) else list(range(len(part))) if isinstance(part, list) else []
        places += [(part, key) for key in keys[:60]]
        level += [part[key] for key in keys[:60]]
    if not places:
        return rng.choice(VALUES)
    part, key = rng.choice(places)
    change = rng.randrange(7)
    if change == 0:
        del part[key]
    elif change == 1:
        part[key] = rng.choice(places)[0]
        try:
            json.dumps(part)
        except ValueError:  # it holds itself
            part[key] = None
    elif change == 2 and isinstance(part, list):
        part.insert(key, part[key])
    elif change == 3 and isinstance(part, dict):
        part[rng.choice(("x", "", str(key) + "s", str(key).upper()))] = part.pop(key)
    elif change == 4 and isinstance(part[key], (int, float)):
        part[key] = rng.choice((-part[key], part[key] + 1, part[key] * 1000, str(part[key]), float(part[key])))
    elif change == 5:
        nested: Any = 1
        for _ in range(rng.choice((3, 40, 200))):
            nested = {"a": nested} if rng.random() < 0.5 else [nested]
        part[key] = nested
    else:
        part[key] = rng.choice(VALUES)
    return value


def document(data: bytes, rng: Random) -> bytes | None:
    """JSON, of which a value is another."""
    try:
        return json.dumps(any_value(json.loads(data), rng)).encode()
    except (ValueError, RecursionError):
        return None


def every_line(data: bytes, rng: Random) -> bytes | None:
    """Lines of JSON, of one of which a value is another."""
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    lines[at] = document(lines[at], rng) or b"{"
    return b"\n".join(lines)


def reformatted(data: bytes, rng: Random) -> bytes | None:
    """JSON with other spaces: nothing changes."""
    try:
        return json.dumps(json.loads(data), indent=rng.choice((None, 1, 4))).encode()
    except (ValueError, RecursionError):
        return None


def chunk(data: bytes, rng: Random) -> bytes | None:
    """The document of a .glb, of which a value is another, or its binary chunk; all lengths fit."""
    try:
        size = struct.unpack_from("<I", data, 12)[0]
        text, rest = data[20 : 20 + size], data[20 + size :]
        if rng.random() < 0.75:
            text = json.dumps(any_value(json.loads(text), rng)).encode()
            text += b" " * (-len(text) % 4)
        else:
            body = rng.choice(BYTES)(rest[8:], rng) or b""
            rest = struct.pack("<I", len(body)) + rest[4:8] + body
    except (ValueError, struct.error, RecursionError, IndexError):
        return None
    body = struct.pack("<I4s", len(text), b"JSON") + text + rest
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def tensors(data: bytes, rng: Random) -> bytes | None:
    """The header of a safetensors file, of which a value is another, also within the texts of its metadata."""
    try:
        size = struct.unpack_from("<Q", data)[0]
        header, rest = json.loads(data[8 : 8 + size]), data[8 + size :]
        texts = header.get("__metadata__", {})
        if texts and rng.random() < 0.6:
            key = rng.choice(sorted(texts))
            try:
                texts[key] = json.dumps(any_value(json.loads(texts[key]), rng))
            except (ValueError, TypeError, RecursionError):
                texts[key] = rng.choice(("", "x", "[", "9" * 400))
        elif rng.random() < 0.6:
            header = any_value(header, rng)
        else:
            rest = rng.choice(BYTES)(rest, rng) or b""
        text = json.dumps(header).encode()
    except (ValueError, struct.error, RecursionError, AttributeError, IndexError):
        return None
    return struct.pack("<Q", len(text)) + text + rest


def _saved(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, array, allow_pickle=True)  # of plain numbers: it is what a stranger's file may hold
    return out.getvalue()


def array(data: bytes, rng: Random) -> bytes | None:
    """A .npy whose array has another type, shape, order or numbers, or whose header speaks of another array."""
    try:
        found = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except Exception:  # what NumPy says of a header that another step has damaged
        return None
    if rng.random() < 0.3:
        return header(data, rng)
    changed = _changed(found, rng)
    return None if changed is None else _saved(changed)


def _changed(found: np.ndarray, rng: Random) -> np.ndarray | None:
    change, size = rng.randrange(10), found.size
    with np.errstate(all="ignore"):
        if change == 0:
            kind = rng.choice(("f2", "f4", "f8", "i1", "u1", "i4", "i8", "u8", "U5", "S3", "c8", "?", "M8[s]", ">f4"))
            return found.astype(kind, casting="unsafe") if found.dtype.kind in "fiub" else None
        if change == 1:
            return np.array([{"a": 1}, None], dtype=object) if rng.random() < 0.5 else np.zeros(3, "i4, f4")
        if change == 2:
            return found.reshape(-1) if rng.random() < 0.5 else found[None]
        if change == 3:
            return np.asfortranarray(found.T)
        if change == 4:
            return found[: rng.choice((0, 1, 2, max(len(found) - 1, 0)))] if found.ndim else np.zeros(0, found.dtype)
        if change == 5:
            return np.concatenate([found, found[:2]]) if found.ndim else np.array([found, found])
        if change == 6:
            return found.reshape(-1)[0].reshape(()) if size else None
        if not size or found.dtype.kind not in "fiu":
            return np.array("x")
        changed, many = found.copy(), rng.choice((1, 1, 5, size))
        places = [rng.randrange(size) for _ in range(many)] if many < size else slice(None)
        if found.dtype.kind == "f":
            changed.reshape(-1)[places] = rng.choice(_EXTREME)
        else:
            limits = np.iinfo(found.dtype)
            changed.reshape(-1)[places] = rng.choice((limits.max, limits.min, 0, size))
        return changed


def header(data: bytes, rng: Random) -> bytes | None:
    """A .npy whose header lies: of its shape, type, order or length."""
    if data[:6] != b"\x93NUMPY" or len(data) < 128:
        return None
    size = struct.unpack_from("<H", data, 8)[0]
    text = data[10 : 10 + size].decode("latin-1").rstrip()
    shape = rng.choice(("(1000000000000, 3)", "(-1, 3)", "(3,)", "()", "(2**40,)", "(True,)", "'x'", "(10**9, 10**9)"))
    swaps = (
        (text[text.find("(") : text.find(")") + 1], shape),
        ("False", rng.choice(("True", "None", "2"))),
        ("<f4", rng.choice(("<f8", "|O", "<U1", "<f16", "|V4", "|S0", "<i4", "x"))),
        ("'descr'", rng.choice(("'x'", "'descr', 'a'", "descr"))),
        ("{", rng.choice(("", "[", "{" * 50, "__import__('os'),{"))),
    )
    before, after = rng.choice(swaps)
    text = text.replace(before, after, 1).ljust(size - 1) + "\n"
    length = len(text) if rng.random() < 0.8 else rng.choice((0, 1, 65535))
    return data[:8] + struct.pack("<H", length) + text.encode("latin-1") + data[10 + size :]


def _members(data: bytes) -> dict[str, bytes] | None:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, ValueError, NotImplementedError, RuntimeError, EOFError, struct.error, OSError):
        return None
    except Exception:  # what zlib says of a block that another step has damaged
        return None


def _packed(members: list[tuple[str, bytes]], method: int) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, content in members:
            archive.writestr(zipfile.ZipInfo(name), content, method)
    return out.getvalue()


def member(data: bytes, rng: Random) -> bytes | None:
    """An archive whose members are damaged, missing, renamed, doubled, exchanged or many."""
    members = _members(data)
    if not members:
        return None
    items, change = list(members.items()), rng.randrange(8)
    at = rng.randrange(len(items))
    name, content = items[at]
    if change < 4:
        damaged = (array if content[:6] == b"\x93NUMPY" and rng.random() < 0.8 else rng.choice(BYTES))(content, rng)
        items[at] = (name, damaged or b"")
    elif change == 4:
        del items[at]
    elif change == 5:
        items[at] = (rng.choice(("../x.npy", "/x.npy", "x", name.upper(), "a" * 300 + ".npy", "é.npy")), content)
    elif change == 6:
        other = rng.randrange(len(items))
        items[at], items[other] = (name, items[other][1]), (items[other][0], content)
    else:
        items += [(f"more_{k}.npy", content[:64]) for k in range(rng.choice((1, 200)))]
    return _packed(items, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))


def directory(data: bytes, rng: Random) -> bytes | None:
    """An archive whose directory lies: of a size, a checksum, a method, a flag or a place."""
    at = data.find(b"PK\x01\x02")
    for _ in range(rng.randrange(8)):
        at = data.find(b"PK\x01\x02", at + 4) if data.find(b"PK\x01\x02", at + 4) >= 0 else at
    if at < 0 or at + 46 > len(data):
        return None
    offset, shape = rng.choice(((8, "<H"), (10, "<H"), (16, "<I"), (20, "<I"), (24, "<I"), (42, "<I")))
    value = rng.choice((0, 1, 8, 12, 99, 65535)) if shape == "<H" else rng.choice((0, 1, 2**31, 2**32 - 1, 2**30, 400))
    return data[: at + offset] + struct.pack(shape, value) + data[at + offset + struct.calcsize(shape) :]


def repacked(data: bytes, rng: Random) -> bytes | None:
    """An archive with its members in another order, compressed or not: nothing changes."""
    items = list((_members(data) or {}).items())
    rng.shuffle(items)
    return _packed(items, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) if items else None


# What has a hold on files of a suffix, and what changes nothing of them
STRUCTURE: dict[str, tuple[Damage, ...]] = {
    ".json": (document,), ".gltf": (document,), ".jsonl": (every_line,), ".glb": (chunk,), ".safetensors": (tensors,),
    ".npy": (array,), ".npz": (member, member, directory),
}  # fmt: skip
HARMLESS: dict[str, Callable[[bytes, Random], bytes | None]] = {
    ".json": reformatted,
    ".gltf": reformatted,
    ".npz": repacked,
}
