r"""Several processes that train one network, started by torchrun, on one machine or many.

Each process has a device of its own, takes its share of every batch, and holds the same weights. They exchange numbers
through a `Group`. A single process is a group of one, whose calls cost nothing.

    export TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1        # else torchrun's restarts meet old addresses (torch 2.13)
    torchrun --standalone --nproc-per-node 8 --max-restarts 3 -m warpgarment train --data DATA --out OUT \
        --steps 200000 --resume

Small numbers, such as the elapsed time, are exchanged between CPUs by gloo, so that no process waits for its GPU;
gradients are exchanged between GPUs by NCCL.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from datetime import timedelta
from types import TracebackType

import torch
import torch.distributed as dist

from warpgarment.nn.device import device_of

PATIENCE = timedelta(hours=2)  # limit of a wait; the other processes wait while the first one validates
FRESH = "TORCH_DISABLE_SHARE_RDZV_TCP_STORE"


class GroupError(RuntimeError):
    """The processes of a run cannot work together; the message names the reason."""


class Group:
    """The processes of a run.

    Args:
        device: "cpu", "cuda" or "cuda:1"; None takes a GPU if there is one. If there are several processes on a machine
            with GPUs, each takes the GPU with its own local number.

    Attributes:
        rank: Number of this process. Number 0 writes files, logs and validates.
        size: Number of processes.
        device: Device on which this process trains.

    Raises:
        GroupError: There are more processes than GPUs, or all processes would share a device.
    """

    def __init__(self, device: str | None = None) -> None:
        self.rank, self.size = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
        self.device = device_of(device)
        if self.size > 1 and self.device.type == "cuda" and torch.device(device or "cuda").index is None:
            self.device = torch.device("cuda")  # `_join` gives each process its own
        if self.size > 1:
            self._join()

    def _join(self) -> None:
        local = int(os.environ.get("LOCAL_RANK", 0))
        if self.device.type == "cuda":
            if self.device.index is not None:
                raise GroupError(f"{self.size} processes cannot share {self.device}. Say --device cuda, or nothing.")
            if local >= torch.cuda.device_count():
                raise GroupError(
                    f"process {local} of this machine has no GPU, there are {torch.cuda.device_count()}. Start as many "
                    "processes as there are GPUs (torchrun --nproc-per-node), or train with --device cpu."
                )
            self.device = torch.device("cuda", local)
            torch.cuda.set_device(self.device)
        backend = "cpu:gloo,cuda:nccl" if self.device.type == "cuda" else "gloo"
        try:
            dist.init_process_group(backend, timeout=PATIENCE)
        except RuntimeError as error:
            if os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") == "0":
                raise
            raise GroupError(
                f"after a restart, process {self.rank} cannot reach the others ({error}). Start torchrun with "
                f"{FRESH}=1 in the environment: without it, it hands out addresses of processes that are gone."
            ) from error

    def __enter__(self) -> Group:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the group, except after an error, since other processes may still wait in it."""
        if self.size > 1 and kind is None:
            dist.barrier()
            dist.destroy_process_group()

    @property
    def first(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    def part(self, batch_size: int) -> slice:
        """The range of samples of a batch that this process takes.

        Args:
            batch_size: Number of samples in the batch.

        Raises:
            GroupError: The samples cannot be shared evenly.
        """
        if batch_size % self.size:
            raise GroupError(
                f"{self.size} processes cannot share batches of {batch_size} samples evenly. Choose a batch size that "
                f"is a multiple of {self.size}, such as {-(-batch_size // self.size) * self.size}."
            )
        count = batch_size // self.size
        return slice(self.rank * count, (self.rank + 1) * count)

    def broadcast(self, tensor: torch.Tensor, source: int = 0) -> torch.Tensor:
        """Copies the tensor of one process, number `source`, into that of every process; returns the tensor."""
        if self.size > 1:
            dist.broadcast(tensor, source)
        return tensor

    def same(self, tensors: Iterable[torch.Tensor]) -> None:
        """Replaces tensors, in place, by those of the first process."""
        for tensor in tensors:
            self.broadcast(tensor.detach())

    def mean(self, tensor: torch.Tensor) -> torch.Tensor:
        """Mean over the processes; the tensor is overwritten with it."""
        if self.size > 1:
            dist.all_reduce(tensor)
            tensor /= self.size
        return tensor

    def from_first(self, value: float) -> float:
        """The value of the first process, in all processes."""
        return value if self.size == 1 else float(self.broadcast(torch.tensor([value], dtype=torch.float64)))

    def agree(self, what: str, value: int, remedy: str) -> None:
        """Checks that a number is the same in all processes.

        Args:
            what: Name of the number, for the error message.
            value: The number in this process.
            remedy: Sentence that names the remedy.

        Raises:
            GroupError: The number differs; raised in all processes.
        """
        if self.size == 1:
            return
        own = torch.tensor([value], dtype=torch.int64)
        gathered = [torch.empty_like(own) for _ in range(self.size)]
        dist.all_gather(gathered, own)
        values = [int(v) for v in gathered]
        if len(set(values)) > 1:
            other = next(r for r, v in enumerate(values) if v != values[0])
            raise GroupError(
                f"{what} differs between processes 0 ({values[0]}) and {other} ({values[other]}). {remedy}"
            )

    def wait(self) -> None:
        """Waits until all processes have called this."""
        if self.size > 1:
            dist.barrier()
