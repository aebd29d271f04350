"""What a piece of a frame does on a CPU: its launches, and the operators of torch that compute something.

While a piece is recorded, `launch.launch_rows` and `recorded.launch` give their launches to the recording, and a mode
of torch sees all operators. Those that ask for shapes, view memory or make a tensor need not be done again. What reads
numbers, or is not known here, cannot be recorded.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

from warpgarment.kernels import recorded

from .arena import GivenOut
from .team import Program

Call = Callable[[], object]

ASKS = frozenset(
    "__get__ __len__ _set_grad_enabled data_ptr device dim element_size is_contiguous is_floating_point is_inference "
    "ndimension numel size storage_offset stride untyped_storage".split()
)
"""What may be asked of a tensor, since it does not depend on its numbers."""
MAKES = frozenset("empty empty_like from_numpy new_empty tensor".split())
"""What makes a tensor that is written later, or of numbers that do not change."""
VIEWS = frozenset(
    "as_strided detach expand narrow permute select squeeze transpose unbind unflatten unsqueeze view".split()
)
"""What only views memory; other operators may, or may copy."""
WITH_OUT: dict[str, Callable[..., Any]] = {
    "__and__": torch.bitwise_and,
    "add": torch.add,
    "cat": torch.cat,
    "__eq__": torch.eq,
    "eq": torch.eq,
    "gt": torch.gt,
    "maximum": torch.maximum,
    "mul": torch.mul,
    "nan_to_num": torch.nan_to_num,
    "stack": torch.stack,
    "sub": torch.sub,
    "where": torch.where,
}
"""Operators that can write to a given tensor."""
COMPUTES = frozenset(WITH_OUT) | frozenset(
    "__getitem__ clone contiguous double flatten float full long new_zeros reshape to zeros zeros_like".split()
)
CHANGES = frozenset("add_ copy_".split())
"""Operators that change a tensor."""


class Unrecordable(Exception):
    """A piece does what cannot be replayed."""


class Recording(TorchFunctionMode):
    """What a piece did, in order. As a context it notes operators of torch; launches are given to `launches`.

    Args:
        frames: Tensors whose addresses may differ from call to call, of which only `addresses` may make use.
    """

    def __init__(self, frames: Sequence[torch.Tensor]) -> None:
        super().__init__()
        self.steps: list[Call] = []
        self._phases: list[list[recorded.Launch]] = []  # launches since the last of `steps`
        self.held: list[Any] = []
        self.memory: dict[int, int] = {}  # address and bytes of what was made
        self.places: list[tuple[np.ndarray, list[tuple[int, int]]]] = []
        self._frames, self._storages = list(frames), {_address(frame) for frame in frames}

    def launches(self, calls: Sequence[Call]) -> None:
        """Notes launches that are independent of each other."""
        phase = [call for call in calls if isinstance(call, recorded.Launch)]
        if len(phase) < len(calls):
            raise Unrecordable("a launch whose arguments have other types than in the first one")
        self._phases.append(phase)

    def step(self, call: Call | None = None) -> None:
        """Notes a call that follows the launches noted so far; None: nothing follows."""
        if self._phases:
            self.steps.append(Program(self._phases))
            self._phases = []
        if call is not None:
            self.steps.append(call)

    def addresses(self, tensors: Sequence[torch.Tensor], places: np.ndarray) -> None:
        """Notes that `places`, int64 [H], holds the addresses of tensors, some of which may be `frames`."""
        number = {id(frame): j for j, frame in enumerate(self._frames)}
        self.places.append((places, [(i, number[id(t)]) for i, t in enumerate(tensors) if id(t) in number]))

    def replay(self, frames: Sequence[torch.Tensor]) -> None:
        """Does everything again, with other `frames` in the place of those of the recording."""
        for places, numbers in self.places:
            for i, j in numbers:
                places[i] = frames[j].data_ptr()
        for call in self.steps:
            call()

    def __torch_function__(self, function: Any, types: Any, arguments: Any = (), options: Any = None) -> Any:
        options = options or {}
        name = function.__name__
        result = function(*arguments, **options)
        if name not in ASKS and recorded.notes.recording is self:  # else an interrupt has left this mode behind
            self._note(name, function, arguments, options, result)
        return result

    def _note(self, name: str, function: Any, arguments: Any, options: Any, result: Any) -> None:
        given, made = list(_tensors((*arguments, *options.values()))), list(_tensors((result,)))
        if not made:
            raise Unrecordable(name)
        self.held += [*given, *made]
        storages = {_address(tensor) for tensor in given}
        views = all(_address(tensor) in storages or not tensor.numel() for tensor in made)
        if name in VIEWS and views:
            return
        if storages & self._storages:
            raise Unrecordable(f"{name} of a frame of the history")
        if name in CHANGES:
            self.step(functools.partial(function, *arguments, **options))
        elif name in MAKES or (name in COMPUTES and not views):
            self.memory.update((_address(tensor), tensor.nbytes) for tensor in made)
            if name in COMPUTES:
                self.step(_again(name, function, arguments, options, made[0]))
        elif name not in COMPUTES:
            raise Unrecordable(name)


def _address(tensor: torch.Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _tensors(values: Any) -> Iterator[torch.Tensor]:
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, (tuple, list)):
            yield from _tensors(value)


def _again(name: str, function: Any, arguments: Any, options: Any, result: torch.Tensor) -> Call:
    """A call that computes a result anew, in its memory."""
    if name in ("zeros", "new_zeros", "zeros_like"):
        return result.zero_
    if name == "__getitem__" and any(tensor.dtype == torch.bool for tensor in _tensors(arguments[1:])):
        raise Unrecordable("a mask as an index")
    if name in WITH_OUT and (name != "where" or all(isinstance(value, torch.Tensor) for value in arguments)):
        return functools.partial(WITH_OUT[name], *arguments, **options, out=result)
    if name in ("clone", "contiguous", "double", "float", "long", "to"):
        return functools.partial(result.copy_, arguments[0])
    return lambda: result.copy_(function(*arguments, **options))


def addresses(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
    """Addresses of tensors, int64 [H]; those of the frames of a piece that is recorded are renewed in every replay."""
    places = np.array([tensor.data_ptr() for tensor in tensors])
    now = recorded.notes.recording
    if now is not None:
        now.addresses(tensors, places)
    return torch.from_numpy(places)


def passing() -> contextlib.AbstractContextManager[None]:
    """Context after which nothing is used that `operator.allocate` makes within it, whose memory is then free."""
    memory = recorded.notes.memory
    return memory.again() if isinstance(memory, GivenOut) else contextlib.nullcontext()


def also(call: Call) -> None:
    """Calls something that is neither a launch nor an operator of torch, also in replays."""
    if recorded.notes.recording is not None:
        recorded.notes.recording.step(call)
    call()


def recording() -> bool:
    """Whether this thread records a piece, in which nothing may be read."""
    return recorded.notes.recording is not None


@contextlib.contextmanager
def marked(enter: Call, leave: Call) -> Iterator[None]:
    """A block with calls before and after it, also in replays."""
    now = recorded.notes.recording
    if now is not None:
        now.step(enter)
    enter()
    try:
        yield
    finally:
        leave()
        if now is not None:
            now.step(leave)
