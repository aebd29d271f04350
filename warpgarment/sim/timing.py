"""Measures the time of the stages of a frame."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import torch


class Timings(dict[str, float]):
    """Total seconds of each stage; a call with the name of a stage is a context manager that measures a block.

    On CUDA, a stage returns before the device has finished it. So its time is measured only while `synchronise` is set,
    which makes frames slower, since the host waits after every stage. On a CPU, times are always measured.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self.device = device
        self.synchronise = False

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Adds the time of the block to the stage."""
        cuda = self.device.type == "cuda"
        if cuda and not self.synchronise:
            yield
            return
        if cuda:
            torch.cuda.synchronize(self.device)
        start = time.perf_counter()
        try:
            yield
        finally:
            if cuda:
                torch.cuda.synchronize(self.device)
            self[stage] = self.get(stage, 0.0) + time.perf_counter() - start
