"""Outputs are tried before time is spent on what goes into them: the name, the folder, what is there already."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path

from warpgarment.errors import OutputError


def names_folder(path: str | os.PathLike[str]) -> bool:
    """Whether a name ends in a slash, which makes a folder of any name: `sh010.v002/`."""
    return os.fspath(path).endswith(tuple(filter(None, (os.sep, os.altsep))))


def check_writable(path: Path, *, folder: bool = False) -> None:
    """Refuses an output that cannot appear at a path. Nothing is left there, nor are folders made.

    Args:
        path: The file or folder to write; its parents need not exist.
        folder: Whether it is a folder that is made, or filled.

    Raises:
        OutputError: The name is too long, a parent is a file or may not be written to, or what has the name already is
            a folder where a file is wanted, or the other way round.
    """
    path = Path(path)
    above = path if folder else path.parent
    new = [] if folder else [path.name]
    try:
        while not above.exists() and above != above.parent:
            new.append(above.name)
            above = above.parent
    except OSError as error:  # a name that is too long is not even looked for
        raise OutputError(f"{path}: cannot be written: {error.strerror}. Choose another name.") from error
    if not above.is_dir():
        raise OutputError(f"{path}: cannot be written: {above} is a file, not a folder. Choose another name.")
    longest = 255
    with contextlib.suppress(OSError, ValueError, AttributeError):
        longest = os.pathconf(above, "PC_NAME_MAX")
    for name in new:
        if len(os.fsencode(name)) > longest:
            raise OutputError(
                f"{path}: cannot be written: a name of {len(os.fsencode(name)):,} bytes, the disk allows {longest}. "
                "Choose a shorter one."
            )
    if not folder and path.is_dir():
        raise OutputError(f"{path}: cannot be written: it is a folder. Choose another name for the file.")
    try:
        with tempfile.TemporaryFile(dir=above):
            pass
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error} ({above}).") from error


def check_space(path: Path, needed: float) -> None:
    """Refuses an output for which the disk has no room, as far as the disk says how much it has.

    Args:
        path: The file or folder to write; its parents need not exist.
        needed: About how many bytes it will take.

    Raises:
        OutputError: Less is free.
    """
    above = Path(path)
    while not above.is_dir() and above != above.parent:
        above = above.parent
    try:
        free = shutil.disk_usage(above).free
    except OSError:
        return
    if free < needed:
        raise OutputError(
            f"{path}: about {needed / 1e6:,.0f} MB would be written, and {free / 1e6:,.0f} MB are free on the disk "
            f"({above}). Make room, or choose another place."
        )
