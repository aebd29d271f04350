"""Timing of calls side by side, and a description of the machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

RESULTS = Path(__file__).parent / "results"
NO_GPU = "not run: needs a GPU, there is none here"
PACKAGES = ("warpgarment", "warp-lang", "torch", "numpy", "scipy", "libigl", "cholespy", "scikit-sparse", "newton")

Row = dict[str, Any]
Call = Callable[[], object]


class Times(list[float]):
    """Times of calls [ms]: processor time on a CPU, clock time on a GPU; `wall` is clock time for both."""

    def __init__(self) -> None:
        super().__init__()
        self.wall: list[float] = []


def interleaved(
    calls: dict[str, Call], device: torch.device, seconds: float, least: int = 3, most: int = 200
) -> dict[str, Times]:
    """Times of calls that take turns [ms], so that other work on the machine affects all of them.

    On a CPU processor time is measured, summed over all threads: the cost of a call on one core, regardless of other
    processes.

    Args:
        calls: Calls by name. Each runs once untimed before, except one for which that run alone took `seconds`.
        device: Device, which is synchronised around every call.
        seconds: Time after which no further round is begun, per call [s].
        least: Least number of rounds, unless they take four times as long as `seconds`.
        most: Largest number of rounds.
    """

    spent = {name: Times() for name in calls}

    def take(name: str) -> None:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        began, worked = time.perf_counter(), time.process_time()
        calls[name]()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        wall, work = time.perf_counter() - began, time.process_time() - worked
        spent[name].wall.append(1e3 * wall)
        spent[name].append(1e3 * (wall if device.type == "cuda" else work))

    for name in calls:
        take(name)
        if spent[name].wall[0] < 1e3 * seconds:  # the first run was the warm-up
            spent[name].clear()
            spent[name].wall.clear()
    began, rounds = time.perf_counter(), 0
    while rounds < most and (rounds < least or time.perf_counter() - began < seconds * len(calls)):
        for name in calls:
            take(name)
        rounds += 1
        if time.perf_counter() - began > 4 * seconds * len(calls):
            break
    return spent


def figures(times: Times, share: float = 1.0) -> Row:
    """Least and median of times [ms], multiplied by a share, such as one over the number of garments of a batch."""
    least, median = share * min(times), share * statistics.median(times)
    return {"min_ms": least, "median_ms": median, "wall_ms": share * min(times.wall), "runs": len(times)}


def compared(
    base: Row,
    ours: Call | dict[str, Call],
    references: dict[str, Call | str],
    device: torch.device,
    seconds: float,
) -> list[Row]:
    """One row of this project's call, and one for each reference with the ratio of least times.

    Args:
        base: Entries that all rows have.
        ours: Call of this project, or several ones by the `what` of their rows, which share the references.
        references: References by name: a call, or a note on why there is none.
        device: Device, which is synchronised around every call.
        seconds: Time spent on each call [s].
    """
    own = {str(base["what"]): ours} if callable(ours) else ours
    calls = {name: call for name, call in references.items() if callable(call)}
    times = interleaved({f"ours: {what}": call for what, call in own.items()} | calls, device, seconds)
    rows = []
    for what in own:
        row = base | {"what": what} | figures(times[f"ours: {what}"])
        if not calls:
            rows.append(row)
        for name, call in references.items():
            if isinstance(call, str):
                rows.append(base | {"what": what, "reference": name, "note": call})
                continue
            other = {f"reference_{key}": value for key, value in figures(times[name]).items()}
            rows.append(row | {"reference": name} | other | {"ratio": other["reference_min_ms"] / row["min_ms"]})
    return rows


def aimed(row: Row, target: str, reached: str, met: bool) -> Row:
    """A row with a target, the reached figure and whether the target is met, if the row was measured."""
    return row if "note" in row else row | {"target": target, "reached": reached, "met": bool(met)}


def aimed_time(row: Row, limit: float, faces: int, power: float = 1.0, *, key: str = "median_ms", how: str = "") -> Row:
    """A row whose time must stay under a limit.

    Args:
        row: The row.
        limit: Limit [ms] for the number of faces `faces`.
        faces: Number of faces for which the limit is given.
        power: Power of the number of faces with which the row's time is scaled to that number.
        key: Entry of the row that holds the time [ms].
        how: Description of the time, if it is not the median.
    """
    if "note" in row:
        return row
    scaled = row[key] * (faces / row["faces"]) ** power
    unit, factor = ("s", 1e-3) if limit >= 1e3 else ("ms", 1.0)
    target = f"under {factor * limit:g} {unit}{how} for {faces:,} faces"
    return aimed(row, target, f"{factor * scaled:.3g} {unit}, scaled from {row['faces']:,} faces", scaled < limit)


def tensor(array: np.ndarray, device: torch.device, dtype: type[np.generic] = np.float32) -> torch.Tensor:
    """A copy of an array on a device, converted to the dtype."""
    return torch.as_tensor(np.array(array, dtype=dtype, order="C"), device=device)


def installed(package: str) -> str | None:
    """Version of a package; None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def processor() -> str:
    """The name of the CPU, as reported by the system."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine(device: torch.device) -> dict[str, str]:
    """The machine and the versions of packages of a measurement."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor()
    versions = {package: installed(package) or "not installed" for package in PACKAGES}
    threads = {"torch threads": str(torch.get_num_threads()), "cores": str(os.cpu_count())}
    return {"device": name, **threads, "python": platform.python_version(), **versions}
