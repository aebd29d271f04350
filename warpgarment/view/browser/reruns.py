"""Runs a simulation again in the background whenever somebody changes the wind or a material."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.wind import Wind

from .turns import Turns

SETTLE = 0.15  # seconds without another change before a run begins: a slider that is drawn changes all the time


class Live(Protocol):
    """What can be run again: `warpgarment.sim.results.rerun.Rerun` is one.

    Attributes:
        garments: The garments, innermost first.
        body: The body, with the frames of the result.
        reads: Names of what the network reads, of "materials" and "wind".
        materials: Material of each garment, or None, as it is at first.
        wind: The wind as it is at first, or None.
    """

    @property
    def garments(self) -> Sequence[Garment]: ...
    @property
    def body(self) -> BodyMotion: ...
    @property
    def reads(self) -> Collection[str]: ...
    @property
    def materials(self) -> Sequence[Material | None]: ...
    @property
    def wind(self) -> Wind | None: ...

    def run(self, materials: Sequence[Material | None], wind: Wind | None) -> Iterator[list[np.ndarray]]:
        """Positions of each garment [m], [V,3], frame by frame."""
        ...


class Settings(NamedTuple):
    """What a run depends on."""

    materials: tuple[Material | None, ...]
    wind: Wind | None


class Run:
    """One run: its positions as far as they are there.

    Attributes:
        settings: What was asked for.
        frames: Positions of each garment [m], float32 [T,V,3]; rows from `ready` on mean nothing.
        ready: Number of frames that are there.
        done: Whether no more frames follow.
        fault: Why it ended early, in words; empty if it did not.
        seconds: Time that the frames after the first took.
    """

    def __init__(self, settings: Settings, count: int, vertices: Sequence[int]) -> None:
        self.settings = settings
        self.frames = [np.zeros((count, number, 3), np.float32) for number in vertices]
        self.ready, self.done, self.fault, self.seconds = 0, False, "", 0.0

    @property
    def left(self) -> float | None:
        """Seconds that are left, by the frames so far; None where that is not known."""
        missing = len(self.frames[0]) - self.ready
        return None if self.ready < 2 or self.done else self.seconds / (self.ready - 1) * missing


class Reruns:
    """A thread that runs what was asked for last, and gives up what it is at for that.

    Frames can be read from another thread while the run goes on. Memory holds one run: the one before is dropped when
    the next one begins.

    Args:
        live: What is run.
        arrived: Function that is called, in the thread, whenever there is something new to see.
        turns: Lock that is held while a frame is computed.
        explained: Function that turns an error into a sentence.
    """

    def __init__(
        self,
        live: Live,
        arrived: Callable[[], None],
        turns: Turns,
        explained: Callable[[Exception], str] = lambda error: f"{type(error).__name__}: {error}",
    ) -> None:
        self._live, self._arrived, self._turns, self._explained = live, arrived, turns, explained
        self._changed = threading.Condition()
        self._asked: Settings | None = None
        self._closing = False
        self.run: Run | None = None
        self._thread = threading.Thread(target=self._loop, name="warpgarment-reruns", daemon=True)
        self._thread.start()

    def ask(self, settings: Settings) -> None:
        """Asks for a run; the one that is going on is given up."""
        with self._changed:
            self._asked = settings
            self._changed.notify_all()

    def close(self, timeout: float = 30.0) -> None:
        """Ends the thread after the frame that it is at."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _loop(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked is not None or self._closing)
                while self._changed.wait(SETTLE) and not self._closing:
                    pass  # something else was asked for
                settings, self._asked = self._asked, None
                if self._closing:
                    return
            if settings is not None:
                self._run(settings)

    def _given_up(self) -> bool:
        return self._closing or self._asked is not None

    def _run(self, settings: Settings) -> None:
        vertices = [len(garment.vertices) for garment in self._live.garments]
        run = self.run = Run(settings, self._live.body.frames, vertices)
        self._arrived()
        try:
            frames = self._live.run(settings.materials, settings.wind)
            while not self._given_up() and run.ready < len(run.frames[0]):
                began = time.perf_counter()
                with self._turns:
                    found = next(frames, None)
                if found is None:
                    break
                if not all(np.isfinite(part).all() for part in found):
                    run.fault = f"stopped: positions of frame {run.ready} are not finite"
                    break
                for held, part in zip(run.frames, found, strict=True):
                    held[run.ready] = part
                run.seconds += time.perf_counter() - began if run.ready else 0.0
                run.ready += 1
                self._arrived()
        except Exception as error:  # told on the page, which goes on
            run.fault = self._explained(error)
        run.done = True
        self._arrived()
