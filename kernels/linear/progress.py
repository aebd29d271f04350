"""Numbers of iterations and errors that a solver reports, and the warning when a solve did not converge."""

from __future__ import annotations

import warnings

import torch
import warp as wp

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, launch, torch_stream
from warpgarment.kernels.operator import allocate
from warpgarment.kernels.replay.recording import recording

wp.set_module_options(compiling.options())


@wp.kernel(enable_backward=False)
def summary_kernel(
    # In:
    report: wp.array[wp.int32],
    error: wp.array[wp.float64],
    before: wp.array[wp.float64],
    # Out:
    summary: wp.array[wp.float64],
):
    iterations = wp.int32(0)
    stopped = wp.int32(0)
    largest = wp.float64(0.0)
    for c in range(report.shape[0]):
        iterations = wp.max(iterations, wp.abs(report[c]))
        if report[c] < 0:
            stopped += 1
            largest = wp.max(largest, error[c])
    summary[0] = before[0] + wp.float64(iterations)
    summary[1] = before[1] + wp.float64(stopped)
    summary[2] = wp.max(before[2], largest)


class Progress:
    """The report of a solver's last solve. Reading it on a GPU waits for the solve.

    Args:
        what: Name of the solver, for the warning.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self._solves: list[tuple[torch.Tensor, torch.Tensor]] = []
        self._limit = 0
        self._warned = False

    def record(self, report: torch.Tensor, error: torch.Tensor, limit: int, *, add: bool = False) -> None:
        """Keeps the report of a solve; on the CPU it is checked immediately.

        Args:
            report: Number of iterations of each component, int32 [C]; negative where the limit ended them.
            error: Estimated error of each component in the energy norm [m], float64 [C].
            limit: Limit of iterations, for the warning.
            add: Whether earlier reports are kept beside this one.
        """
        self._solves = [*(self._solves if add else []), (report, error)]
        self._limit = limit
        if report.device.type == "cpu" and not recording():
            self._warn(report, error)

    @property
    def iterations(self) -> int:
        """Iterations of the last solve, the largest of all components; solves recorded together are summed."""
        for solve in self._solves:
            self._warn(*solve)
        return sum(int(report.abs().max()) for report, _ in self._solves if len(report))

    def summary(self, before: torch.Tensor | None = None) -> torch.Tensor:
        """`iterations`, number of components stopped by the limit, their largest error [m]; float64 [3] on the device.

        Does not wait for the solve. Once the numbers have been read from the device, pass them to `warn_if_stopped`.

        Args:
            before: Another summary, float64 [3], to which this one is added; None: there is none.
        """
        if self._solves[0][0].device.type == "cpu":
            return self._on_host(before)
        reports, errors = (torch.stack(tensors) for tensors in zip(*self._solves, strict=True))
        if not reports.shape[1]:
            return errors.new_zeros(3) if before is None else before
        stopped = reports < 0
        iterations = reports.abs().amax(1).sum()
        found = torch.stack([iterations.double(), stopped.sum().double(), torch.where(stopped, errors, 0.0).max()])
        return found if before is None else torch.cat([before[:2] + found[:2], torch.maximum(before[2:], found[2:])])

    def _on_host(self, before: torch.Tensor | None) -> torch.Tensor:
        """The same where reports are on the host."""
        total = torch.zeros(3, dtype=torch.float64) if before is None else before
        for report, error in self._solves:
            later = allocate((3,), torch.float64, report.device)
            given = as_argument(report, wp.int32), as_argument(error.detach(), wp.float64)
            with torch_stream(report.device) as device:
                launch(
                    summary_kernel, 1, [*given, as_argument(total, wp.float64), as_argument(later, wp.float64)], device
                )
            total = later
        return total

    def warn_if_stopped(self, stopped: float, components: int, error: float) -> None:
        """Warns, once, if components were stopped by the limit.

        Args:
            stopped: Number of components that were stopped.
            components: Number of all components.
            error: Largest error of those that were stopped, in the energy norm [m].
        """
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
        if self._warned or not len(report):
            return
        if report.device.type == "cpu" and report.numpy().min() >= 0:
            return
        stopped = report < 0
        if bool(stopped.any()):
            self.warn_if_stopped(int(stopped.sum()), len(report), float(error[stopped].max()))
