"""Launches on a CPU by the record of a kernel's first launch, at a fifth of what `wp.launch` costs the host.

`wp.launch` checks and converts every argument in every launch, some 40 microseconds, as long as a small kernel runs
itself. The first launch of a kernel is recorded by Warp, which checks its arguments. Later ones fill a structure of the
same types and call the same function:

    recorded launch of a kernel  ->  compiled function, types of its arguments, type of its bounds
    launch(kernel, rows, arguments)  ->  function(bounds(rows), structure(arguments))
    adjoint(kernel, rows, arguments, adjoints)  ->  function(bounds(rows), structure(arguments), structure(adjoints))

Arguments that do not fit the structure are given to `wp.launch`, which says what is wrong with them. Nothing is
recorded on a `wp.Tape`: kernels are differentiated by operators of torch.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import torch
import warp as wp

if TYPE_CHECKING:
    from .replay.recording import Recording

MOST_BOUNDS = 4096


Call = Callable[[], object]


class Launch:
    """A launch that is ready to run, in any thread; the memory of its arguments must live until then.

    Args:
        function: The compiled function.
        bounds: Its bounds.
        arguments: The structure of its arguments.
    """

    __slots__ = ("arguments", "bounds", "function")

    def __init__(self, function: Any, bounds: Any, arguments: Any) -> None:
        self.function, self.bounds, self.arguments = function, bounds, arguments

    def __call__(self) -> None:
        self.function(ctypes.byref(self.bounds), ctypes.byref(self.arguments))

    @property
    def addresses(self) -> tuple[int, int, int]:
        """Addresses of the function, the bounds and the arguments."""
        function = ctypes.cast(self.function, ctypes.c_void_p).value or 0
        return function, ctypes.addressof(self.bounds), ctypes.addressof(self.arguments)


class Record:
    """What is constant in launches of a kernel on a CPU.

    Args:
        kernel: A kernel that is not generic.
        rows: Number of threads of its first launch.
        arguments: Arguments of its first launch.
        device: The CPU.
        adjoints: Adjoints of its arguments, if what is launched is its adjoint.
    """

    def __init__(
        self,
        kernel: wp.Kernel,
        rows: int,
        arguments: Sequence[object],
        device: wp.Device,
        adjoints: Sequence[object] | None = None,
    ) -> None:
        more: dict[str, Any] = {} if adjoints is None else {"adj_inputs": adjoints, "adjoint": True}
        self.kept = wp.launch(kernel, dim=rows, inputs=arguments, device=device, record_cmd=True, **more)
        self.function = self.kept.hooks.forward if adjoints is None else self.kept.hooks.backward
        kinds = [type(value) for value in self.kept.params[1 : 1 + len(arguments)]]
        fields = [(f"argument_{k}", kind) for k, kind in enumerate(kinds)]
        self.kinds = kinds
        self.structure: Any = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.count, self.kind = len(fields), type(self.kept.bounds)
        self.ones = (1,) * (len(self.kept.bounds.shape) - 1)
        self.known: dict[int, Any] = {}  # bounds by the number of rows

    def bounds(self, rows: int) -> Any:
        """Bounds of a launch of that many threads."""
        found = self.known.get(rows)
        if found is None:
            if len(self.known) >= MOST_BOUNDS:
                self.known.clear()
            found = self.known[rows] = self.kind((rows, *self.ones))
        return found

    def filled(self, arguments: Sequence[object]) -> Any:
        """The structure of a launch; TypeError if an argument does not fit."""
        if len(arguments) != self.count:
            raise TypeError("another number of arguments")
        try:
            return self.structure(*arguments)
        except TypeError:  # Warp's arrays and structures
            return self.structure(*[_plain(value) for value in arguments])

    def adjoints(self, values: Sequence[object]) -> Any:
        """The same of adjoints, of which those of constants are None."""
        values = [kind() if value is None else value for kind, value in zip(self.kinds, values, strict=True)]
        return self.filled(values)


class _Notes(threading.local):
    recording: Recording | None = None
    memory: Callable[[Sequence[int], torch.dtype], torch.Tensor] | None = None


notes = _Notes()
"""What this thread records, and where `operator.allocate` gets memory on a CPU; see `replay`."""


@contextlib.contextmanager
def noted(
    recording: Recording | None, memory: Callable[[Sequence[int], torch.dtype], torch.Tensor] | None
) -> Iterator[None]:
    """Context in which the launches of this thread are given to a recording, and memory comes from elsewhere."""
    try:
        notes.recording, notes.memory = recording, memory
        yield
    finally:
        notes.recording = notes.memory = None


def note(calls: Sequence[Call]) -> None:
    """Gives launches that are independent of each other to what is recorded, if anything is."""
    if notes.recording is not None:
        notes.recording.launches(calls)


_records: dict[wp.Kernel, Record] = {}
_adjoints: dict[wp.Kernel, Record] = {}
_recording = threading.Lock()  # Warp compiles and loads a module in one thread


def launch(kernel: wp.Kernel, rows: int, arguments: Sequence[object], device: wp.Device) -> None:
    """Runs a kernel on a CPU over that many rows, at least one.

    Args:
        kernel: The kernel; it has one dimension, or further ones of length one.
        rows: Number of threads.
        arguments: Its arguments: numbers, descriptors of `launch.as_argument`, Warp's arrays and structures. They have
            the types of its first launch.
        device: The CPU.
    """
    work = prepared(kernel, rows, arguments, device)
    note([work])
    work()


def prepared(kernel: wp.Kernel, rows: int, arguments: Sequence[object], device: wp.Device) -> Call:
    """A call that does the same once it is called."""
    record = _records.get(kernel)
    try:
        if record is None:
            with _recording:
                record = _records.get(kernel) or Record(kernel, rows, arguments, device)
                _records[kernel] = record
        bounds, filled = record.bounds(rows), record.filled(arguments)
    except TypeError:
        wp.launch(kernel, dim=rows, inputs=arguments, device=device)  # says which argument is wrong
        return lambda: None
    return Launch(record.function, bounds, filled)


def divided(kernel: wp.Kernel, begins: Sequence[int], arguments: Sequence[object], device: wp.Device) -> list[Call]:
    """Calls for ranges of rows, as of `prepared`, of a kernel whose first parameter is the first row of a launch.

    Args:
        kernel: The kernel.
        begins: First row of each range, and the end of the last one.
        arguments: Arguments after the first.
        device: The CPU.
    """
    ranges, record = list(itertools.pairwise(begins)), _records.get(kernel)
    try:
        filled = None if record is None else record.filled([begins[0], *arguments])
    except TypeError:
        filled = None
    if record is None or filled is None:
        return [prepared(kernel, end - begin, [begin, *arguments], device) for begin, end in ranges]
    return [_later(record, filled, begin, end) for begin, end in ranges]


def _later(record: Record, like: Any, begin: int, end: int) -> Launch:
    """The call for one range: the structure of another one with its own first row."""
    filled = record.structure.from_buffer_copy(like)
    filled.argument_0 = begin
    return Launch(record.function, record.bounds(end - begin), filled)


def adjoint(
    kernel: wp.Kernel, rows: int, arguments: Sequence[object], adjoints: Sequence[object], device: wp.Device
) -> None:
    """Runs the adjoint of a kernel on a CPU.

    Args:
        kernel, rows, arguments, device: As of `launch`; results are written again.
        adjoints: The adjoint of each argument, to which those of inputs are added; None for one that is a constant.
    """
    record = _adjoints.get(kernel)
    if record is None:
        with _recording:
            record = _adjoints.get(kernel) or Record(kernel, rows, arguments, device, adjoints)
            _adjoints[kernel] = record
    bounds, filled, added = record.bounds(rows), record.filled(arguments), record.adjoints(adjoints)
    record.function(ctypes.byref(bounds), ctypes.byref(filled), ctypes.byref(added))


def _plain(value: Any) -> Any:
    """An argument as ctypes takes it."""
    return value.__ctype__() if hasattr(value, "__ctype__") else value
