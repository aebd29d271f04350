"""Pieces of a frame on a CPU, recorded once and then replayed: their kernels alone, without Python in between.

A frame is some forty launches and a hundred small operators of torch, most of which make or view tensors. Their shapes
and constants never change, so what a piece did can be done again in the same memory, as a CUDA graph does on a GPU:

    run("contact", function, a, b)     at first, ten times, calls the function;
                                       then calls it and keeps its launches, the operators of torch that compute
                                       something, and all tensors;
                                       then replays these, and calls the function too, to compare all bits;
                                       from then on replays only: other inputs are copied to where the recorded ones are

A piece must do the same whatever the numbers are. So nothing in it may read a tensor; an operator that does, or that is
not known here, ends the recording, and the piece is always called. Between pieces the host may read and branch.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch

from warpgarment.kernels import recorded, threads

from .arena import Arena, Observed
from .recording import Recording, Unrecordable

Tensors = tuple[Any, ...]  # some may be None

CHECKS = 3
"""Calls in which a replay is compared with the function."""
WARM_UP = 10
"""Calls of a piece before it is recorded: kernels are loaded and constants made, and a short rollout is over, which
would not win back what a recording costs."""
FIRST = WARM_UP + 1 + CHECKS
"""Calls before the first one that is only replayed."""


class _Piece:
    """One piece: how often it was called before its recording, and that."""

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
        self._own: dict[int, torch.Tensor] = {}  # results that are written in every replay, by their `id`
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
            self._drop()
        if piece.failed:
            return function(*inputs, *frames)
        if piece.seen < WARM_UP:
            observed = Observed()
            with recorded.noted(None, observed):
                outputs = function(*inputs, *frames)
            piece.apart = observed.among(outputs)
            piece.seen += 1  # not before: a call that was interrupted has warmed nothing up
            return outputs
        if piece.recording is None:
            return self._record(piece, function, inputs, frames)
        for held, given in zip(piece.inputs, inputs, strict=True):
            if held is not given:
                held.copy_(given)
        piece.recording.replay(frames)
        return piece.outputs if piece.checks == CHECKS else self._check(key, piece, function, frames)

    def _drop(self) -> None:
        """Lets go of results of recordings that are forgotten; those that other pieces read in place stay."""
        used = {id(t) for piece in self._known.values() for t in (*piece.inputs, *piece.outputs)}
        self._own = {number: t for number, t in self._own.items() if number in used}

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
        copied = {id(t) for t, given in zip(held, inputs, strict=True) if t is not given}
        for t in outputs:
            if t is not None and (id(t) in copied or t.untyped_storage().data_ptr() in recording.memory):
                self._own[id(t)] = t
        piece.inputs, piece.outputs = held, outputs
        piece.recording = recording  # last, since an interrupt must not leave half of this
        return outputs

    def _check(
        self, key: object, piece: _Piece, function: Callable[..., Tensors], frames: Sequence[torch.Tensor]
    ) -> Tensors:
        """Compares what a replay wrote with what the function returns."""
        wrote: list[Any] = [t if t is None else t.clone() for t in piece.outputs]
        wanted = function(*piece.inputs, *frames)
        if all(one is other or _same_bits(one, other) for one, other in zip(wrote, wanted, strict=True)):
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
