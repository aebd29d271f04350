"""Work spread over processes that may die without affecting each other.

`concurrent.futures` abandons all work when one of its processes is killed. Here only the item of that process is
reported as lost, a new process takes its place, and all other work continues.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from warpgarment.cluster import Done


def spread(function: Callable[[Any], Any], items: Iterable[Any], processes: int) -> Iterator[Done]:
    """Calls `function(item)` for every item, in separate processes; yields in the order in which the calls finish.

    Args:
        function: Picklable function of one item, such as a function of a module or a partial of one.
        items: Picklable arguments of the function.
        processes: Number of processes at once.
    """
    waiting = list(items)[::-1]
    busy: dict[Connection, tuple[BaseProcess, Any]] = {}
    idle: list[tuple[Connection, BaseProcess]] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < processes:
                connection, process = idle.pop() if idle else _start(function)
                try:
                    connection.send(waiting[-1])
                except OSError:  # the process died while it was idle
                    connection.close()
                    continue
                busy[connection] = process, waiting.pop()
            ready = wait(list(busy))
            for connection in [c for c in busy if c in ready]:
                process, item = busy.pop(connection)
                try:
                    done = Done(item, *connection.recv())
                    idle.append((connection, process))
                except (EOFError, ConnectionError):
                    connection.close()
                    process.join()
                    done = Done(item, error=f"its process ended with exit code {process.exitcode}")
                yield done
    finally:
        for connection, process in [*idle, *((c, p) for c, (p, _) in busy.items())]:
            process.terminate()
            process.join()
            connection.close()


def _start(function: Callable[[Any], Any]) -> tuple[Connection, BaseProcess]:
    context = multiprocessing.get_context("spawn")
    near, far = context.Pipe()  # the ends of this process and of the new one
    process = context.Process(target=_work, args=(function, far, os.getpid()), daemon=True)
    process.start()
    far.close()
    return near, process


def end_with(parent: int) -> None:
    """Makes this process end when its parent does, however that ends: a killed one says nothing to its children.

    On Linux the kernel sees to it; it means the thread that started this process, which for `spread` lives as long as
    the work. Elsewhere a thread looks every second, wherever a process that lost its parent gets another one.

    Args:
        parent: Number of the process that started this one.
    """
    if sys.platform == "linux":
        import ctypes

        PR_SET_PDEATHSIG = 1
        if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0) == 0:
            if os.getppid() != parent:  # it ended before this was asked for
                os._exit(1)
            return
    if os.name != "posix":
        return  # the pipe's end is noticed when the item is done

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, name="warpgarment-parent", daemon=True).start()


def _work(function: Callable[[Any], Any], connection: Connection, parent: int) -> None:
    end_with(parent)
    while True:
        try:
            item = connection.recv()
        except EOFError:
            return  # the parent has ended, or needs no more
        try:
            answer: tuple[Any, str | None] = (function(item), None)
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            answer = (None, f"{type(error).__name__}: {error} ({last.name}, line {last.lineno})")
        connection.send(answer)
