"""Work spread over processes."""

from __future__ import annotations

import os
import signal

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
