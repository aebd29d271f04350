"""Turns a Warp kernel with one thread per row into a differentiable torch operator.

The operator (`registered.py`) has a fake implementation, so `torch.compile` and `torch.export` accept
it; its backward is a second custom operator that launches the kernel's adjoint, or a kernel of its own. Tensors go in
and out without copies.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, TypeVar, get_type_hints

import torch
import warp as wp

from . import threads
from .launch import as_argument, launch_adjoint, torch_stream
from .launch import launch as run
from .recorded import notes
from .registered import Operator

_Model = TypeVar("_Model")
Outputs = dict[str, tuple[type, tuple[int, ...]]]  # name -> (Warp element type, shape of one row)


def allocate(shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Uninitialised memory for an output, which the kernel writes completely; tests fill it with NaN instead."""
    if notes.memory is not None and device.type == "cpu":
        return notes.memory(shape, dtype)
    return torch.empty(tuple(shape), dtype=dtype, device=device)


def launch(
    kernel: wp.Kernel,
    rows: int,
    inputs: Sequence[tuple[torch.Tensor, type]],
    outputs: Sequence[tuple[torch.Tensor, type]],
    device: torch.device,
) -> None:
    """Runs a kernel forward over `rows` threads on torch's stream; does nothing if there are no rows."""
    if rows == 0:
        return
    with torch_stream(device) as warp_device:
        run(kernel, rows, [as_argument(tensor, dtype) for tensor, dtype in (*inputs, *outputs)], warp_device)


def row_operator(
    name: str,
    kernel: wp.Kernel,
    inputs: dict[str, type],
    outputs: Outputs,
    *,
    rows: str,
    gradients: Sequence[str] = (),
    backward: wp.Kernel | None = None,
    owner: str | None = None,
    shared: Sequence[str] = (),
) -> Callable[..., Any]:
    """Registers `warpgarment::name`, an operator that runs `kernel` once per row.

    Args:
        name: Operator name; the backward operator is called `name_backward`.
        kernel: Kernel that takes the inputs, then the outputs; thread i writes row i of every output.
        inputs: Name and Warp element type of each tensor, in the kernel's order.
        outputs: Name, Warp element type and row shape of each result, in the kernel's order.
        rows: Name of the input whose length is the number of rows.
        gradients: Names of the inputs that gradients flow to.
        backward: Kernel that takes the inputs, then the gradients of the results, and writes those of these inputs;
            None for the adjoint that Warp derives.
        owner: Name of an input with what each row belongs to, int32 in rising order. Rows that belong to different
            things add to different parts of all gradients, so on a CPU their adjoints run on several threads.
        shared: Names of the inputs that have no row for each row; asked for with an `owner`.

    Returns:
        The operator. It takes tensors in the order of `inputs` and returns one tensor, or a tuple of several. It does
        not check its arguments.
    """
    names, types = list(inputs), list(inputs.values())
    kinds = [kind for kind, _ in outputs.values()]
    row_index, wanted = names.index(rows), [names.index(n) for n in gradients]

    def torch_type(warp_type: type) -> torch.dtype:
        return wp.dtype_to_torch(getattr(warp_type, "_wp_scalar_type_", warp_type))

    def empty_outputs(tensors: Sequence[torch.Tensor], new: Callable[..., torch.Tensor]) -> list[torch.Tensor]:
        at = tensors[row_index]
        return [new((at.shape[0], *tail), dtype=torch_type(kind), device=at.device) for kind, tail in outputs.values()]

    def unpacked(results: list[torch.Tensor]) -> Any:
        return results[0] if len(results) == 1 else tuple(results)

    def forward(*tensors: torch.Tensor) -> Any:
        results = empty_outputs(tensors, allocate)
        arguments, typed_results = zip(tensors, types, strict=True), zip(results, kinds, strict=True)
        at = tensors[row_index]
        launch(kernel, at.shape[0], list(arguments), list(typed_results), at.device)
        return unpacked(results)

    def fake(*tensors: torch.Tensor) -> Any:
        return unpacked(empty_outputs(tensors, torch.empty))

    operator = Operator(f"warpgarment::{name}", forward, _schema(names, len(outputs)))
    operator.register_fake(fake)
    if not wanted:
        return operator

    def pulled(*tensors: torch.Tensor) -> Any:
        arguments, incoming = tensors[: len(names)], tensors[len(names) :]
        results = [torch.zeros(arguments[i].shape, dtype=torch.float32, device=arguments[i].device) for i in wanted]
        at = arguments[row_index]
        if at.shape[0] == 0:
            return unpacked(results)
        if backward is not None:
            given = [*zip(arguments, types, strict=True), *zip(incoming, kinds, strict=True)]
            launch(
                backward, at.shape[0], given, [(r, types[i]) for r, i in zip(results, wanted, strict=True)], at.device
            )
            return unpacked(results)
        # The adjoint writes into the incoming gradients, which autograd may still hold, so it is given copies. It also
        # runs the forward pass again, whose results go to scratch memory.
        copies = [torch.clone(g, memory_format=torch.contiguous_format) for g in incoming]
        scratch = empty_outputs(arguments, torch.empty)
        gradient_of = dict(zip(wanted, results, strict=True))

        def adjoint(begin: int, end: int) -> None:
            def of(i: int, tensor: torch.Tensor) -> torch.Tensor:
                return tensor if owner is None or names[i] in shared else tensor[begin:end]

            given = [as_argument(of(i, tensor), types[i]) for i, tensor in enumerate(arguments)]
            made = [as_argument(tensor[begin:end], kind) for tensor, kind in zip(scratch, kinds, strict=True)]
            adjoints: list[object] = [None] * len(names)
            for i, tensor in gradient_of.items():
                adjoints[i] = as_argument(of(i, tensor), types[i])
            adjoints += [as_argument(tensor[begin:end], kind) for tensor, kind in zip(copies, kinds, strict=True)]
            with torch_stream(at.device) as warp_device:
                launch_adjoint(kernel, end - begin, [*given, *made], adjoints, warp_device)

        begins = [0, at.shape[0]]
        if owner is not None and at.device.type == "cpu" and threads.count() > 1:
            belongs = arguments[names.index(owner)]
            begins[1:1] = ((belongs[1:] != belongs[:-1]).nonzero()[:, 0] + 1).tolist()
        threads.spread([partial(adjoint, begin, end) for begin, end in itertools.pairwise(begins)])
        return unpacked(results)

    def fake_backward(*tensors: torch.Tensor) -> Any:
        return unpacked([torch.empty(tensors[i].shape, device=tensors[i].device) for i in wanted])

    received = names + [f"grad_{n}" for n in outputs]
    backward_operator = Operator(f"warpgarment::{name}_backward", pulled, _schema(received, len(wanted)))
    backward_operator.register_fake(fake_backward)

    def save(ctx: Any, inputs: tuple[torch.Tensor, ...], output: Any) -> None:
        ctx.save_for_backward(*inputs)

    def pull_back(ctx: Any, *incoming: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        results = backward_operator(*ctx.saved_tensors, *incoming)
        gradients_of_inputs: list[torch.Tensor | None] = [None] * len(names)
        for i, gradient in zip(wanted, results if len(wanted) > 1 else [results], strict=True):
            gradients_of_inputs[i] = gradient if ctx.needs_input_grad[i] else None
        return tuple(gradients_of_inputs)

    operator.register_autograd(pull_back, setup_context=save)
    return operator


class Packed(list[torch.Tensor]):
    """Constants of a solver as the one list of tensors that an operator takes, with what was made of it."""

    def __init__(self, tensors: Sequence[torch.Tensor]) -> None:
        super().__init__(tensors)
        self.made: dict[object, Any] = {}


def made_of(model: list[torch.Tensor], make: Callable[[list[torch.Tensor]], _Model]) -> _Model:
    """The result of a function of constants; called once for a list that is `Packed`."""
    if not isinstance(model, Packed):
        return make(model)
    if make not in model.made:
        model.made[make] = make(model)
    result: _Model = model.made[make]
    return result


def pack(model: tuple[Any, ...]) -> list[torch.Tensor]:
    """Flattens a named tuple into the one list of tensors that an operator takes.

    Args:
        model: Named tuple whose fields are tensors, numbers or other such tuples. A number becomes a tensor of no
            dimension on the host; a tuple is replaced by its own fields.
    """
    tensors: list[torch.Tensor] = []
    for value in model:
        if isinstance(value, torch.Tensor):
            tensors.append(value)
        else:
            tensors += pack(value) if isinstance(value, tuple) else [torch.tensor(value)]
    return tensors


def unpack(packed: Sequence[torch.Tensor], kind: type[_Model]) -> _Model:
    """The inverse of `pack`: a named tuple from its list of tensors. Reads nothing from a device.

    Args:
        packed: List of tensors that `pack` returned.
        kind: Class of the named tuple; its annotations decide which fields are numbers.

    Raises:
        ValueError: The list is too short or too long for the class.
    """
    values = iter(packed)
    try:
        model = _unpacked(values, kind)
    except StopIteration:
        raise ValueError(f"{len(packed)} tensors are too few for a {kind.__name__}") from None
    if left := len(list(values)):
        raise ValueError(f"{len(packed)} tensors are {left} too many for a {kind.__name__}")
    return model


def _unpacked(values: Iterator[torch.Tensor], kind: Any) -> Any:
    if kind is torch.Tensor:
        return next(values)
    if kind in (int, bool, float):
        return kind(next(values))
    return kind(*[_unpacked(values, field) for field in _types(kind)])


@lru_cache
def _types(kind: type) -> tuple[Any, ...]:
    """The types of a named tuple's fields, in order."""
    return tuple(get_type_hints(kind).values())


def _schema(arguments: Sequence[str], results: int) -> str:
    returned = "Tensor" if results == 1 else "(" + ", ".join(["Tensor"] * results) + ")"
    return "(" + ", ".join(f"Tensor {name}" for name in arguments) + f") -> {returned}"
