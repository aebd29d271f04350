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

import torch

RESULTS = Path(__file__).parent / "results"
NO_GPU = "not run: needs a GPU, there is none here"
PACKAGES = ("warpgarment", "warp-lang", "torch", "numpy", "scipy", "libigl", "cholespy", "scikit-sparse", "newton")

Row = dict[str, Any]
Call = Callable[[], object]


def interleaved(calls: dict[str, Call], device: torch.device, seconds: float, least: int = 3) -> dict[str, list[float]]:
    """Times of calls that take turns, so that what else the machine does disturbs all of them [ms].

    Args:
        calls: By name. Each runs once before, unless that alone took `seconds`.
        device: Waited for around every call.
        seconds: Rounds are begun until so much time has passed for each call,
        least: but at least so many, and at most 200.
    """

    def timed(call: Call) -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        began = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return 1e3 * (time.perf_counter() - began)

    spent = {name: [timed(call)] for name, call in calls.items()}
    began = time.perf_counter()
    cold = {name for name in calls if spent[name][0] < 1e3 * seconds}
    rounds = 0
    while rounds < 200 and (rounds < least or time.perf_counter() - began < seconds * len(calls)):
        for name, call in calls.items():
            spent[name].append(timed(call))
        rounds += 1
        if time.perf_counter() - began > 4 * seconds * len(calls):
            break
    return {name: times[1:] if name in cold and len(times) > 1 else times for name, times in spent.items()}


def figures(times: list[float], share: float = 1.0) -> Row:
    """Least and median of times [ms], times a share (one over the garments of a batch, say)."""
    return {"min_ms": share * min(times), "median_ms": share * statistics.median(times), "runs": len(times)}


def compared(
    base: Row, ours: Call, references: dict[str, Call | str], device: torch.device, seconds: float
) -> list[Row]:
    """One row of ours, and one for each reference with the ratio of least times; a reference may be a note instead."""
    calls = {name: call for name, call in references.items() if callable(call)}
    times = interleaved({"": ours, **calls}, device, seconds)
    mine = base | figures(times[""])
    rows = [] if calls else [mine]
    for name, call in references.items():
        if isinstance(call, str):
            rows.append(base | {"reference": name, "note": call})
            continue
        theirs = {f"reference_{key}": value for key, value in figures(times[name]).items()}
        rows.append(mine | {"reference": name} | theirs | {"ratio": theirs["reference_min_ms"] / mine["min_ms"]})
    return rows


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
