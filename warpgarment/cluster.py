"""Work spread over a Ray cluster (extra `cluster`): the data of `generate`, the batches of `simulate --jobs`."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from warpgarment.errors import MissingExtra


@dataclass(frozen=True)
class Done:
    """The outcome of an item: its `result`, or an `error` if its function raised or its process died.

    Attributes:
        item: The item.
        result: What the function returned.
        error: What went wrong; None: nothing.
        lost: Whether the process died, so that another item may be at fault.
    """

    item: Any
    result: Any = None
    error: str | None = None
    lost: bool = False


def on_cluster(
    function: Callable[[Any], Any], items: list[Any], address: str, *, cpus: float = 1.0, gpus: float = 0.0
) -> Iterator[Done]:
    """Calls `function(item)` for every item as a Ray task; yields in the order in which the tasks finish.

    Ray tries a task whose machine is lost once more. Files that the function writes must be on storage that all
    machines share.

    Args:
        function: Function of one item; it is sent to the cluster, where warpgarment must be installed.
        items: Arguments of the function, one per task.
        address: Address of the cluster; "local" starts one on this machine and stops it at the end.
        cpus: Number of cores that a task occupies.
        gpus: Number of GPUs that a task occupies, or the share of one.

    Raises:
        MissingExtra: Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise MissingExtra("cluster", "Running on a Ray cluster") from error

    started = not ray.is_initialized()
    if started:
        os.environ.setdefault("RAY_raylet_start_wait_time_s", "300")  # of a busy machine; 60 by default
        ray.init(address=address, include_dashboard=False if address == "local" else None, log_to_driver=False)

    @ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=1)
    def task(item: Any) -> Any:
        return function(item)

    try:
        waiting = {task.remote(item): item for item in items}
        while waiting:
            (ready, *_), _ = ray.wait(list(waiting), num_returns=1)
            item = waiting.pop(ready)
            try:
                yield Done(item, ray.get(ready))
            except ray.exceptions.RayTaskError as error:
                yield Done(item, error=f"{type(error.cause).__name__}: {error.cause}")
            except ray.exceptions.RayError as error:
                yield Done(item, error=f"{type(error).__name__}: {str(error).splitlines()[0]}", lost=True)
    finally:
        if started:
            ray.shutdown()
