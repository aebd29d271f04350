"""`simulate --jobs`: a list of jobs is checked, and those that are not done are run."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from warpgarment.cli.shot import Shot
from warpgarment.errors import UsageError
from warpgarment.io.disk.outputs import check_writable
from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator

from .batches import ON_CPU, ON_GPU
from .entries import Fault, Job, read_jobs
from .record import Digests, Record
from .runner import Runner
from .spread import Spread

SHOWN = 50  # faults that are printed


def run_jobs(
    beside: Shot,
    path: Path,
    weights: str,
    device: str | None,
    most: int | None,
    results: Path | None,
    again: bool,
    ray: str | None = None,
) -> int:
    """Checks a list of jobs, runs those that are not done, and says how it went.

    Args:
        beside: Options of every job that says nothing else.
        path: The list.
        weights: The network.
        device: The device; None takes a GPU if there is one.
        most: Most garments of a batch; None: by the device.
        results: Where the outcome of each job is kept; None: beside the list.
        again: Whether jobs that are done are run again.
        ray: Address of a Ray cluster over which batches are spread; None: they run here.

    Returns:
        The exit status: 0; `JOBS_FAILED`; or `NOT_FREE` where none failed and layers are not free of crossings.

    Raises:
        UsageError: Something of the list cannot run; each line with a fault has been named on stderr.
    """
    if beside.files or beside.out is not None:
        raise UsageError("--jobs has the files and outputs of all jobs: leave out GARMENT, BODY and --out.")
    if most is not None and most < 1:
        raise UsageError(f"--batch {most}: at least 1.")
    jobs, faults = read_jobs(path, beside)
    _refuse(path, faults, len(jobs))
    kept = results or path.with_name(f"{path.stem}.results.jsonl")
    _check_results(kept, path, jobs)
    record = Record(kept)
    if record.broken:
        print(f"warpgarment: {kept}: {record.broken:,} lines cannot be read; their jobs run again.", file=sys.stderr)
    network = checkpoint.find(weights, device=device)
    simulator = Simulator.from_pretrained(network, device=device if ray is None else "cpu")
    _refuse(path, _unread(jobs, simulator, weights), len(jobs))
    digest = Digests().of(Path(network))
    if ray is not None:
        gpu = (device or "cpu").startswith("cuda")
        spread = Spread(ray, path, network, device if gpu else "cpu", most or (ON_GPU if gpu else ON_CPU))
        return Runner(simulator, record, path, spread.most).run(jobs, digest, again, spread.outcomes)
    runner = Runner(simulator, record, path, most or (ON_CPU if simulator.device.type == "cpu" else ON_GPU))
    return runner.run(jobs, digest, again)


def _refuse(path: Path, faults: Sequence[Fault], sound: int) -> None:
    """Names all faults of a list, if there are any.

    Raises:
        UsageError: There are.
    """
    if not faults:
        return
    for fault in faults[:SHOWN]:
        print(f"{path}:{fault.line}: {fault.text}", file=sys.stderr)
    if len(faults) > SHOWN:
        print(f"{path}: and {len(faults) - SHOWN:,} more", file=sys.stderr)
    lines = len({fault.line for fault in faults})
    raise UsageError(f"{path}: {lines:,} line{'s' * (lines > 1)} cannot run, see above. Nothing was started.")


def _unread(jobs: Sequence[Job], simulator: Simulator, weights: str) -> list[Fault]:
    """Faults of jobs with materials or wind that the network does not read."""
    found = []
    for job in jobs:
        try:
            job.known.check_read(simulator.network.reads, weights)
        except UsageError as error:
            found.append(Fault(job.line, str(error)))
    return found


def _check_results(kept: Path, path: Path, jobs: Sequence[Job]) -> None:
    """Refuses a record that cannot be written, or would take the place of another file."""
    check_writable(kept)
    held = {os.path.realpath(file): f"line {job.line}" for job in jobs for file in (*job.known.shot.files,)}
    held |= {os.path.realpath(out): f"line {job.line}" for job in jobs for out in job.known.outputs.values()}
    user = "the list" if os.path.realpath(kept) == os.path.realpath(path) else held.get(os.path.realpath(kept))
    if user:
        raise UsageError(f"{kept}: where outcomes are kept is a file of {user}. Choose another with --results.")
