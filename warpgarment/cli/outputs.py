"""What verbs write: names as they were typed, tried before the work begins."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from warpgarment.errors import MissingExtra, UsageError
from warpgarment.io.disk.atomic import check_replaceable
from warpgarment.io.disk.outputs import check_writable, names_folder
from warpgarment.io.files import CACHES, format_of
from warpgarment.io.folder import FRAME

_MODULES = {
    "usd": ("pxr",),
    "alembic": ("alembic3d",),
    "view": ("imageio", "imageio_ffmpeg", "PIL"),
}  # what an extra brings


class Folder(type(Path())):  # type: ignore[misc]  # the class of this system's paths
    """A path that was typed with a slash at its end, which `Path` would forget."""

    def __fspath__(self) -> str:
        return f"{self}{os.sep}"


def _typed(text: str) -> Path:
    return Folder(text) if names_folder(text) else Path(text)


Output = Annotated[
    Path,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: _typed(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda value: [str(value)],
    ),
]


def check_output(path: Path, suffixes: Sequence[str], inputs: Sequence[Path | None] = ()) -> None:
    """Refuses an output that cannot be written, before time is spent on what goes into it.

    Args:
        path: As it was typed: one with a slash at its end, or of a folder that exists, is a folder's.
        suffixes: What can be written, "" being a folder.
        inputs: Files that are read: the mesh that is written beside a cache must not be one of them, or beside one.

    Raises:
        UsageError: No such format, or the mesh beside a cache would replace an input.
        OutputError, FileExistsError: The name or the folder, see `io.disk.outputs`.
        MissingExtra: What writes it is not installed.
    """
    plain = Path(str(path))
    suffix = plain.suffix.lower()
    if "" in suffixes and (names_folder(path) or (suffix not in suffixes and plain.is_dir())):
        suffix = ""
    if suffix not in suffixes:
        allowed = ", ".join(s or "a folder (no suffix, or a slash at the end)" for s in suffixes)
        raise UsageError(f"cannot write {path.name!r}. Formats: {allowed}.")
    check_writable(plain, folder=suffix == "")
    if suffix == "":
        check_replaceable(plain, FRAME)
    if suffix in CACHES:
        mesh = plain.with_suffix(".obj")  # beside it
        check_writable(mesh)
        read = [p.with_suffix(".obj") if p.suffix.lower() in CACHES else p for p in inputs if p is not None]
        if mesh.exists() and any(p.exists() and mesh.samefile(p) for p in read):
            raise UsageError(
                f"{path}: {mesh.name} is read, and the mesh of a {suffix}, its first frame, would be written over it. "
                "Choose another name."
            )
    format = None if suffix in (".png", ".mp4") else format_of(suffix)
    extra = "view" if format is None else format.extra
    for module in _MODULES.get(extra or "", ()):
        if importlib.util.find_spec(module) is None:
            raise MissingExtra(str(extra), f"Writing {suffix}")
