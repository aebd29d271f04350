"""Gradients of weights that are used several times in a graph: added up in one place, while the gradient goes on.

The gradient of a step of unrolled training goes back through each layer once for every frame. The gradients of the
layer's weights are sums over all frames that nothing else waits for, so they are calls of a `threads.Aside`: they run
on threads that have nothing else to do, in the order of the frames. A layer's function reads a `token` [], which is a
function of all its weights; the gradient of the token is asked for after those of all frames, and then the sums are
finished and become the gradients of the weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from warpgarment.kernels.threads import Aside, torch_on_one

from . import changes

Finish = Callable[[torch.Tensor], Sequence[torch.Tensor | None]]
M = TypeVar("M", bound=nn.Module)
W = TypeVar("W")


class Gathered:
    """Sums of one layer or one group of layers.

    Args:
        size: Number of entries of the sums, float32.
        finish: Function from the sums [size] to the gradients of the parameters, in their order.

    Attributes:
        asked: Whether gradients were asked for: the weights may be other ones since then, and nobody may have counted
            that (`weight.data -= rate * weight.grad`).
    """

    def __init__(self, size: int, finish: Finish) -> None:
        self.size, self._finish, self.asked = size, finish, False
        self._open: dict[int, tuple[torch.Tensor, Aside]] = {}  # by backward pass; an earlier one may have failed

    def token(self, parameters: Sequence[torch.Tensor]) -> torch.Tensor:
        """A number, zero, through which gradients flow to the parameters."""
        found: torch.Tensor = _Token.apply(self, *parameters)
        return found

    def sums(self) -> tuple[torch.Tensor, Aside]:
        """The sums of this backward pass, zero at first, and the calls that add to them."""
        task = torch._C._current_graph_task_id()
        if task not in self._open:
            self._open.clear()
            self._open[task] = torch.zeros(self.size), Aside()
        return self._open[task]

    def gradients(self, count: int) -> Sequence[torch.Tensor | None]:
        """Gradients of `count` parameters; None for each if this backward pass has not used them."""
        found = self._open.pop(torch._C._current_graph_task_id(), None)
        if found is None:
            return [None] * count
        sums, aside = found
        self.asked = True
        aside.finish()
        with torch_on_one():  # its sums depend on the number of threads
            return self._finish(sums)


@dataclass(frozen=True)
class Made(Generic[W]):
    """What is made of the weights of a module."""

    weights: W  # as kernels read them
    size: int  # of the sums
    finish: Finish  # as of `Gathered`


class Packed(Generic[M, W]):
    """Packed weights of modules and what gathers their gradients, made anew when a weight may have changed.

    Args:
        parameters: Function from a module to its parameters, in the order of their gradients.
        make: Function from a module and its parameters, without gradients, to what is made of them. It runs on one
            thread, on whose number sums of torch depend.
    """

    def __init__(
        self,
        parameters: Callable[[M], list[torch.Tensor]],
        make: Callable[[M, list[torch.Tensor]], Made[W]],
    ) -> None:
        self._parameters, self._make = parameters, make
        self._known: WeakKeyDictionary[M, tuple[object, W, Gathered, torch.Tensor]] = WeakKeyDictionary()

    def __call__(self, module: M) -> tuple[W, Gathered, torch.Tensor]:
        """The weights of a module, what gathers their gradients, and its token."""
        parameters = self._parameters(module)
        versions = [(each.data_ptr(), changes.version(each), each.requires_grad) for each in parameters]
        key = changes.optimiser_steps(), versions
        known = self._known.get(module)
        if known is None or known[0] != key or known[2].asked:
            with torch_on_one(), torch.no_grad():
                made = self._make(module, [each.detach() for each in parameters])
            gathered = Gathered(made.size, made.finish)
            known = self._known[module] = key, made.weights, gathered, gathered.token(parameters)
        return known[1:]


def behind_norm(
    slope: torch.Tensor, of_bias: torch.Tensor, scale: torch.Tensor, shift: torch.Tensor, weight: torch.Tensor
) -> tuple[tuple[torch.Tensor, torch.Tensor], torch.Tensor, torch.Tensor]:
    """Gradients of a norm's scale and shift [I], of a layer's weights [O,I] and of its bias [O], from those of the
    weights and the bias into which the norm was folded."""
    norm = (weight * slope).sum(dim=0), of_bias @ weight
    return norm, torch.addcmul(torch.outer(of_bias, shift), slope, scale), of_bias


class _Token(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gathered: Gathered, *parameters: torch.Tensor) -> torch.Tensor:
        ctx.gathered, ctx.count = gathered, len(parameters)
        return torch.zeros(())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, _gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        return None, *ctx.gathered.gradients(ctx.count)
