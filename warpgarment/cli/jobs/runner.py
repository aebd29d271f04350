"""Runs jobs on one simulator, batch after batch, and goes on past those that fail."""

from __future__ import annotations

import os
import sys
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from warpgarment.cli import JOBS_FAILED, NOT_FREE, explained, spoken
from warpgarment.cli.pieces import save
from warpgarment.cli.shot import loaded
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.sim.simulator import Simulator
from warpgarment.view.report import certified

from .batches import Ready, Waiting, kind, rolled
from .entries import Job
from .progress import Progress, jobs_table
from .record import Digests, fingerprint, outputs_of

Entry = dict[str, Any]
Pending = tuple[Job, str]  # a job and its fingerprint
Elsewhere = Callable[[Sequence[Pending]], Iterator[tuple[list[Entry], float]]]  # entries, and seconds they took


class Keeps(Protocol):
    """What keeps outcomes, as `record.Record` does."""

    path: Path

    def done(self, job: Job, mark: str) -> Entry | None:
        """The entry of a job that is done."""

    def add(self, entries: Iterable[Mapping[str, Any]]) -> None:
        """Takes down outcomes."""

    def close(self) -> None:
        """Ends the record."""


def in_order(pending: Pending) -> tuple[Any, ...]:
    """Sorts jobs so that those that can share a rollout follow each other."""
    return kind(pending[0].known), pending[0].line


class _Files:
    """Garments and bodies that were loaded, as long as a job has them: jobs that name the same file share it."""

    def __init__(self) -> None:
        self._known: weakref.WeakValueDictionary[Any, Any] = weakref.WeakValueDictionary()

    def sharing(self, load: Callable[..., Any]) -> Callable[..., Any]:
        """A function that loads, with what it has loaded before."""

        def shared(path: Path, **told: Any) -> Any:
            key = (load, os.path.realpath(path), repr(sorted(told.items())))
            found = self._known.get(key)
            if found is None:
                found = self._known[key] = load(path, **told)
            return found

        return shared


class Runner:
    """The jobs of one list on one simulator."""

    def __init__(self, simulator: Simulator, record: Keeps, path: Path, most: int) -> None:
        self.simulator, self.record, self.path = simulator, record, path
        self.waiting = Waiting(simulator, most)
        files = _Files()
        self.garment, self.body = files.sharing(Garment.load), files.sharing(BodyMotion.load)
        self.recent: list[Ready] = []  # the last batch, whose files the next may have too
        self.outcomes: dict[int, Entry] = {}
        self.progress = Progress(0)

    def run(self, jobs: Sequence[Job], network: str, again: bool, elsewhere: Elsewhere | None = None) -> int:
        """Runs what is not done; returns the exit status.

        Args:
            jobs: The list.
            network: Digest of the network.
            again: Whether jobs that are done are run again.
            elsewhere: What runs jobs on other machines; None: they run here.
        """
        pending = self._pending(jobs, network, again)
        skipped = sum(bool(entry.get("skipped")) for entry in self.outcomes.values())
        if skipped:
            print(f"{skipped:,} of {len(jobs):,} jobs are done already", flush=True)
        self.progress = Progress(len(pending))
        try:
            if elsewhere is None:
                self.work(pending)
            else:
                for entries, seconds in elsewhere(pending):
                    for entry in entries:
                        self._note(entry)
                    self.record.add(entries)
                    self.progress.passed(len(entries), sum(entry["state"] == "failed" for entry in entries), seconds)
        except KeyboardInterrupt:
            print(f"\nstopped; the same command goes on from {self.record.path}", file=sys.stderr)
            raise
        self.record.close()
        print(jobs_table([(job, self.outcomes[job.line]) for job in jobs]))
        print(f"\noutcomes: {self.record.path}")
        outcomes = self.outcomes.values()
        if any(entry["state"] == "failed" for entry in outcomes):
            return JOBS_FAILED
        return NOT_FREE if any(entry.get("crosses") for entry in outcomes) else 0

    def work(self, pending: Sequence[Pending]) -> None:
        """Runs jobs, given with their fingerprints, in batches."""
        for job, mark in sorted(pending, key=in_order):
            ready = self._loaded(job, mark)
            for batch in self.waiting.add(ready) if ready else ():
                self._run(batch)
            del ready
        for batch in self.waiting.rest():
            self._run(batch)

    def _pending(self, jobs: Sequence[Job], network: str, again: bool) -> list[Pending]:
        """Jobs that are to be run, with their fingerprints."""
        digests, found = Digests(), []
        for job in jobs:
            try:
                mark = fingerprint(job, network, digests)
            except Exception as error:
                self._failed(job, "", error)
                continue
            done = None if again else self.record.done(job, mark)
            if done is None:
                found.append((job, mark))
            else:
                self._note({**done, "line": job.line, "name": job.name, "skipped": True})
        if self.outcomes:
            self.record.add(self.outcomes.values())
        return found

    def _loaded(self, job: Job, mark: str) -> Ready | None:
        try:
            shot = loaded(job.known, self.garment, self.body, f"{self.path.name}:{job.line}: ")
            shot.check_space(self.simulator.network.config.fps)
            return Ready(job, shot, mark)
        except Exception as error:
            self._failed(job, mark, error)
            self.record.add([self.outcomes[job.line]])
            self.progress.passed(1, 1, 0.0)
            return None

    def _run(self, batch: list[Ready]) -> None:
        """Runs a batch and writes its outputs. One that fails is run in halves, so that only the job at fault fails."""
        begun = time.monotonic()
        lines = ", ".join(str(ready.job.line) for ready in batch)
        try:
            with spoken(f"{self.path.name}:{lines}: ", fps="--body-fps or --out-fps"):
                motions = rolled(self.simulator, batch, progress=sys.stderr.isatty())
        except Exception as error:
            if len(batch) > 1:
                middle = len(batch) // 2
                self._run(batch[:middle])
                self._run(batch[middle:])
                return
            self._failed(batch[0].job, batch[0].mark, error)
        else:
            each = (time.monotonic() - begun) / len(batch)
            for ready, moved in zip(batch, motions, strict=True):
                self._save(ready, moved, each)
        self.recent = batch
        entries = [self.outcomes[ready.job.line] for ready in batch]
        self.record.add(entries)
        failed = sum(entry["state"] == "failed" for entry in entries)
        self.progress.passed(len(batch), failed, time.monotonic() - begun)

    def _save(self, ready: Ready, motions: dict[str, GarmentMotion], seconds: float) -> None:
        job = ready.job
        for name, motion in motions.items():
            if not motion.status[-1].finite:
                at = f"{name} is not finite from frame {motion.status[-1].frame} on"
                text = f"{at}, nothing was written. {motion.status[-1].verdict.message}"
                self._note(entry_of(job, ready.mark, "failed", reason=text, seconds=seconds))
                return
        try:
            with spoken(f"{self.path.name}:{job.line}: ", out="out"):
                save(motions, job.known.outputs)
        except Exception as error:
            self._failed(job, ready.mark, error)
            return
        crossing = {name: certified(motion) for name, motion in motions.items()} if job.known.shot.layers else {}
        crosses = "; ".join(f"{name} {fault}" for name, fault in crossing.items() if fault)
        self._note(entry_of(job, ready.mark, "done", seconds=seconds, **_figures(motions), crosses=crosses or None))
        self.outcomes[job.line]["outputs"] = outputs_of(job)

    def _failed(self, job: Job, mark: str, error: Exception) -> None:
        reason = explained(error)
        self._note(entry_of(job, mark, "failed", reason=reason))
        print(f"{self.path.name}:{job.line}: {job.name} failed: {reason}", file=sys.stderr)

    def _note(self, entry: Entry) -> None:
        self.outcomes[entry["line"]] = entry


def entry_of(job: Job, mark: str, state: str, **more: Any) -> Entry:
    """An entry of the record."""
    return {"line": job.line, "name": job.name, "state": state, "fingerprint": mark, **more}


def _figures(motions: dict[str, GarmentMotion]) -> Entry:
    """What a result is like: frames, rate, depth of the deepest point [m], frames in which one is deep."""
    first = next(iter(motions.values()))
    deep = [[status.max_penetration for status in motion.status] for motion in motions.values()]
    free = all(status.verdict.value != "penetrating" for motion in motions.values() for status in motion.status)
    return {
        "frames": first.frames,
        "fps": first.fps,
        "start": first.start,
        "faces": sum(len(motion.faces) for motion in motions.values()),
        "deepest": max(max(depths) for depths in deep),
        "free_of_body": free,
    }
