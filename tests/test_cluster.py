"""Work spread over a Ray cluster, on one machine."""

from __future__ import annotations

import os
import signal

import ray

from warpgarment.cluster import on_cluster


def test_results_and_errors_come_back_from_a_cluster_on_this_machine():
    """If this fails, --ray loses sequences, or a task that dies takes the run with it."""

    def work(item: int) -> int:
        if item == 2:
            raise ValueError("two is not good")
        if item == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return item * item

    done = {d.item: d for d in on_cluster(work, [0, 1, 2, 3], "local")}
    assert {i: d.result for i, d in done.items() if d.error is None} == {0: 0, 1: 1}
    assert done[2].error == "ValueError: two is not good"
    assert "died" in done[3].error or "Crashed" in done[3].error
    assert [done[i].lost for i in range(4)] == [False, False, False, True]
    assert not ray.is_initialized(), "the cluster that was started here is still running"
