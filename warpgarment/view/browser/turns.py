"""A lock that goes to whoever has waited longest."""

from __future__ import annotations

import threading


class Turns:
    """A lock for threads that take turns, as in ``with turns:``.

    Kernels of one process are launched by one thread at a time. A thread that runs frame after frame takes the lock
    anew for each; with `threading.Lock` it would nearly always get it again before one that waits.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._next, self._now = 0, 0  # ticket of who comes next, and of who is in

    def __enter__(self) -> None:
        with self._changed:
            ticket = self._next
            self._next += 1
            self._changed.wait_for(lambda: self._now == ticket)

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._now += 1
            self._changed.notify_all()
