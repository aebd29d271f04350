"""The cores of a CPU: one pool of threads for kernels of Warp, which run on one thread each, and for torch by blocks.

Calls that are spread over the pool must write to memory that no other of them reads or writes. What they compute must
not depend on which thread runs them, nor on how many there are; so results have the same bits with any number of
threads.

The number of threads is torch's (`OMP_NUM_THREADS`, `torch.set_num_threads`; by default the number of cores). Within
`torch_on_one` torch itself works on one: its own threads spin while they wait for each other, which takes a hundred
times as long if another process has one of the cores. Threads of the pool sleep.

Calls that are spread are waited for. Calls of an `Aside` are done whenever a thread of the pool has nothing else to do.
"""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence

import torch

Call = Callable[[], object]

_local = threading.local()
_urgent: deque[Call] = deque()  # what another thread waits for
_patient: deque[Call] = deque()  # what can wait
_signals: queue.SimpleQueue[None] = queue.SimpleQueue()  # one for each of these
_started: list[threading.Thread] = []
_starting = threading.Lock()


def count() -> int:
    """Number of threads that share the work of this one: 1 within a call that is spread."""
    number: int = getattr(_local, "count", 0) or torch.get_num_threads()
    return number


@contextlib.contextmanager
def torch_on_one() -> Iterator[None]:
    """Context in which torch uses one thread on the CPU, and `count` is what torch had before."""
    if getattr(_local, "count", 0) or torch.get_num_threads() == 1:
        yield
        return
    before = torch.get_num_threads()
    try:
        _local.count = before
        torch.set_num_threads(1)
        yield
    finally:
        torch.set_num_threads(before)
        _local.count = 0


@contextlib.contextmanager
def torch_on_all() -> Iterator[None]:
    """Context within `torch_on_one` in which torch has its threads again, for work that is not spread by blocks."""
    number = getattr(_local, "count", 0)
    if number <= 1:
        yield
        return
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(1)


def spread(calls: Sequence[Call]) -> None:
    """Runs calls on the threads of the pool and on this one, and returns when all have ended.

    Args:
        calls: Calls that are independent of each other. They run in torch's grad and inference mode of this thread.

    Raises:
        Exception: The first exception of a call; the others have ended by then.
    """
    helpers = min(count(), len(calls)) - 1
    if helpers <= 0:
        for call in calls:
            call()
        return
    left, failed = iter(calls), list[BaseException]()
    take, done = threading.Lock(), threading.Semaphore(0)
    begun, over = 0, False
    inference, grad = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    def work() -> None:
        while True:
            with take:
                call = next(left, None)
            if call is None or failed:
                return
            try:
                call()
            except BaseException as error:
                failed.append(error)

    def worked() -> None:
        before = getattr(_local, "count", 0)
        _local.count = 1  # what a call spreads itself would wait for the other calls
        try:
            work()
        finally:
            _local.count = before

    def helped() -> None:
        nonlocal begun
        with take:
            if over:  # this thread woke after all calls had been taken, and nobody waits for it
                return
            begun += 1
        try:
            with torch.inference_mode(inference), torch.set_grad_enabled(grad):
                work()
        finally:
            done.release()

    _start(helpers)
    for _ in range(helpers):
        _put(_urgent, helped)
    worked()
    with take:
        over = True
    for _ in range(begun):
        done.acquire()
    if failed:
        raise failed[0]


def give(call: Call, threads: int) -> None:
    """Gives a call to a thread of the pool, which has at least that many, and does not wait for it."""
    _start(threads)
    _put(_urgent, call)


class Aside:
    """Calls that run in their order, one at a time, while the thread that adds them goes on.

    With one thread they run at once. They write to memory that nothing else reads or writes until `finish`.
    """

    def __init__(self) -> None:
        self._calls: deque[Call] = deque()
        self._turn, self._change = threading.Lock(), threading.Lock()
        self._wanted = False  # whether the pool knows of calls
        self._failed: list[BaseException] = []

    def add(self, call: Call) -> None:
        """Adds a call, which should take some milliseconds at most: other work waits for its end."""
        if count() < 2:
            call()
            return
        _start(count() - 1)
        with self._change:
            self._calls.append(call)
            known, self._wanted = self._wanted, True
        if not known:
            _put(_patient, self._pooled)

    def finish(self) -> None:
        """Returns when all calls have ended; those that wait run on this thread.

        Raises:
            Exception: The first exception of a call.
        """
        while self._calls:
            self._next()
        with self._turn:  # the last one may be running still
            pass
        if self._failed:
            raise self._failed[0]

    def _pooled(self) -> None:
        """One call on a thread of the pool, which then looks for calls that others wait for."""
        self._next()
        with self._change:
            self._wanted = bool(self._calls)
        if self._wanted:
            _put(_patient, self._pooled)

    def _next(self) -> None:
        with self._turn:
            if not self._calls:
                return
            call = self._calls.popleft()
            try:
                if not self._failed:
                    call()
            except BaseException as error:
                self._failed.append(error)


def _put(tasks: deque[Call], task: Call) -> None:
    tasks.append(task)
    _signals.put(None)


def _start(number: int) -> None:
    """Starts threads of the pool until there are that many."""
    if len(_started) >= number:
        return
    with _starting:
        while len(_started) < number:
            thread = threading.Thread(target=_serve, name=f"warpgarment-{len(_started)}", daemon=True)
            thread.start()
            _started.append(thread)


def _forget() -> None:
    """In a forked process, where no thread of the pool is left."""
    global _signals, _starting
    for gone in (_started, _urgent, _patient):
        gone.clear()
    _signals, _starting = queue.SimpleQueue(), threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def _serve() -> None:
    _local.count = 1
    torch.set_num_threads(1)
    while True:
        _signals.get()
        try:
            task = _urgent.popleft()
        except IndexError:
            task = _patient.popleft()
        task()
