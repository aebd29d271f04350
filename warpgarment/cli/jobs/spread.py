"""Jobs on a Ray cluster: each task runs a part of the list as `simulate --jobs` runs it on one machine."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from warpgarment.cluster import on_cluster
from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator

from .entries import Job
from .runner import Entry, Pending, Runner, entry_of, in_order


class Part(NamedTuple):
    """Jobs of one task, and what it needs to run them.

    Attributes:
        jobs: Jobs of one kind, with their fingerprints.
        list: The list that they are from, for messages.
        folder: Folder from which relative paths start.
        network: Name of a network that ships, or path of one.
        device: Device of the task.
        most: Most garments of a batch.
    """

    jobs: list[Pending]
    list: Path
    folder: str
    network: str
    device: str
    most: int


class Spread:
    """Spreads jobs over a cluster.

    Args:
        address: Address of the cluster; "local" starts one on this machine, and stops it at the end.
        path: The list.
        network: The network's file.
        device: "cpu", or "cuda" for tasks of which each takes a GPU.
        most: Most garments of a batch, and of a task.
    """

    def __init__(self, address: str, path: Path, network: Path, device: str | None, most: int) -> None:
        self.address, self.path, self.device, self.most = address, path, device or "cpu", most
        ships = {file.resolve(): name for name, file in checkpoint.shipped().items()}
        self.network = ships.get(Path(network).resolve()) or os.path.abspath(network)

    def outcomes(self, pending: Sequence[Pending]) -> Iterator[tuple[list[Entry], float]]:
        """Entries of jobs, and the time that they took [s], as their tasks finish.

        Where a task's process dies, its jobs are run again, each in a task of its own, so that only the one at fault
        fails.
        """
        gpus = float(self.device.startswith("cuda"))
        parts = self.parts(pending)
        while parts:
            alone: list[Part] = []
            for done in on_cluster(run_part, parts, self.address, gpus=gpus):
                part: Part = done.item
                if done.error is None:
                    entries, said, seconds = done.result
                    print(said, end="", file=sys.stderr)
                    yield entries, seconds
                elif done.lost and len(part.jobs) > 1:
                    alone += [part._replace(jobs=[each]) for each in part.jobs]
                else:
                    for job, _ in part.jobs:
                        print(f"{self.path.name}:{job.line}: {job.name} failed: {done.error}", file=sys.stderr)
                    yield [entry_of(job, mark, "failed", reason=done.error) for job, mark in part.jobs], 0.0
            parts = alone

    def parts(self, pending: Sequence[Pending]) -> list[Part]:
        """Jobs of one kind that follow each other, in parts of at most so many garments as a batch has."""
        found: list[list[Pending]] = []
        for each in sorted(pending, key=in_order):
            fits = found and in_order(found[-1][-1])[0] == in_order(each)[0]
            if fits and sum(len(job.known.pieces) for job, _ in [*found[-1], each]) <= self.most:
                found[-1].append(each)
            else:
                found.append([each])
        given = (self.path, os.getcwd(), self.network, self.device, self.most)
        return [Part(jobs, *given) for jobs in found]


class _Unrecorded:
    """Keeps nothing: the process that started the tasks does."""

    path = Path()

    def done(self, job: Job, mark: str) -> Entry | None:
        return None

    def add(self, entries: Iterable[Mapping[str, Any]]) -> None:
        pass

    def close(self) -> None:
        pass


def run_part(part: Part) -> tuple[list[Entry], str, float]:
    """Runs jobs, on a machine of the cluster; returns their entries, what was printed, and the time it took [s]."""
    os.chdir(part.folder)
    begun, said = time.monotonic(), io.StringIO()
    with contextlib.redirect_stderr(said):
        runner = Runner(_simulator(part.network, part.device), _Unrecorded(), part.list, part.most)
        runner.work(part.jobs)
    return list(runner.outcomes.values()), said.getvalue(), time.monotonic() - begun


@lru_cache(maxsize=1)
def _simulator(network: str, device: str) -> Simulator:
    return Simulator.from_pretrained(network, device=device)
