"""Passing torch tensors to Warp, as every operator does: checks, zero-copy views and the stream."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
import warp as wp

from . import recorded, threads
from .started import start

if wp.config.log_level == wp.LOG_INFO:  # the user's own setting stays; Warp's default prints at every module load
    wp.config.log_level = wp.LOG_WARNING

MOST_DESCRIPTORS = 16_384  # a few MB; a frame has some hundred, training has many that never recur
_descriptors: dict[tuple[object, ...], Any] = {}

_DTYPES = {torch.float32: "float32", torch.float64: "float64", torch.int32: "int32"}


def expect(
    name: str,
    tensor: torch.Tensor,
    shape: tuple[int | None, ...],
    dtype: torch.dtype = torch.float32,
    device: torch.device | None = None,
) -> None:
    """Refuses a tensor that a kernel could not read.

    Args:
        name: Name of the argument, for error messages.
        tensor: The argument to check.
        shape: Expected shape; None stands for any length.
        dtype: Expected dtype.
        device: Expected device; None accepts any device.

    Raises:
        TypeError: The argument is not a tensor or has another dtype.
        ValueError: The tensor has another shape or is on another device.
    """
    if isinstance(tensor, torch.Tensor) and tensor.dtype == dtype and (device is None or tensor.device == device):
        lengths = tensor.shape
        if len(lengths) == len(shape):
            for wanted_length, length in zip(shape, lengths, strict=True):
                if wanted_length is not None and wanted_length != length:
                    break
            else:
                return
    if not isinstance(tensor, torch.Tensor):
        raise TypeError(f"{name} must be a torch tensor, got {type(tensor).__name__}; use torch.as_tensor")
    if tensor.dtype != dtype:
        wanted = _DTYPES.get(dtype, str(dtype))
        raise TypeError(f"{name} must be {wanted}, got {str(tensor.dtype)[6:]}; use .to(torch.{wanted})")
    fits = tensor.ndim == len(shape) and all(w is None or w == n for w, n in zip(shape, tensor.shape, strict=True))
    if not fits:
        wanted = "[" + ", ".join("*" if n is None else str(n) for n in shape) + "]"
        raise ValueError(f"{name} must have shape {wanted}, got {list(tensor.shape)}")
    if device is not None and tensor.device != device:
        raise ValueError(f"{name} is on {tensor.device}, the other arguments are on {device}; move one of them")


def as_warp(tensor: torch.Tensor, dtype: type) -> wp.array:
    """A Warp array over the tensor's memory, without a gradient buffer; copies only a tensor that is not contiguous."""
    start()
    if tensor.numel() == 0:
        tensor = tensor.new_empty(tensor.shape)  # empty slices have strides that Warp refuses
    return cast(wp.array, wp.from_torch(tensor.detach().contiguous(), dtype=dtype, requires_grad=False))


def as_argument(tensor: torch.Tensor, dtype: type) -> object:
    """A tensor as an argument of a launch: a descriptor, which costs a tenth of what a Warp array costs.

    The descriptor keeps no memory alive, so the tensor must outlive the launch. A tensor that is not contiguous is
    copied into a Warp array, which keeps the copy alive.
    """
    if not tensor.is_contiguous():
        return as_warp(tensor, dtype)
    return descriptor(tensor, dtype)


def descriptor(tensor: torch.Tensor, dtype: type, key: tuple[object, ...] | None = None) -> object:
    """Address and shape of a contiguous tensor as Warp passes them, from a cached one of the same shape and type."""
    key = key or (tensor.shape, tensor.dtype, dtype)
    like = _descriptors.get(key)
    if like is None:
        if len(_descriptors) >= MOST_DESCRIPTORS:
            _descriptors.clear()
        if tensor.numel() == 0:
            tensor = tensor.new_empty(tensor.shape)  # see as_warp
        like = wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=True)
        like._ref = None  # otherwise the memory would be kept as long as the descriptor
        _descriptors[key] = like
    kind: Any = type(like)
    made = kind.from_buffer_copy(like)
    made.data = tensor.data_ptr()
    return made


def flat_argument(tensor: torch.Tensor, dtype: type) -> object:
    """The numbers of a contiguous tensor as an argument of one dimension; otherwise as `as_argument`."""
    if not tensor.is_contiguous() or tensor.numel() == 0:
        return as_argument(tensor.reshape(-1), dtype)
    key = (tensor.numel(), dtype)
    return descriptor(tensor if key in _descriptors else tensor.reshape(-1), dtype, key)


def rows_in_memory(rows: torch.Tensor) -> tuple[torch.Tensor, int]:
    """Rows [N,K] as they are in memory, which may be part of longer rows: one dimension of numbers, and the distance of
    two rows. Copies only rows whose own numbers are not next to each other."""
    if rows.stride(1) != 1 or rows.stride(0) < rows.shape[1]:
        rows = rows.contiguous()
    count, columns = rows.shape
    pitch = rows.stride(0) if count > 1 else columns
    return rows.as_strided((max(count - 1, 0) * pitch + min(count, 1) * columns,), (1,)), pitch


PER_THREAD = 3  # ranges of a launch for each thread: rows near a body take longer than others


def launch_rows(
    kernel: wp.Kernel,
    rows: int,
    inputs: Sequence[object],
    outputs: Sequence[object],
    device: wp.Device,
    *,
    least: int = 256,
    even: bool = False,
) -> None:
    """Launches a kernel over rows that are independent of each other, on a CPU in ranges on several threads.

    A row writes to its own memory only, without atomics, so the result does not depend on the ranges.

    Args:
        kernel: Kernel whose first parameter is the first row of a launch: `i = from_row + wp.tid()`.
        rows: Number of rows.
        inputs: Arguments after the first.
        outputs: Arguments after `inputs`.
        device: Warp's device.
        least: Number of rows that are worth the 0.1 ms that another range takes.
        even: Whether all rows take the same time, so that a range for each thread is enough.
    """
    if not rows:
        return
    if not device.is_cpu:
        wp.launch(kernel, dim=rows, inputs=[0, *inputs, *outputs], device=device)
        return
    count = threads.count()
    each = 1 if even else PER_THREAD
    if recorded.notes.recording is not None:  # ranges of a replay take a microsecond more, and end together
        each, least = PER_THREAD * each, max(least // 4, 1)
    parts = min(each * count, rows // least) if count > 1 else 1
    if parts > count:
        parts -= parts % count  # three ranges on two threads would take as long as four
    if parts < 2:
        recorded.launch(kernel, rows, [0, *inputs, *outputs], device)
        return
    begins = [rows * part // parts for part in range(parts + 1)]
    calls = recorded.divided(kernel, begins, [*inputs, *outputs], device)
    recorded.note(calls)
    threads.spread(calls)


def launch(kernel: wp.Kernel, rows: int, arguments: Sequence[object], device: wp.Device) -> None:
    """Launches a kernel over rows; on a CPU by the record of its first launch, on one thread.

    Args:
        kernel: A kernel of one dimension.
        rows: Number of threads.
        arguments: Its arguments, inputs and outputs.
        device: Warp's device.
    """
    if not device.is_cpu:
        wp.launch(kernel, dim=rows, inputs=arguments, device=device)
    elif rows:
        recorded.launch(kernel, rows, arguments, device)


def launch_adjoint(
    kernel: wp.Kernel, rows: int, arguments: Sequence[object], adjoints: Sequence[object], device: wp.Device
) -> None:
    """Launches the adjoint of a kernel over rows; on a CPU by the record of its first launch, on one thread.

    Args:
        kernel, rows, arguments, device: As of `launch`; results are written again.
        adjoints: The adjoint of each argument, to which those of inputs are added; None for one that is a constant.
    """
    if not device.is_cpu:
        wp.launch(kernel, dim=rows, inputs=arguments, adj_inputs=adjoints, adjoint=True, device=device)
    elif rows:
        recorded.adjoint(kernel, rows, arguments, adjoints, device)


def launch_tiled(
    kernel: wp.Kernel, rows: int, arguments: Sequence[object], device: wp.Device, *, block_dim: int
) -> None:
    """Launches a kernel with a block of lanes for each row; on a CPU a block is one lane. Arguments as of `launch`."""
    if not device.is_cpu or wp.config.enable_cpu_blocks:
        wp.launch_tiled(kernel, dim=[rows], inputs=arguments, block_dim=block_dim, device=device)
    elif rows:
        recorded.launch(kernel, rows, arguments, device)


def torch_stream(device: torch.device) -> contextlib.AbstractContextManager[wp.Device]:
    """Context in which Warp launches run on torch's current stream of the device; yields the Warp device.

    Nothing is ever put on Warp's own stream, so the two streams need not be synchronised; a graph capture would refuse
    such a wait.
    """
    return _on_cpu() if device.type != "cuda" else _on_stream(device)


@functools.cache
def _on_cpu() -> contextlib.AbstractContextManager[wp.Device]:
    """The same object for all launches on a CPU, which has no streams."""
    return contextlib.nullcontext(_cpu())


@contextlib.contextmanager
def _on_stream(device: torch.device) -> Iterator[wp.Device]:
    start()  # at first use and not at import, so that importing never touches a driver
    with wp.ScopedStream(wp.stream_from_torch(device), sync_enter=False):
        yield wp.device_from_torch(device)


@functools.cache
def _cpu() -> wp.Device:
    start()
    return wp.get_device("cpu")
