"""Files that others made: opened only if they are plain, and names that stay in their folder."""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import IO, Any

from warpgarment.errors import MeshError

LARGEST = 4 << 30  # bytes of a file that is read into memory as a whole
_PIECE = 1 << 20  # bytes that are read at a time
_NO_TEXT = bytes(4)  # zeros that no text has in a row, whatever its encoding
JSON_LARGEST = 16 << 20  # bytes
JSON_DEEPEST = 32  # objects and arrays within each other


def open_plain(path: str | os.PathLike[str], largest: int | None = None) -> IO[bytes]:
    """A file opened for reading; a pipe is not waited for.

    Args:
        path: File to open.
        largest: Most bytes it may have; None for no bound.

    Raises:
        MeshError: It is a folder, pipe, socket or device, or is larger than that; the error says which.
        OSError: It cannot be opened.
    """
    if Path(path).is_dir():
        raise MeshError(f"{path} is a folder, not a file.")
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    found = os.fstat(handle)
    if not stat.S_ISREG(found.st_mode):
        os.close(handle)
        kind = "a pipe" if stat.S_ISFIFO(found.st_mode) else "a device or socket"
        raise MeshError(f"{path} is {kind}, not a plain file.")
    if largest is not None and found.st_size > largest:
        os.close(handle)
        raise MeshError(f"{path} has {found.st_size:,} bytes; a file of this kind may have {largest:,} at most.")
    return os.fdopen(handle, "rb")


def check_plain(path: str | os.PathLike[str], largest: int | None = None) -> None:
    """Refuses what `open_plain` refuses, before a library that opens files by name is given one."""
    open_plain(path, largest).close()


def read_plain(path: str | os.PathLike[str], largest: int = LARGEST, *, text: bool = False) -> bytes:
    """All bytes of a file of bounded size.

    Args:
        path: File to read.
        largest: Most bytes it may have.
        text: Whether it should be text: reading ends at the first zeros that no text has, so that a file of gigabytes
            that is one hole takes no memory.

    Raises:
        MeshError: It is no plain file, larger than that, or no text; the error says which.
        OSError: It cannot be read.
    """
    with open_plain(path, largest) as file:
        if not text:
            return file.read()
        pieces: list[bytes] = []
        while piece := file.read(_PIECE):
            if _NO_TEXT in piece:
                raise MeshError(f"{path}: binary data; this is not a text file, as its name says.")
            pieces.append(piece)
        return b"".join(pieces)


def read_json(path: str | os.PathLike[str]) -> Any:
    """What a JSON file of bounded size and depth holds.

    Raises:
        MeshError: It is no plain file, larger or more deeply nested than the bounds, or no JSON; the error says which.
        OSError: It cannot be read.
    """
    return parsed_json(path, read_plain(path, JSON_LARGEST))


def parsed_json(path: object, data: str | bytes) -> Any:
    """What a JSON text of bounded depth holds.

    Args:
        path: Where it is from, for messages.
        data: The text, in UTF-8.

    Raises:
        MeshError: It is more deeply nested than the bound, or no JSON; the error says which.
    """
    try:
        value = json.loads(data.decode("utf-8") if isinstance(data, bytes) else data)
        level: list[Any] = [value]
        for _ in range(JSON_DEEPEST + 1):
            level = [part for part in level if isinstance(part, (dict, list))]
            if not level:
                return value
            level = [part for item in level for part in (item.values() if isinstance(item, dict) else item)]
    except RecursionError:
        pass
    except ValueError as error:
        raise MeshError(f"{path} is not JSON ({str(error)[:200]}). It is damaged or cut short.") from None
    raise MeshError(f"{path} is nested more than {JSON_DEEPEST} deep. It is damaged, or not what its name says.")


def below(root: str | os.PathLike[str], name: object, where: str) -> Path:
    """The path of a file that another file names; it cannot leave its folder.

    Args:
        root: Folder to which the name is relative.
        name: What the file says.
        where: The file and the field that say so, for messages.

    Raises:
        MeshError: It is no text, absolute, too long for a path, or leads out of the folder by `..` or by a link.
    """
    shown = repr(name)[:80]
    if not isinstance(name, str) or not name or "\0" in name:
        raise MeshError(f"{where} must be the name of a file, it is {shown}.")
    if Path(name).is_absolute() or ":" in Path(name).parts[0]:
        raise MeshError(f"{where} is {shown}, an absolute path: only files below {root} are read.")
    if len(name) > 1000 or any(len(part.encode("utf-8", "replace")) > 255 for part in Path(name).parts):
        raise MeshError(f"{where} has {len(name):,} characters, too many for a path.")
    inside = Path(os.path.realpath(root))
    path = Path(os.path.realpath(inside / name))
    if not path.is_relative_to(inside):
        raise MeshError(f"{where} is {shown}, which leads out of {root}: only files below it are read.")
    return path
