"""How fast a training runs: samples and operations per second, and the share of what the devices could do at best."""

from __future__ import annotations

import time

import torch

from warpgarment.nn.flops import matrix_peak


class Rate:
    """A stopwatch for training steps, which stands still while a run validates, saves or refreshes its pool.

    Args:
        device: Of this process.
        precision: "float32" or "bfloat16".
        processes: How many train together, each on such a device.
    """

    def __init__(self, device: torch.device, precision: str, processes: int) -> None:
        self.peak, self.processes = matrix_peak(device, precision), processes
        self._began: float | None = None
        self._spent, self._samples, self._flops = 0.0, 0, 0

    def go(self) -> None:
        """Time counts from now on."""
        self._began = time.monotonic()

    def stop(self) -> None:
        """Time does not count until the next `go`."""
        if self._began is not None:
            self._spent += time.monotonic() - self._began
        self._began = None

    def count(self, samples: int, flops: int) -> None:
        """One step: samples and operations of this process alone."""
        self._samples += samples
        self._flops += flops

    def take(self) -> dict[str, float]:
        """Figures of all processes together since the last call.

        Call it when the device is done with what was counted.

        Returns:
            `samples_per_second`, `model_tflops_per_second`, and where the device's peak is known
            `matrix_peak_share`, 0..1.
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
    """`figures` of a rate for people."""
    text = f"{figures['samples_per_second']:.1f} samples/s, {figures['model_tflops_per_second']:.3g} TFLOP/s"
    if "matrix_peak_share" in figures:
        text += f", {figures['matrix_peak_share']:.1%} of the matrix peak"
    return text
