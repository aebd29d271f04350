"""Work spread over processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from warpgarment.training.generate.workers import spread


def work(item: int) -> int:
    if item == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    if item == 4:
        raise ValueError("four is not good")
    return item * item


def test_a_killed_process_loses_its_own_item_only():
    """If this fails, one crash of a simulation throws away the rest of a night's work."""
    done = {d.item: d for d in spread(work, range(7), processes=2)}
    assert sorted(done) == list(range(7))
    assert {i: d.result for i, d in done.items() if d.error is None} == {i: i * i for i in (0, 1, 2, 5, 6)}
    assert "exit code -9" in done[3].error
    assert done[4].error.startswith("ValueError: four is not good")


def test_stopping_early_leaves_no_process_behind():
    """If this fails, an interrupted run keeps simulating in the background."""
    import multiprocessing

    stream = spread(work, range(7), processes=2)
    next(stream)
    stream.close()
    assert multiprocessing.active_children() == []


def test_nothing_to_do():
    """If this fails, a finished data set cannot be run again."""
    with pytest.raises(StopIteration):
        next(spread(work, [], processes=2))


LONG = """
import os, sys, time
from warpgarment.training.generate.workers import spread
def wait(item):
    os.write(1, b"%d\\n" % os.getpid())  # one write: lines of two processes do not mix
    while True:
        time.sleep(0.1)
if __name__ == "__main__":
    list(spread(wait, [1, 2], processes=2))
"""


def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    """Workers of a killed run would go on for hours, and write into the set of the next one."""
    script = tmp_path / "long.py"
    script.write_text(LONG)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    workers = [int(parent.stdout.readline()) for _ in range(2)]
    parent.kill()
    parent.wait()
    until = time.monotonic() + 20
    while living := [number for number in workers if _works(number)]:
        if time.monotonic() > until:
            for number in living:
                os.kill(number, signal.SIGKILL)
            pytest.fail(f"{len(living)} of 2 workers live without their parent")
        time.sleep(0.1)


def _works(number: int) -> bool:
    """Whether a process is there, and not one that has ended and nobody has asked about."""
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{number}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"
