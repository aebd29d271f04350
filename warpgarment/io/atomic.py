"""Outputs appear complete or not at all: write beside the target, flush to disk, rename."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path


def _beside(path: Path) -> Path:
    """A hidden name in the same folder, hence file system, that keeps the suffix (USD's writer looks at it)."""
    return path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.partial{path.suffix}")


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:
        if path.is_file():
            raise  # some file systems cannot flush folders; that much is tolerated
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def atomic_files(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """Yields a temporary path for each target; on success all of them replace the targets, on any error none does.

    All files are complete and flushed before the first is renamed. They are renamed in the given order, so the one that
    makes readers look for the others goes last.

    Args:
        paths: Where the files shall appear; parent folders are made.
    """
    paths = tuple(Path(path) for path in paths)
    temporary = tuple(_beside(path) for path in paths)
    for path in paths:
        if path.is_dir():
            raise IsADirectoryError(f"{path} is a folder. Choose another name for the file.")
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield temporary
        for path in temporary:
            _flush(path)
        for source, target in zip(temporary, paths, strict=True):
            os.replace(source, target)
    finally:
        for path in temporary:
            path.unlink(missing_ok=True)
    for folder in {path.parent for path in paths}:
        if os.name == "posix":
            _flush(folder)


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """`atomic_files` for a single file."""
    with atomic_files(path) as (temporary,):
        yield temporary


def _moved(source: Path, target: Path) -> bool:
    """Whether a folder could be renamed: not to the name of one that holds something."""
    try:
        os.replace(source, target)
    except OSError:
        return False
    return True


@contextlib.contextmanager
def atomic_folder(path: Path, replaces: str, stays: Callable[[Path], bool] | None = None) -> Iterator[Path]:
    """Yields a temporary folder that takes the target's place on success and vanishes on any error.

    An old folder is moved aside first and put back should the last rename fail.

    Args:
        path: Where the folder shall appear.
        replaces: Glob pattern; an existing folder is replaced only if each of its files matches.
        stays: Whether a folder that is there when the temporary one is complete is kept instead of it. Then the first
            of several processes that write the same folder wins, and those who read it already keep their files.

    Raises:
        FileExistsError: The folder holds something else, or a file has its name.
    """
    path = Path(path)
    if path.exists():
        if not path.is_dir():
            raise FileExistsError(f"{path} is a file. Choose another folder.")
        strangers = sorted(item.name for item in path.iterdir() if item.is_dir() or not item.match(replaces))
        if strangers:
            raise FileExistsError(
                f"{path} holds {len(strangers):,} entries that are not {replaces} (first: {strangers[0]}) and would "
                "be lost. Choose another folder."
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary, old = _beside(path), _beside(path)
    temporary.mkdir()
    try:
        yield temporary
        for item in temporary.iterdir():
            _flush(item)
        if stays is None or not (_moved(temporary, path) or stays(path)):
            if path.exists():
                os.replace(path, old)
            try:
                os.replace(temporary, path)
            except OSError:
                if old.exists():
                    os.replace(old, path)
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    if os.name == "posix":
        _flush(path.parent)
