"""Work spread over processes, each item in a process that may die without taking the others along.

`concurrent.futures` gives up on everything when one of its processes is killed. Here the item that process held is
reported as lost, a new process takes its place, and the rest goes on.
"""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any


@dataclass(frozen=True)
class Done:
    """What became of an item: `result`, or `error` where its function raised or its process died."""

    item: Any
    result: Any = None
    error: str | None = None


def spread(function: Callable[[Any], Any], items: Iterable[Any], processes: int) -> Iterator[Done]:
    """Calls `function(item)` for every item, in processes of their own; yields in the order they finish.

    Args:
        function: Picklable: a function of a module, or a partial of one.
        items: Picklable.
        processes: How many at once.
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
                except OSError:  # it died while it had nothing to do
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
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(function, theirs), daemon=True)
    process.start()
    theirs.close()
    return ours, process


def _work(function: Callable[[Any], Any], connection: Connection) -> None:
    while True:
        try:
            item = connection.recv()
        except EOFError:
            return
        try:
            answer: tuple[Any, str | None] = (function(item), None)
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            answer = (None, f"{type(error).__name__}: {error} ({last.name}, line {last.lineno})")
        connection.send(answer)
