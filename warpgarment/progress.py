"""Progress bars of what takes longer than two seconds, on a terminal alone."""

from __future__ import annotations

import os
import re
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

Item = TypeVar("Item")

LATER = 2.0
"""Seconds after which the bar of a part of something else appears."""
_wanted: ContextVar[bool] = ContextVar("_wanted", default=False)


def counted(
    items: Iterable[Item], what: str, *, unit: str, total: int | None = None, shown: bool | None = None
) -> Iterator[Item]:
    """The items, with how many are done and the time left for the others; the bar goes when they are.

    Args:
        items: What is worked on, one after the other.
        what: What is done, such as "drawing".
        unit: What an item is, such as "frame".
        total: Number of items, where they have no length.
        shown: Whether there is a bar; None: where stderr is a terminal.
    """
    if not (sys.stderr.isatty() if shown is None else shown):
        yield from items
        return
    yield from _bar(items, desc=what, unit=unit, total=total)


def parts(items: Iterable[Item], what: str, *, unit: str = "frame", total: int | None = None) -> Iterator[Item]:
    """As `counted`, for what is a part of something else, such as the frames of a file that is read or written.

    There is a bar only within `bars`, and only after `LATER` seconds.
    """
    if not _wanted.get():
        yield from items
        return
    yield from _bar(items, desc=what, unit=unit, total=total, delay=LATER)


@contextmanager
def bars(shown: bool | None = None) -> Iterator[None]:
    """Lets what takes long show bars meanwhile, and Warp's compiler say how many modules it has made.

    Args:
        shown: Whether there are any; None: where stderr is a terminal.
    """
    if not (sys.stderr.isatty() if shown is None else shown):
        yield
        return
    before, done = _wanted.set(True), threading.Event()
    watch = threading.Thread(target=_watch, args=(done,), daemon=True)
    watch.start()
    try:
        yield
    finally:
        _wanted.reset(before)
        done.set()
        watch.join()


def _bar(items: Iterable[Any] | None = None, **more: Any) -> Any:
    from tqdm import tqdm

    return tqdm(items, leave=False, **more)


def _watch(done: threading.Event, every: float = 0.5) -> None:
    """Shows a bar while Warp compiles kernels for this process.

    Warp makes each module in a folder of its cache whose name ends with the number of the process, and then renames it;
    it says nothing before a module is made.
    """
    ours = re.compile(rf"_p{os.getpid()}_t\d+$")
    seen: set[str] = set()
    bar = None
    idle = 0
    while not done.wait(every):
        now = {name for name in _cached() if ours.search(name)}
        seen |= now
        idle = 0 if now else idle + 1
        if now and bar is None:
            bar = _bar(desc="compiling kernels, only this once", unit="module", initial=len(seen - now))
        elif bar is not None and idle * every > LATER:
            bar.close()
            bar = None
        if bar is not None:
            bar.n = len(seen - now)
            bar.refresh()
    if bar is not None:
        bar.close()


def _cached() -> list[str]:
    """Names in Warp's cache of kernels; none before it is used."""
    config = getattr(sys.modules.get("warp"), "config", None)
    folder = getattr(config, "kernel_cache_dir", None)
    try:
        return os.listdir(folder) if folder else []
    except OSError:
        return []
