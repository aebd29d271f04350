"""What a solver reports of its solves, and the warning when one did not converge."""

from __future__ import annotations

import warnings

import torch


class Progress:
    """What the last solve of a solver reported. Reading it on a GPU waits for the solve."""

    def __init__(self, what: str) -> None:
        self.what = what
        self._solves: list[tuple[torch.Tensor, torch.Tensor]] = []
        self._limit = 0
        self._warned = False

    def record(self, report: torch.Tensor, error: torch.Tensor, limit: int, *, add: bool = False) -> None:
        """Keeps a report, beside the earlier ones if `add`; on the CPU it is looked at straight away."""
        self._solves = [*(self._solves if add else []), (report, error)]
        self._limit = limit
        if report.device.type == "cpu":
            self._warn(report, error)

    @property
    def iterations(self) -> int:
        """Iterations of the last solve, the largest of all components; solves recorded together are summed."""
        for solve in self._solves:
            self._warn(*solve)
        return sum(int(report.abs().max()) for report, _ in self._solves if len(report))

    def summary(self) -> torch.Tensor:
        """`iterations`, components stopped by the limit, their largest error [m]; float64 [3] on the device.

        Does not wait for the solve: give it to `warn_if_stopped` once it has been read.
        """
        reports, errors = (torch.stack(tensors) for tensors in zip(*self._solves, strict=True))
        if not reports.shape[1]:
            return errors.new_zeros(3)
        stopped = reports < 0
        iterations = reports.abs().amax(1).sum()
        return torch.stack([iterations.double(), stopped.sum().double(), torch.where(stopped, errors, 0.0).max()])

    def warn_if_stopped(self, stopped: float, components: int, error: float) -> None:
        """Warns, once, if components were stopped by the limit."""
        if self._warned or not stopped:
            return
        self._warned = True
        warnings.warn(
            f"{self.what}: {int(stopped)} of {components} components stopped at max_iterations={self._limit} "
            f"with an error of about {error:.1e} m in the energy norm; raise max_iterations, "
            "or look for slivers in the rest mesh",
            RuntimeWarning,
            stacklevel=5,
        )

    def _warn(self, report: torch.Tensor, error: torch.Tensor) -> None:
        stopped = report < 0
        if not self._warned and bool(stopped.any()):
            self.warn_if_stopped(int(stopped.sum()), len(report), float(error[stopped].max()))
