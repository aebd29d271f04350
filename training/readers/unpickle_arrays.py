"""Functions for the few NumPy globals that `unpickle` knows: arrays of numbers and fixed-width text, nothing else."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

DTYPE = re.compile(r"(b1|[iu][1248]|f[248]|[SU][1-9]\d{0,5})")  # no objects, no records
DIMENSIONS = 8


class Refusal(Exception):
    """An object that is refused; the message is the start of a sentence."""


class PendingDtype:
    """A dtype under construction: its code, then its byte order."""

    def __init__(self, code: str):
        self.code, self.order = code, "="

    def make(self) -> np.dtype:
        """The finished dtype; both parts were matched with the allowed ones before."""
        return np.dtype(self.order + self.code)

    def set_state(self, version: Any, order: Any, *rest: Any) -> None:
        """Reads the byte order from a dtype's state: version, order, subtype, names, fields, size, ..."""
        if order not in ("<", ">", "|", "=") or any(part is not None for part in rest[:3]):
            raise Refusal("a structured array type")
        self.order = order


class NdarrayToken:
    """Stands for the class numpy.ndarray."""


class ArrayMaker:
    """Makes arrays from pieces of the file, within a budget of bytes.

    Args:
        budget: Limit of the bytes of all arrays and text together.
    """

    def __init__(self, budget: int):
        self.budget = budget

    def spend(self, size: int) -> None:
        """Subtracts bytes from the budget before they are allocated; refuses if it is exceeded."""
        self.budget -= size
        if self.budget < 0:
            raise Refusal("data that unfolds to many times the size of the file")

    def encoded(self, text: Any, encoding: Any) -> bytes:
        """`_codecs.encode`, by which Python 3 writes bytes for protocols below 3."""
        if not isinstance(text, str) or encoding != "latin1":
            raise Refusal("_codecs.encode of something that is not text in latin1")
        self.spend(len(text))
        return text.encode("latin-1")

    def dtype(self, code: Any, align: Any = False, copy: Any = True) -> PendingDtype:
        """`numpy.dtype`."""
        if not isinstance(code, str) or not DTYPE.fullmatch(code):
            what = "of Python objects" if isinstance(code, str) and code.startswith("O") else "that is not plain"
            raise Refusal(f"an array type {what} ({str(code)[:20]!r})")
        return PendingDtype(code)

    def array(self, cls: Any, shape: Any, code: Any) -> np.ndarray:
        """`_reconstruct`: an empty array, which `fill` fills."""
        if not isinstance(cls, NdarrayToken):
            raise Refusal("a subclass of numpy.ndarray")
        return np.zeros(0, dtype=np.uint8)

    def fill(self, array: np.ndarray, version: Any, shape: Any, dtype: Any, fortran: Any, data: Any) -> None:
        """Sets the state of an array that `array` made."""
        if isinstance(data, list):
            raise Refusal("an array of Python objects")
        if isinstance(data, str):  # written by Python 2
            data = self.encoded(data, "latin1")
        kind, shape = self._layout(dtype, shape, data)
        state: Any = (1, shape, kind, bool(fortran), data)  # our own tuple of checked parts
        array.__setstate__(state)

    def buffer(self, data: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> np.ndarray:
        """`_frombuffer`, by which NumPy writes contiguous arrays in protocol 5; "K" is "C" with permuted axes."""
        kind, shape = self._layout(dtype, shape, data)
        if order not in ("C", "F", "K") or (order == "K") == (axes is None):
            raise Refusal("an array in an unknown order")
        flat = np.frombuffer(data, dtype=kind) if data else np.zeros(0, dtype=kind)
        if axes is None:
            return flat.reshape(shape, order=order)
        if not isinstance(axes, tuple) or sorted(axes) != list(range(len(shape))):
            raise Refusal("an array in an unknown order")
        return flat.reshape(shape).transpose(axes)

    def scalar(self, dtype: Any, data: Any) -> np.generic:
        """`scalar`, a number of a NumPy type."""
        if isinstance(data, str):
            data = self.encoded(data, "latin1")
        kind, _ = self._layout(dtype, (1,), data)
        return np.frombuffer(data, dtype=kind)[0]

    def _layout(self, dtype: Any, shape: Any, data: Any) -> tuple[np.dtype, tuple[int, ...]]:
        """Type and shape of an array, which must account for every byte of its data."""
        if not isinstance(dtype, PendingDtype) or not isinstance(data, bytes):
            raise Refusal("an array without a plain type and bytes")
        shape = (shape,) if type(shape) is int else shape
        plain = isinstance(shape, tuple) and all(type(n) is int and 0 <= n < 1 << 31 for n in shape)
        if not plain or len(shape) > DIMENSIONS:
            raise Refusal("an array shape that is not one")
        kind, count = dtype.make(), 1
        for n in shape:
            count *= n
        if count * kind.itemsize != len(data):
            raise Refusal(f"an array of shape {list(shape)} and type {kind} with {len(data):,} bytes")
        self.spend(len(data))
        return kind, shape
