"""Results of set-up that come again: factors, inverses and caps, kept by the content of what they were made from.

Training makes a new scene for every batch, of garments and bodies that came before. Within `keeping`, `of` gives what
it gave for the same content, and forgets what was used least recently beyond a number of bytes. Outside of it nothing
is kept. Kept results are not changed by those who use them.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
import torch

_Result = TypeVar("_Result")
_local = threading.local()


class Kept:
    """What is kept.

    Args:
        most: Largest number of bytes of all results together.
    """

    def __init__(self, most: int = 2**28) -> None:
        self.most, self.bytes = most, 0
        self._lock = threading.Lock()
        self._results: OrderedDict[bytes, Any] = OrderedDict()

    def __len__(self) -> int:
        return len(self._results)

    def get(self, key: bytes, make: Callable[[], Any]) -> Any:
        """The result with this key, made if there is none."""
        with self._lock:
            if key in self._results:
                self._results.move_to_end(key)
                return self._results[key]
        result = make()
        with self._lock:
            if key not in self._results:  # another thread may have made it, too
                self._results[key] = result
                self.bytes += bytes_of(result)
            while self.bytes > self.most:
                self.bytes -= bytes_of(self._results.popitem(last=False)[1])
        return result


def bytes_of(result: Any) -> int:
    """Bytes of the arrays and tensors of a result."""
    if isinstance(result, (tuple, list)):
        return sum(map(bytes_of, result))
    return int(result.nbytes) if isinstance(result, (np.ndarray, torch.Tensor)) else 0


@contextlib.contextmanager
def keeping(kept: Kept) -> Iterator[None]:
    """Context within which this thread's calls of `of` use `kept`."""
    before = getattr(_local, "kept", None)
    _local.kept = kept
    try:
        yield
    finally:
        _local.kept = before


def of(name: str, content: tuple[Any, ...], make: Callable[[], _Result]) -> _Result:
    """The result of `make`, or what it was when the content was the same.

    Args:
        name: Name of what is made.
        content: What the result depends on: arrays, bytes, and values that `repr` tells apart, also nested.
        make: Makes it.
    """
    kept: Kept | None = getattr(_local, "kept", None)
    if kept is None:
        return make()
    digest = hashlib.blake2b(name.encode(), digest_size=16)
    _feed(digest, content)
    result: _Result = kept.get(digest.digest(), make)
    return result


def _feed(digest: Any, content: Any) -> None:
    if isinstance(content, tuple):
        digest.update(f"({len(content)}".encode())
        for part in content:
            _feed(digest, part)
    elif isinstance(content, np.ndarray):
        digest.update(f"{content.dtype}{content.shape}".encode())
        digest.update(np.ascontiguousarray(content).data)
    elif isinstance(content, bytes):
        digest.update(f"{len(content)}".encode())
        digest.update(content)
    else:
        digest.update(repr(content).encode())
