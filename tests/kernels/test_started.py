"""What stays in memory of Warp's library once Warp has started."""

import json
import subprocess
import sys

import pytest

START = """
import json
from pathlib import Path

import warp as wp


def resident():
    lines = iter(Path("/proc/self/smaps").read_text().splitlines())
    found = [0, 0]
    for line in lines:
        if line.endswith("/warp/bin/warp.so") and line.split()[1] == "r-xp":
            found[0] += next(int(row.split()[1]) for row in lines if row.startswith("Rss:"))
            found[1] += next(int(row.split()[1]) for row in lines if row.startswith("Private_Dirty:"))
    return found


wp.config.log_level = wp.LOG_ERROR
wp.init()
before = resident()

from warpgarment.kernels.started import start

start()
once = resident()
numbers = wp.array([1.0, 2.0], dtype=wp.float32, device="cpu")
start()
print(json.dumps([before, once, resident(), numbers.numpy().tolist()]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="pages of a file are counted as Linux counts them")
def test_code_that_only_the_start_runs_is_not_resident():
    """A rollout would hold 76 MB of a compiler for CUDA that it never runs, or code would be lost that runs later. Only
    the first call gives back, since the rest of the code is in use."""
    ran = subprocess.run([sys.executable, "-c", START], capture_output=True, text=True, timeout=600)
    assert ran.returncode == 0, ran.stderr
    before, once, after, numbers = json.loads(ran.stdout)
    assert before[0] > 40_000  # kB
    assert once[0] < 2_000
    assert 0 < after[0] < 10_000
    assert before[1] == 0  # no page of it was changed: all can be read again
    assert numbers == [1.0, 2.0]
