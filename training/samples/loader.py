"""The samples of each training step, and the thread that builds their batches ahead of the training loop.

Everything about step n follows from (seed, n): the order of the epoch, the subsets of faces, the noise. So a resumed
run has the same batches as an uninterrupted one, and the number of batches built ahead has no influence on them.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from .drawing import Builder
from .pushforward import Pool

Batch = TypeVar("Batch")


class Plan:
    """Divides samples into batches: each sample once per epoch, and garments of similar size in a batch.

    Args:
        sizes: Number of faces of each sequence's garment.
        newest: Newest frames of the samples of each sequence, int [N] each.
        batch_size: Number of samples per batch.
        seed: Seed of the order.
    """

    def __init__(self, sizes: list[int], newest: list[np.ndarray], batch_size: int, seed: int) -> None:
        self.sizes, self.batch_size, self.seed = np.asarray(sizes), batch_size, seed
        self._samples = np.concatenate([np.stack([np.full(len(t), s), t], 1) for s, t in enumerate(newest)])
        self.batches = max(len(self._samples) // batch_size, 1)  # per epoch
        self._epoch, self._order = -1, self._samples

    def picks(self, step: int) -> list[tuple[int, int]]:
        """Sequence index and newest frame of each sample of a step."""
        epoch = step // self.batches
        if epoch != self._epoch:
            rng = np.random.default_rng((self.seed, epoch))
            order = rng.permutation(len(self._samples))
            if len(order) < self.batch_size:
                order = np.resize(order, self.batch_size)
            window = 16 * self.batch_size  # sorted by size within a window only, so that batches differ between epochs
            parts = np.split(order, range(window, len(order), window))
            by_size = [part[np.argsort(self.sizes[self._samples[part, 0]], kind="stable")] for part in parts]
            order = np.concatenate(by_size)[: self.batches * self.batch_size].reshape(self.batches, self.batch_size)
            self._epoch, self._order = epoch, self._samples[order[rng.permutation(self.batches)]]
        return [(int(s), int(t)) for s, t in self._order[step % self.batches]]


class Loader(Generic[Batch]):
    """Builds the batches of training steps in a thread, up to `depth` of them ahead.

    Args:
        builder: Builder of batches.
        plan: Samples of each batch.
        pool: Errors of the network's own rollouts, from which some samples start.
        share: Share of samples that start from the pool, if it has fitting entries.
        splits: Function from a step to the number of subsets into which a garment's faces are split; one of them is
            used. At 1, a network without `subsets` is given whole garments; other networks are given as many faces of
            each garment as the smallest one of the batch has.
        depth: Number of batches built ahead; 0 builds them when they are needed, without a thread.
        part: Slice of the samples of each batch on which this process trains.
    """

    def __init__(
        self,
        builder: Builder[Batch],
        plan: Plan,
        pool: Pool,
        share: float,
        splits: Callable[[int], int],
        depth: int = 3,
        part: slice = slice(None),
    ) -> None:
        self.builder, self.plan, self.pool, self.share = builder, plan, pool, share
        self.splits, self.depth, self.part = splits, depth, part
        # A separate stream, so that building a batch does not wait for the training step, nor the step for it
        self._stream = torch.cuda.Stream(builder.device) if builder.device.type == "cuda" else None

    def build(self, step: int, *, splits: int | None = None, part: slice | None = None) -> Batch:
        """The batch of a step; `splits` and `part` override those of the schedule and of this process."""
        rng = np.random.default_rng((self.plan.seed, 1, step))
        picks = self.plan.picks(step)
        splits = self.splits(step) if splits is None else splits
        sizes = [int(self.plan.sizes[s]) for s, _ in picks]
        whole = not self.builder.subsets and splits == 1
        faces = max(sizes) if whole else max(min(sizes) // splits, 1)
        displacements: list[np.ndarray | None] = [None] * len(picks)
        fitting = self.pool.fitting(self.plan.sizes, faces, whole=whole)
        fitting = [entry for entry in fitting if self._reaches(*entry)]
        for b in range(len(picks)):
            if len(fitting) and rng.random() < self.share:
                s, t, displacements[b] = self.pool.entry(*fitting[rng.integers(len(fitting))])
                picks[b] = (s, t)
        return self.builder.build(
            picks, None if whole else faces, rng, displacements, self.part if part is None else part
        )

    def _reaches(self, rollout: int, last: int) -> bool:
        """Whether enough recorded frames follow a frame of the pool."""
        return self.builder.reaches(*self.pool.entry(rollout, last)[:2])

    def batches(self, start: int, stop: int) -> Iterator[Batch]:
        """The batches of steps start..stop-1, in order."""
        if self.depth == 0:
            yield from map(self.build, range(start, stop))
            return
        if self._stream:
            self._stream.wait_stream(torch.cuda.current_stream(self.builder.device))
        ready: queue.Queue = queue.Queue(maxsize=self.depth)
        stopped = threading.Event()

        def hand_over(item: tuple[Batch, torch.cuda.Event | None] | BaseException) -> bool:
            while not stopped.is_set():
                try:
                    ready.put(item, timeout=0.2)
                    return True
                except queue.Full:
                    continue
            return False

        def work() -> None:
            try:
                with torch.cuda.stream(self._stream):  # does nothing for None
                    for step in range(start, stop):
                        batch = self.build(step)
                        if not hand_over((batch, self._stream.record_event() if self._stream else None)):
                            return
            except BaseException as error:  # raised in the thread that takes the batch
                hand_over(error)

        thread = threading.Thread(target=work, name="warpgarment-loader", daemon=True)
        thread.start()
        try:
            for _ in range(start, stop):
                item = ready.get()
                if isinstance(item, BaseException):
                    raise item
                batch, built = item
                if built is not None:
                    _adopt(batch, built)
                yield batch
        finally:
            stopped.set()
            thread.join()


def _adopt(batch: Any, built: torch.cuda.Event) -> None:
    """Makes the current stream wait for a batch that another stream built, and keeps its memory until it is used."""
    stream = torch.cuda.current_stream(batch.features.device)
    stream.wait_event(built)
    for tensor in torch.utils._pytree.tree_leaves(tuple(batch)):
        if isinstance(tensor, torch.Tensor):
            tensor.record_stream(stream)
