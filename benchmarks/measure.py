"""Timing calls side by side, and saying what they were timed on."""

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
    """Milliseconds of each call: of the processor on a CPU, by the clock on a GPU; `wall` is by the clock for both."""

    def __init__(self) -> None:
        super().__init__()
        self.wall: list[float] = []


def interleaved(
    calls: dict[str, Call], device: torch.device, seconds: float, least: int = 3, most: int = 200
) -> dict[str, Times]:
    """Times of calls that take turns, so that what else the machine does disturbs all of them [ms].

    On a CPU the processor's time is taken, all threads together: what a call costs on one core, whoever else is there.

    Args:
        calls: By name. Each runs once before, unless that alone took `seconds`.
        device: Waited for around every call.
        seconds: Rounds are begun until so much time has passed for each call,
        least: but at least so many, unless that takes four times as long,
        most: and at most so many.
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
        if spent[name].wall[0] < 1e3 * seconds:  # it warmed up
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
    """Least and median of times [ms], times a share (one over the garments of a batch, say)."""
    least, median = share * min(times), share * statistics.median(times)
    return {"min_ms": least, "median_ms": median, "wall_ms": share * min(times.wall), "runs": len(times)}


def compared(
    base: Row,
    ours: Call | dict[str, Call],
    references: dict[str, Call | str],
    device: torch.device,
    seconds: float,
) -> list[Row]:
    """One row of ours, and one for each reference with the ratio of least times; a reference may be a note instead.

    Several calls of ours, by the `what` of their rows, share the references.
    """
    mine = {str(base["what"]): ours} if callable(ours) else ours
    calls = {name: call for name, call in references.items() if callable(call)}
    times = interleaved({f"ours: {what}": call for what, call in mine.items()} | calls, device, seconds)
    rows = []
    for what in mine:
        row = base | {"what": what} | figures(times[f"ours: {what}"])
        if not calls:
            rows.append(row)
        for name, call in references.items():
            if isinstance(call, str):
                rows.append(base | {"what": what, "reference": name, "note": call})
                continue
            theirs = {f"reference_{key}": value for key, value in figures(times[name]).items()}
            rows.append(row | {"reference": name} | theirs | {"ratio": theirs["reference_min_ms"] / row["min_ms"]})
    return rows


def aimed(row: Row, target: str, reached: str, met: bool) -> Row:
    """A row with a target beside it, if it was measured."""
    return row if "note" in row else row | {"target": target, "reached": reached, "met": bool(met)}


def aimed_time(row: Row, limit: float, faces: int, power: float = 1.0, *, key: str = "median_ms", how: str = "") -> Row:
    """A row whose median, or another time that `how` describes, is to stay under a limit [ms], scaled by a power of
    the faces to the number that was named."""
    if "note" in row:
        return row
    scaled = row[key] * (faces / row["faces"]) ** power
    unit, factor = ("s", 1e-3) if limit >= 1e3 else ("ms", 1.0)
    target = f"under {factor * limit:g} {unit}{how} for {faces:,} faces"
    return aimed(row, target, f"{factor * scaled:.3g} {unit}, scaled from {row['faces']:,} faces", scaled < limit)


def tensor(array: np.ndarray, device: torch.device, dtype: type[np.generic] = np.float32) -> torch.Tensor:
    """A copy of an array on the device."""
    return torch.as_tensor(np.array(array, dtype=dtype, order="C"), device=device)


def installed(package: str) -> str | None:
    """Version of a package, None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def processor() -> str:
    """The name of the CPU, as the system gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine(device: torch.device) -> dict[str, str]:
    """What the figures were measured on."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor()
    versions = {package: installed(package) or "not installed" for package in PACKAGES}
    threads = {"torch threads": str(torch.get_num_threads()), "cores": str(os.cpu_count())}
    return {"device": name, **threads, "python": platform.python_version(), **versions}
