"""How far a run of jobs is, and how it ended, in text."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from warpgarment.view.report import table

from .entries import Job

ROWS = 60  # jobs of which each has a row; of more, only those that are not simply done


class Progress:
    """Says after each batch how many jobs are through, and how long the others will take at that pace.

    Args:
        total: Number of jobs to run.
    """

    def __init__(self, total: int) -> None:
        self.total, self.through, self.failed, self.begun = total, 0, 0, time.monotonic()

    def passed(self, jobs: int, failed: int, seconds: float) -> None:
        """Counts a batch, and prints a line, unless there is nothing to run here."""
        if not self.total:
            return
        self.through, self.failed = self.through + jobs, self.failed + failed
        text = f"{self.through:,} of {self.total:,} jobs"
        if self.failed:
            text += f", {self.failed:,} failed"
        if seconds:
            text += f"; {jobs:,} in {in_time(seconds)}"
        left = self.total - self.through
        if left:
            spent = time.monotonic() - self.begun
            text += f"; about {in_time(spent / self.through * left)} left"
        print(text, file=sys.stderr, flush=True)


def in_time(seconds: float) -> str:
    """A time for people: "0.4 s", "52 s", "3 min 20 s", "2 h 5 min"."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600:,} h {whole % 3600 // 60} min"


def jobs_table(outcomes: Sequence[tuple[Job, Mapping[str, Any]]]) -> str:
    """A table of jobs, with a line below it for each that failed or is not free, and their numbers.

    Args:
        outcomes: Each job, and its entry in the record.
    """
    shown = [pair for pair in outcomes if len(outcomes) <= ROWS or _notable(pair[1])]
    rows = [_row(job, entry) for job, entry in shown]
    lines = [table(["job", "line", "outcome", "frames", "deepest [mm]"], rows)] if rows else []
    lines += [f"line {job.line}, {job.name}: {text}" for job, entry in outcomes if (text := _notable(entry))]
    states = [("skipped" if entry.get("skipped") else str(entry["state"])) for _, entry in outcomes]
    counts = [f"{states.count('done'):,} done", f"{states.count('skipped'):,} skipped, done before"]
    counts += [f"{states.count('failed'):,} failed"]
    deep = sum(entry.get("free_of_body") is False for _, entry in outcomes)
    crossing = sum(bool(entry.get("crosses")) for _, entry in outcomes)
    counts += [f"{deep:,} not free of the body"] if deep else []
    counts += [f"{crossing:,} with cloth that crosses, or was not counted"] if crossing else []
    lines.append(f"{len(outcomes):,} job{'s' * (len(outcomes) != 1)}: {', '.join(counts)}")
    return "\n".join(lines)


def _row(job: Job, entry: Mapping[str, Any]) -> list[object]:
    state = "skipped" if entry.get("skipped") else entry["state"]
    deepest = entry.get("deepest")
    depth = "" if deepest is None else f"{1e3 * deepest:.1f}"
    return [job.name, job.line, state, entry.get("frames", ""), depth]


def _notable(entry: Mapping[str, Any]) -> str:
    """What there is to say of an outcome; empty for a job that is simply done."""
    if entry["state"] == "failed":
        return f"failed: {entry['reason']}"
    said = []
    if entry.get("free_of_body") is False:
        said.append(f"not free of the body: a point is {1e3 * entry['deepest']:.1f} mm deep")
    if entry.get("crosses"):
        said.append(str(entry["crosses"]))
    return "; ".join(said)
