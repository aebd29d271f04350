"""Warp's start, after which code that nothing but the start has run is no longer resident.

`wp.init` loads a library of 300 MB with a compiler for CUDA, whose 1,600 constructors lie all over its code. Linux
reads 64 KB of a file around each of them: 76 MB of code that a rollout on a CPU never runs. They are given back; what
runs later is mapped again from the system's cache of files, some microseconds for 64 KB.
"""

from __future__ import annotations

import ctypes
import mmap
from pathlib import Path

import warp as wp

_done: list[bool] = []


def start() -> None:
    """Initialises Warp; the first call gives the code of its library back to the system, where that is Linux."""
    wp.init()
    if not _done:
        _done.append(True)
        _give_back("/warp/bin/warp.so")


def _give_back(library: str) -> None:
    """Unmaps the pages of a library's code, which nobody writes; they are mapped again when they are run."""
    maps, advice = Path("/proc/self/maps"), getattr(mmap, "MADV_DONTNEED", None)
    if advice is None or not maps.exists():
        return
    madvise = ctypes.CDLL(None).madvise
    madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    for line in maps.read_text().splitlines():
        addresses, rights, *_ = line.split(maxsplit=2)
        if rights == "r-xp" and line.endswith(library):
            begin, end = (int(address, 16) for address in addresses.split("-"))
            madvise(begin, end - begin, advice)
