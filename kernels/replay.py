"""Pieces of a frame on a CPU, recorded once and then replayed: their kernels alone, without what Python does in between.

A frame is some forty launches and a hundred small operators of torch, most of which make or view tensors. Their shapes
and constants never change, so what a piece did can be done again in the same memory, as a CUDA graph does on a GPU:

    run("contact", function, a, b)     at first calls the function;
                                       then calls it and keeps its launches, the operators of torch that compute
                                       something, and all tensors;
                                       then replays these, and calls the function too, to compare all bits;
                                       from then on replays only: other inputs are copied to where the recorded ones are

A piece must do the same whatever the numbers are. So nothing in it may read a tensor; an operator that does, or that is
not known here, ends the recording, and the piece is always called. Between pieces the host may read and branch.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch.overrides import TorchFunctionMode

from . import recorded, threads
from .arena import Arena, Observed
from .team import Program

Call = Callable[[], object]
Tensors = tuple[torch.Tensor | None, ...]

CHECKS = 3
"""Calls in which a replay is compared with the function."""
WARM_UP = 2
"""Calls of a piece before it is recorded: kernels are loaded, and constants made."""
ASKS = frozenset(
    "__get__ __len__ _set_grad_enabled data_ptr device dim element_size is_contiguous is_floating_point is_inference ndimension numel size stride "
    "storage_offset untyped_storage".split()
)
"""What may be asked of a tensor, since it does not depend on its numbers."""
MAKES = frozenset("empty empty_like from_numpy new_empty tensor".split())
"""What makes a tensor that is written later, or of numbers that do not change."""
VIEWS = frozenset("as_strided detach expand unbind view".split())
"""What only views memory; other operators may, or may copy."""
WITH_OUT = {
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
COMPUTES = frozenset([*WITH_OUT, *"__getitem__ clone contiguous double flatten float full long new_zeros to zeros zeros_like".split()])
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

    def __torch_function__(self, function: Any, types: Any, arguments: Any = (), options: Any = None) -> Any:
        options = options or {}
        name = function.__name__
        result = function(*arguments, **options)
        if name not in ASKS:
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


class _Piece:
    """One piece: how often it was called, and its recording."""

    def __init__(self, depends: object) -> None:
        self.depends, self.seen, self.failed = depends, 0, False
        self.recording: Recording | None = None
        self.inputs: Tensors = ()
        self.outputs: Tensors = ()
        self.apart: list[int] = []  # tensors that are results, as `Observed` numbers them
        self.checks = 0


class Pieces:
    """Runs the pieces of the frames of one scene.

    Args:
        on: Whether pieces are recorded; otherwise their functions are called.
    """

    def __init__(self, *, on: bool = False) -> None:
        self.on = on
        self._known: dict[tuple[object, ...], _Piece] = {}
        self._own: set[int] = set()  # outputs of recorded pieces
        self._arena = Arena()

    def clear(self) -> None:
        """Forgets all recordings."""
        self._known.clear()
        self._own.clear()
        self._arena = Arena()

    def kept(self, tensor: torch.Tensor) -> torch.Tensor:
        """The same numbers in memory that no later frame changes."""
        return tensor.clone() if id(tensor) in self._own else tensor

    def __call__(
        self,
        key: object,
        function: Callable[..., Tensors],
        inputs: Tensors,
        frames: Sequence[torch.Tensor] = (),
        depends: object = None,
    ) -> Tensors:
        """Results of `function(*inputs, *frames)`.

        Args:
            key: Name of the piece. Calls of the same name do the same.
            function: Computes the results; what else it reads is constant.
            inputs: Tensors, of the same shapes in all calls of a name, or None.
            frames: Further tensors, which are read where they are and not copied; all have the same strides.
            depends: Object that is another one when constants have changed; the piece is then recorded anew.

        Returns:
            Tensors, which the next call with this name may overwrite; see `kept`.
        """
        if not self.on or torch.is_grad_enabled():
            return function(*inputs, *frames)
        name = (key, threads.count(), *(tensor is None for tensor in inputs))
        piece = self._known.get(name)
        if piece is None or piece.depends is not depends:
            piece = self._known[name] = _Piece(depends)
        piece.seen += 1
        if piece.failed or piece.seen < WARM_UP:
            return function(*inputs, *frames)
        if piece.seen == WARM_UP:
            seen = Observed()
            with recorded.noted(None, seen):
                outputs = function(*inputs, *frames)
            piece.apart = seen.among(outputs)
            return outputs
        if piece.recording is None:
            return self._record(piece, function, inputs, frames)
        for held, given in zip(piece.inputs, inputs, strict=True):
            if held is not given:
                assert held is not None and given is not None
                held.copy_(given)
        _replay(piece.recording, frames)
        return piece.outputs if piece.checks == CHECKS else self._check(key, piece, function, frames)

    def _record(
        self, piece: _Piece, function: Callable[..., Tensors], inputs: Tensors, frames: Sequence[torch.Tensor]
    ) -> Tensors:
        """Calls a function and records what it does."""
        held = tuple(t if t is None or id(t) in self._own else t.clone() for t in inputs)
        recording = Recording(frames)
        try:
            with recorded.noted(recording, self._arena.given_out(piece.apart)), recording:
                outputs = function(*held, *frames)
            recording.step()
        except Unrecordable:
            piece.failed = True
            return function(*inputs, *frames)
        piece.recording, piece.inputs, piece.outputs = recording, held, outputs
        mine = {id(t) for t, given in zip(held, inputs, strict=True) if t is not given} | self._own
        self._own.update(id(t) for t in outputs if t is not None and (id(t) in mine or _address(t) in recording.memory))
        return outputs

    def _check(
        self, key: object, piece: _Piece, function: Callable[..., Tensors], frames: Sequence[torch.Tensor]
    ) -> Tensors:
        """Compares what a replay wrote with what the function returns."""
        wrote = [t if t is None else t.clone() for t in piece.outputs]
        wanted = function(*piece.inputs, *frames)
        same = all(
            a is b or (a is not None and b is not None and _same_bits(a, b))
            for a, b in zip(wrote, wanted, strict=True)
        )
        if same:
            piece.checks += 1
        else:
            piece.failed, piece.recording = True, None
            warnings.warn(
                f"{key} is not replayed: a replay gave other numbers. Please report it", RuntimeWarning, stacklevel=6
            )
        return wanted


def _same_bits(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether two tensors have the same bits, NaN included."""
    return one.shape == other.shape and one.dtype == other.dtype and _bytes(one) == _bytes(other)


def _bytes(tensor: torch.Tensor) -> bytes:
    return tensor.detach().contiguous().numpy().tobytes()


def _replay(recording: Recording, frames: Sequence[torch.Tensor]) -> None:
    for places, numbers in recording.places:
        for i, j in numbers:
            places[i] = frames[j].data_ptr()
    for step in recording.steps:
        step()


def addresses(tensors: Sequence[torch.Tensor]) -> torch.Tensor:
    """Addresses of tensors, int64 [H]; those of the frames of a piece that is recorded are renewed in every replay."""
    places = np.array([tensor.data_ptr() for tensor in tensors])
    now = recorded.notes.recording
    if now is not None:
        now.addresses(tensors, places)
    return torch.from_numpy(places)


def also(call: Call) -> None:
    """Calls something that is neither a launch nor an operator of torch, also in replays."""
    if recorded.notes.recording is not None:
        recorded.notes.recording.step(call)
    call()


def recording() -> bool:
    """Whether this thread records a piece, in which nothing may be read."""
    return recorded.notes.recording is not None


@contextmanager
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
