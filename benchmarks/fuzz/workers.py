"""Processes with limits, in which files are read: what they exceed, or die of, is an outcome like any other."""

from __future__ import annotations

import gc
import multiprocessing
import os
import re
import resource
import signal
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import NamedTuple

from . import judge
from .case import Case, clear, make

SECONDS, MEGABYTES = 10.0, 800  # that a process may take for one file, beyond what it has
LASTS = 400  # files until a process is replaced
_TICKS = os.sysconf("SC_CLK_TCK")


class Result(NamedTuple):
    """The outcome of a case, see `judge.outcome`, and the seconds of a processor that it took."""

    case: Case
    outcome: str
    story: str
    seconds: float

    @property
    def failed(self) -> bool:
        """Whether it is neither a named error nor right."""
        return self.outcome not in (judge.REFUSED, judge.RIGHT)


@contextmanager
def _limited() -> Iterator[None]:
    """Limits the memory to what is used now and `MEGABYTES` more."""
    old = resource.getrlimit(resource.RLIMIT_AS)
    used = re.search(r"VmSize:\s+(\d+)", Path("/proc/self/status").read_text())
    assert used is not None
    resource.setrlimit(resource.RLIMIT_AS, (int(used[1]) * 1024 + (MEGABYTES << 20), old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, old)


def _work(pipe: Connection) -> None:
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # libraries write there what they think of a file
        os.dup2(silence, stream)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (256 << 20, 256 << 20))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    fast = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=fast) as folder:
        while (case := pipe.recv()) is not None:
            judge.sound_facts(case.kind)  # so that packages are loaded without limits
            pipe.send(None)
            pipe.send(judge.outcome(case, Path(folder), _limited))
            clear(Path(folder))
            gc.collect(0)


class _Worker:
    def __init__(self) -> None:
        context = multiprocessing.get_context("fork")
        self.pipe, child = context.Pipe()
        self.process = context.Process(target=_work, args=(child,), daemon=True)
        self.process.start()
        child.close()
        self.left, self.case, self.limit = LASTS, None, 0.0  # type: ignore[var-annotated]

    def give(self, case: Case) -> None:
        self.case, self.limit = case, 0.0
        self.left -= 1
        self.pipe.send(case)

    def seconds(self) -> float:
        """Of a processor, that the process has taken so far."""
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return (int(fields[11]) + int(fields[12])) / _TICKS

    def answer(self) -> tuple[str, str, float] | None:
        """The outcome, where it is there; None where the file is still being read."""
        try:
            if self.pipe.poll():
                found = self.pipe.recv()
                if found is None:
                    self.limit = self.seconds() + SECONDS
                return found
        except (EOFError, ConnectionError):
            self.process.join(5)
            return f"the process died (exit status {self.process.exitcode})", "", 0.0
        if self.limit and self.seconds() > self.limit:
            return f"takes more than {SECONDS:g} s", "", SECONDS
        return None

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _story(case: Case) -> str:
    """What was done to the files of a case whose process cannot say it any more."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        return make(case, Path(folder)).story


def results(cases: Iterable[Case], count: int) -> Iterator[Result]:
    """Outcomes of cases, in the order in which they are ready.

    Args:
        cases: The cases.
        count: Number of processes.
    """
    waiting, workers = iter(cases), []  # type: ignore[var-annotated]
    try:
        for case in waiting:
            workers.append(_Worker())
            workers[-1].give(case)
            if len(workers) == count:
                break
        while workers:
            wait([worker.pipe for worker in workers], timeout=0.5)
            for place, worker in enumerate(list(workers)):
                answer = worker.answer()
                if answer is None:
                    continue
                yield Result(worker.case, answer[0], answer[1] or _story(worker.case), answer[2])
                case = next(waiting, None)
                if case is None or worker.left == 0 or answer[1] == "":
                    worker.end()
                    workers[place] = None if case is None else _Worker()
                if case is not None:
                    workers[place].give(case)
            workers = [worker for worker in workers if worker is not None]
    finally:
        for worker in workers:
            if worker is not None:
                worker.end()
