"""Registers functions as torch operators.

`torch.library.custom_op` loads torch's compiler when an operator first runs, which takes 1.5 seconds and 70 MB. The
parts that it is made of do not: a definition, a function for all devices, one for shapes, and one for gradients. It
also checks that no result shares memory with an argument; those of this project allocate theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch


class Operator:
    """A torch operator; calling it calls the operator.

    Args:
        name: Name with its namespace, "warpgarment::name".
        function: What it does on any device. It changes no argument.
        schema: Types of its arguments and results; None for those of the annotations.

    Attributes:
        function: The same function, which is called without torch's dispatcher, and so without gradients.
    """

    def __init__(self, name: str, function: Callable[..., Any], schema: str | None = None) -> None:
        self.name, self.function, self.__doc__ = name, function, function.__doc__
        torch.library.define(name, schema or torch.library.infer_schema(function, mutates_args=()))
        torch.library.impl(name, "default", function)
        namespace, local = name.split("::")
        self._overload = getattr(getattr(torch.ops, namespace), local).default

    def __call__(self, *args: Any) -> Any:
        """Calls the operator."""
        return self._overload(*args)

    def directly(self, gradient: type[torch.autograd.Function], *args: Any) -> Any:
        """Calls the function past torch's dispatcher, which takes a millisecond for a list of tensors.

        Args:
            gradient: The same function with its gradient, for arguments that require one.
            args: Arguments of the operator; tensors within lists are constants.
        """
        if torch.compiler.is_compiling():
            return self(*args)
        if torch.is_grad_enabled() and any(isinstance(value, torch.Tensor) and value.requires_grad for value in args):
            return gradient.apply(*args)
        return self.function(*args)

    def register_fake(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Registers what the shapes of the results are."""
        torch.library.register_fake(self.name, function)
        return function

    def register_autograd(self, backward: Callable[..., Any], *, setup_context: Callable[..., Any]) -> None:
        """Registers the gradient, as `torch.library.register_autograd`."""
        torch.library.register_autograd(self.name, backward, setup_context=setup_context)


def operator(name: str, schema: str | None = None) -> Callable[[Callable[..., Any]], Operator]:
    """A decorator that makes an `Operator` of a function."""
    return lambda function: Operator(name, function, schema)
