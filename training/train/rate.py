"""Speed of a training run: samples and operations per second, and the latter as a share of the devices' peak."""

from __future__ import annotations

import time

import torch

from warpgarment.nn.flops import matrix_peak


class Rate:
    """A stopwatch for training steps, which is stopped while a run validates, saves or refreshes its pool.

    Args:
        device: Device of this process.
        precision: "float32" or "bfloat16".
        processes: Number of processes that train together, each on such a device.
    """

    def __init__(self, device: torch.device, precision: str, processes: int) -> None:
        self.peak, self.processes = matrix_peak(device, precision), processes
        self._began: float | None = None
        self._spent, self._samples, self._flops = 0.0, 0, 0

    def go(self) -> None:
        """Starts the stopwatch."""
        self._began = time.monotonic()

    def stop(self) -> None:
        """Stops the stopwatch until the next `go`."""
        if self._began is not None:
            self._spent += time.monotonic() - self._began
        self._began = None

    def count(self, samples: int, flops: int) -> None:
        """Adds one step, with its numbers of samples and operations in this process."""
        self._samples += samples
        self._flops += flops

    def take(self) -> dict[str, float]:
        """Figures of all processes together since the last call.

        The device must have finished all steps that were counted.

        Returns:
            `samples_per_second`, `model_tflops_per_second`, and, if the peak of the device is known,
            `matrix_peak_share` from 0 to 1.
        """
        running = self._began is not None
        self.stop()
        seconds = max(self._spent, 1e-9)
        speed = self._flops / seconds
        found = {
            "samples_per_second": self.processes * self._samples / seconds,
            "model_tflops_per_second": self.processes * speed / 1e12,
        }
        if self.peak:
            found["matrix_peak_share"] = speed / self.peak
        self._spent, self._samples, self._flops = 0.0, 0, 0
        if running:
            self.go()
        return found


def spelt(figures: dict[str, float]) -> str:
    """Figures of `Rate.take` as text."""
    text = f"{figures['samples_per_second']:.1f} samples/s, {figures['model_tflops_per_second']:.3g} TFLOP/s"
    if "matrix_peak_share" in figures:
        text += f", {figures['matrix_peak_share']:.1%} of the matrix peak"
    return text
