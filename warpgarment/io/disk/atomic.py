"""Outputs appear complete or not at all: write beside the target, flush to disk, rename."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from warpgarment.errors import OutputError

from .leftovers import beside, finished, remove_leftovers

# What a disk says that has no room, breaks, or may not be written to
_REFUSED = {errno.ENOSPC, errno.EFBIG, errno.EROFS, errno.EIO, errno.ENAMETOOLONG, getattr(errno, "EDQUOT", errno.EIO)}


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
def _named(path: Path) -> Iterator[None]:
    """Makes an OutputError, which names the output, of what a disk says while it is written."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        if error.errno in _REFUSED:
            reason = error.strerror or str(error)
        elif error.errno is None and "requested and" in str(error):
            reason = f"no room on the disk ({error})"  # the words of ndarray.tofile, which keeps the number to itself
        else:
            raise
        raise OutputError(f"{path}: cannot be written: {reason}. What was there before is as it was.") from error


@contextlib.contextmanager
def atomic_files(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """Yields a temporary path for each target; on success all of them replace the targets, on any error none does.

    All files are complete and flushed before the first is renamed. They are renamed in the given order, so the one that
    makes readers look for the others goes last. What processes that were killed have left in the folders is removed.

    Args:
        paths: Where the files shall appear; parent folders are made.

    Raises:
        OutputError: The disk is full, or cannot be written to.
        IsADirectoryError: A target is a folder.
    """
    paths = tuple(Path(path) for path in paths)
    with _named(paths[-1]):
        for path in paths:
            if path.is_dir():
                raise IsADirectoryError(f"{path} is a folder. Choose another name for the file.")
            path.parent.mkdir(parents=True, exist_ok=True)
        for folder in {path.parent for path in paths}:
            remove_leftovers(folder)
        temporary = tuple(beside(path) for path in paths)
        try:
            yield temporary
            for path in temporary:
                _flush(path)
            for source, target in zip(temporary, paths, strict=True):
                os.replace(source, target)
        finally:
            for path in temporary:
                path.unlink(missing_ok=True)
            finished(*temporary)
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


def check_replaceable(path: Path, replaces: str | Sequence[str]) -> None:
    """Refuses a folder that `atomic_folder` would not replace.

    Args:
        path: The folder.
        replaces: As of `atomic_folder`.

    Raises:
        FileExistsError: The folder holds something else, or a file has its name.
    """
    if not path.exists():
        return
    if not path.is_dir():
        raise FileExistsError(f"{path} is a file. Choose another folder.")
    patterns = [replaces] if isinstance(replaces, str) else list(replaces)
    strangers = sorted(i.name for i in path.iterdir() if i.is_dir() or not any(map(i.match, patterns)))
    if strangers:
        raise FileExistsError(
            f"{path} holds {len(strangers):,} entries that are not {' or '.join(patterns)} (first: {strangers[0]}) and "
            "would be lost. Choose another folder."
        )


@contextlib.contextmanager
def atomic_folder(
    path: Path, replaces: str | Sequence[str], stays: Callable[[Path], bool] | None = None
) -> Iterator[Path]:
    """Yields a temporary folder that takes the target's place on success and vanishes on any error.

    An old folder is moved aside first and put back should the last rename fail, by the next save if need be.

    Args:
        path: Where the folder shall appear.
        replaces: Glob pattern, or several; an existing folder is replaced only if each of its files matches one.
        stays: Whether a folder that is there when the temporary one is complete is kept instead of it. Then the first
            of several processes that write the same folder wins, and those who read it already keep their files.

    Raises:
        FileExistsError: The folder holds something else, or a file has its name.
        OutputError: The disk is full, or cannot be written to.
    """
    path = Path(path)
    with _named(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path.parent, back=path)
        check_replaceable(path, replaces)
        temporary, old = beside(path), beside(path, aside=True)
        try:
            temporary.mkdir()
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
            finished(temporary, old)
        if os.name == "posix":
            _flush(path.parent)
