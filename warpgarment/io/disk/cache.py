"""What takes long to compute and depends on nothing but its inputs is kept on disk, under a name made of them.

Files lie in $WARPGARMENT_CACHE, else in the user's cache folder; WARPGARMENT_NO_CACHE=1 neither reads nor writes them.
They may be deleted at any time. Of those with the same prefix the oldest go when they take more than `TOTAL` together.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from .atomic import atomic_file
from .plain import check_plain

OFF = "WARPGARMENT_NO_CACHE"
LARGEST = 2**29  # bytes of arrays that are kept, for one key
TOTAL = 2**32  # bytes of all files with one prefix


def cache_folder() -> Path:
    """Where derived files are kept: $WARPGARMENT_CACHE, or the user's cache folder."""
    named = os.environ.get("WARPGARMENT_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "warpgarment"


def remembered(
    prefix: str,
    inputs: Sequence[np.ndarray | float | int | str],
    expected: Mapping[str, tuple[str, tuple[int | None, ...]]],
    compute: Callable[[], Mapping[str, np.ndarray]],
) -> dict[str, np.ndarray]:
    """Arrays from the cache, or computed and put there.

    A file that is damaged, cut short, or not of this kind counts as missing and is written again; a folder that cannot
    be written to keeps nothing. Processes that compute the same at once all write the same file, whole.

    Args:
        prefix: Kind of thing, with the version of the algorithm: the start of the file's name.
        inputs: All that the result depends on.
        expected: Name, NumPy type and shape (None: any length) of each array.
        compute: Makes them.
    """
    if os.environ.get(OFF, "0") not in ("", "0"):
        return dict(compute())
    digest = hashlib.sha256(prefix.encode())
    for value in inputs:
        array = np.ascontiguousarray(value)
        digest.update(f"|{array.dtype.str}{array.shape}|".encode())
        digest.update(array.tobytes())
    path = cache_folder() / f"{prefix}-{digest.hexdigest()[:32]}.safetensors"
    found = _read(path, expected)
    if found is not None:
        return found
    arrays = {name: np.ascontiguousarray(array) for name, array in compute().items()}
    if sum(array.nbytes for array in arrays.values()) <= LARGEST:
        try:
            with atomic_file(path) as temporary:
                save_file(arrays, temporary, metadata={"crc32": _checksum(arrays)})
            _forget_oldest(path.parent, prefix)
        except (OSError, SafetensorError):
            pass  # no room, no permission: it is only a cache
    return arrays


def _read(path: Path, expected: Mapping[str, tuple[str, tuple[int | None, ...]]]) -> dict[str, np.ndarray] | None:
    try:
        check_plain(path)
        with safe_open(path, framework="numpy") as file:
            if set(file.keys()) != set(expected):
                return None
            arrays = {name: file.get_tensor(name) for name in expected}
            checksum = (file.metadata() or {}).get("crc32")
    except (OSError, SafetensorError, ValueError, TypeError, KeyError):
        return None
    for name, (kind, shape) in expected.items():
        array = arrays[name]
        fits = array.ndim == len(shape) and all(w in (None, n) for w, n in zip(shape, array.shape, strict=True))
        if array.dtype != np.dtype(kind) or not fits:
            return None
    return arrays if checksum == _checksum(arrays) else None


def _checksum(arrays: Mapping[str, np.ndarray]) -> str:
    value = 0
    for name in sorted(arrays):
        value = zlib.crc32(arrays[name].reshape(-1).view(np.uint8).data, zlib.crc32(name.encode(), value))
    return f"{value:08x}"


def _forget_oldest(folder: Path, prefix: str) -> None:
    sizes = []
    for path in folder.glob(f"{prefix}-*.safetensors"):
        try:
            status = path.stat()
        except OSError:
            continue  # another process removed it
        sizes.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in sizes)
    for _, size, path in sorted(sizes)[:-1]:
        if total <= TOTAL:
            return
        path.unlink(missing_ok=True)
        total -= size
