"""Where the time of a frame goes."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import torch


class Timings(dict[str, float]):
    """Seconds per stage, added up; call it with a stage's name around the stage.

    On CUDA a stage returns before the device is done with it. Its time is measured only while `synchronise` is set, and
    waiting makes the whole slower; the CPU is always measured.
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
