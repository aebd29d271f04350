"""Measures the time of the stages of a frame."""

from __future__ import annotations

import contextlib
import time

import torch

from warpgarment.kernels.replay.recording import marked, recording


class Timings(dict[str, float]):
    """Total seconds of each stage; a call with the name of a stage is a context manager that measures a block.

    On CUDA, a stage returns before the device has finished it. So its time is measured only while `synchronise` is set,
    which makes frames slower, since the host waits after every stage. On a CPU, times are always measured.
    """

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self.device = device
        self.synchronise = False

    def __call__(self, stage: str) -> contextlib.AbstractContextManager[None]:
        """A block whose time is added to the stage."""
        if self.device.type == "cuda" and not self.synchronise:
            return contextlib.nullcontext()
        block = _Block(self, stage)
        return marked(block.__enter__, block.__exit__) if recording() else block


class _Block:
    def __init__(self, timings: Timings, stage: str) -> None:
        self._timings, self._stage = timings, stage

    def __enter__(self) -> None:
        self._wait()
        self._start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._wait()
        spent = time.perf_counter() - self._start
        self._timings[self._stage] = self._timings.get(self._stage, 0.0) + spent

    def _wait(self) -> None:
        if self._timings.device.type == "cuda":
            torch.cuda.synchronize(self._timings.device)
