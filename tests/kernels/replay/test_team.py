"""Programs of launches on several threads, beside NumPy."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
import warp as wp

from warpgarment.kernels import recorded, threads
from warpgarment.kernels.launch import as_argument
from warpgarment.kernels.replay.team import Program

SIZE, PHASES, RANGES = 96, 40, 8
FACTOR, MODULUS = 31, 1_000_003


@wp.kernel(enable_backward=False)
def mixed(from_row: wp.int32, step: wp.int32, x: wp.array[wp.int32], y: wp.array[wp.int32]):
    i = from_row + wp.tid()
    n = x.shape[0]
    y[i] = (31 * x[(7 * i + step) % n] + x[n - 1 - i]) % 1000003


def program(x: torch.Tensor, y: torch.Tensor, ranges: int = RANGES) -> Program:
    """Phases each of which needs all of the one before; every fifth is one range."""
    device, phases = wp.get_device("cpu"), []
    for step in range(PHASES):
        given = [step, *(as_argument(t, wp.int32) for t in ((x, y) if step % 2 == 0 else (y, x)))]
        begins = np.linspace(0, SIZE, (1 if step % 5 == 4 else ranges) + 1).astype(int).tolist()
        recorded.prepared(mixed, 1, [0, *given], device)  # the first launch of a kernel makes its record
        phases.append(recorded.divided(mixed, begins, given, device))
    return Program(phases)


def expected(x: np.ndarray) -> np.ndarray:
    """The same in NumPy."""
    i = np.arange(SIZE)
    for step in range(PHASES):
        x = (FACTOR * x.astype(np.int64)[(7 * i + step) % SIZE] + x[::-1]) % MODULUS
    return x


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_phases_follow_each_other(count, monkeypatch):
    """A thread would begin a phase before the last one is done, or a range be left out or done twice. Integers: exact.
    With more threads than cores, threads are interrupted anywhere."""
    monkeypatch.setattr(threads, "count", lambda: count)
    x, y = torch.zeros(SIZE, dtype=torch.int32), torch.zeros(SIZE, dtype=torch.int32)
    run = program(x, y)
    for seed in range(60 if count > 2 else 300):
        start = np.random.default_rng(seed).integers(0, MODULUS, SIZE)
        x.copy_(torch.from_numpy(start))
        y.fill_(-1)
        run()
        np.testing.assert_array_equal(x.numpy(), expected(start))


def test_several_callers(monkeypatch):
    """Programs of several threads of Python would share the board. One of them gets the helpers; exact."""
    monkeypatch.setattr(threads, "count", lambda: 2)
    made = []
    for _ in range(3):
        x, y = torch.zeros(SIZE, dtype=torch.int32), torch.zeros(SIZE, dtype=torch.int32)
        made.append((x, y, program(x, y)))

    def repeat(number: int) -> None:
        x, _, run = made[number]
        for seed in range(100):
            start = np.random.default_rng(1000 * number + seed).integers(0, MODULUS, SIZE)
            x.copy_(torch.from_numpy(start))
            run()
            np.testing.assert_array_equal(x.numpy(), expected(start))

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(repeat, range(3)))


def test_helpers_that_sleep_are_woken(monkeypatch):
    """A program would wait for ever for helpers that went to sleep, or do without them from then on."""
    monkeypatch.setattr(threads, "count", lambda: 2)
    x, y = torch.zeros(SIZE, dtype=torch.int32), torch.zeros(SIZE, dtype=torch.int32)
    run, start = program(x, y), np.arange(SIZE)
    for _ in range(5):
        wp.synchronize()
        threads.threading.Event().wait(0.05)  # longer than helpers look for work
        x.copy_(torch.from_numpy(start))
        run()
        np.testing.assert_array_equal(x.numpy(), expected(start))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_forked_process_has_helpers_of_its_own():
    """A child would wait for threads that only its parent has."""
    says = """
import os, sys, torch, numpy as np
sys.path.insert(0, "tests/kernels/replay")
import test_team as t
t.threads.count = lambda: 2
x, y = torch.zeros(t.SIZE, dtype=torch.int32), torch.zeros(t.SIZE, dtype=torch.int32)
run = t.program(x, y)
run()
child = os.fork()
x.copy_(torch.arange(t.SIZE))
run()
same = np.array_equal(x.numpy(), t.expected(np.arange(t.SIZE)))
if not child:
    os._exit(0 if same else 1)
print(same, os.waitpid(child, 0)[1])
"""
    ran = subprocess.run([sys.executable, "-W", "ignore", "-c", says], capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.splitlines()[-1] == "True 0"
