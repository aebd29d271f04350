"""Frames in time: when the frames of a motion are, and between which of them a moment lies."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.checks import checked_fps

SLACK = 0.01  # of a frame: an end that comes so little later than a frame falls on it
WHOLE = 1e-6  # of a frame: places that differ from a whole one by rounding alone are that one
MOST_BETWEEN, LARGEST = 100, 1 << 30  # new frames for each old one, and bytes, that resampling makes at most
FARTHEST = 1e15  # frames from time 0; beyond, those of a float64 cannot be told apart


class Clock(NamedTuple):
    """When the frames of a motion are.

    Frame k is at `start + k / fps`. Resampling puts frames where the new rate has them; the last one holds the end of
    the motion, which may come up to a frame earlier. `last` remembers when that was, so that resampling once more, to
    the first rate, gives the first frames again.

    Attributes:
        frames: Number of frames T.
        fps: Frames per second.
        start: Time of the first frame [s].
        last: When the positions of the last frame are reached, in frames after the first: T - 1, or a part of a frame
            less.
    """

    frames: int
    fps: float
    start: float
    last: float

    @classmethod
    def checked(cls, frames: int, fps: Any, start: Any = 0.0, last: Any = None) -> Clock:
        """A clock of these figures; `last` is T - 1 where it is None.

        Raises:
            MeshError: The rate is not positive, the start not finite or too far from 0, or the last frame elsewhere
                than within a frame before its place.
        """
        rate, begin = checked_fps(fps), float(start)
        if not (np.isfinite(begin) and abs(begin) * rate <= FARTHEST):
            raise MeshError(f"start must be a time in seconds, {FARTHEST:g} frames from 0 at most, got {start}.")
        end = float(frames - 1 if last is None else last)
        if abs(end - (frames - 1)) < WHOLE:
            end = float(frames - 1)
        if not (frames - 2 < end <= frames - 1 + SLACK and end >= 0):
            raise MeshError(f"last must be between {frames - 2} and {frames - 1} for {frames:,} frames, got {last}.")
        return cls(frames, rate, begin, end)

    @property
    def end(self) -> float:
        """Time at which the motion ends [s]."""
        return self.start + self.last / self.fps

    @property
    def times(self) -> np.ndarray:
        """Time of the positions of each frame [s], float64 [T]."""
        return self.start + np.append(np.arange(self.frames - 1), self.last) / self.fps

    @property
    def number(self) -> float:
        """Number of the first frame, counted from time 0: 1001 for a shot that starts there."""
        number = self.start * self.fps
        return float(round(number)) if abs(number - round(number)) < 1e-3 else number

    def places(self, times: np.ndarray) -> np.ndarray:
        """Where moments [s] lie among the frames, float64, from 0 to T - 1; before and after those, the nearest."""
        return self._places((np.asarray(times, np.float64) - self.start) * self.fps)

    def _places(self, passed: np.ndarray) -> np.ndarray:
        """Places of moments that are given in frames after the first."""
        if self.frames == 1:
            return np.zeros_like(passed)
        before = self.frames - 2
        if self.last != before + 1:  # the last frame is reached sooner or later than its place says
            passed = np.where(passed > before, before + (passed - before) / (self.last - before), passed)
        passed = np.clip(passed, 0.0, before + 1)
        whole = np.round(passed)
        return np.where(np.abs(passed - whole) < WHOLE, whole, passed)

    def resampled(self, fps: float, frames: int | None = None, *, points: int = 1) -> tuple[Clock, np.ndarray]:
        """Frames of another rate from the same start, none of the motion left out.

        Args:
            fps: New frames per second.
            frames: No more than so many; None: all.
            points: Vertices of the motion, to tell how large it becomes.

        Returns:
            The new clock, and where its frames lie among those of this one, float64 [T'].

        Raises:
            MeshError: The rate is not positive, or so much higher that the frames would fill memory.
        """
        fps = checked_fps(fps)
        last = self.last * fps / self.fps
        every = min(np.ceil(last - SLACK) + 1, 2.0**62)
        count = int(min(every, frames or np.inf))
        if count > MOST_BETWEEN * self.frames and 12 * count * points > LARGEST:
            raise MeshError(
                f"{self.frames:,} frames at {self.fps:g} a second would be {count:,} at {fps:g}: more than "
                f"{LARGEST:,} bytes. Is the rate right? Give it with fps=."
            )
        passed = np.arange(count) * (self.fps / fps)
        if count < every or count == 1:
            return Clock.checked(count, fps, self.start), self._places(passed)
        passed[-1] = self.last  # the last one holds the end
        return Clock.checked(count, fps, self.start, last), self._places(passed)


def between(vertices: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Positions at places among frames, in a straight line from one frame to the next.

    Args:
        vertices: Positions, float32 [T,V,3].
        places: Where, from 0 to T - 1, float64 [K].

    Returns:
        Positions, float32 [K,V,3]; those at a whole place are of that frame alone.
    """
    last = len(vertices) - 1
    before = np.minimum(places.astype(np.int64), max(last - 1, 0))
    after = np.minimum(before + 1, last)
    share = (places - before).astype(np.float32)
    found = vertices[before] * (1 - share[:, None, None]) + vertices[after] * share[:, None, None]
    for whole, of in ((share == 0, before), (share == 1, after)):
        found[whole] = vertices[of[whole]]
    return found


def in_words(clock: Clock) -> str:
    """A clock for people: "25 frames, 1001 to 1025 at 24 a second (41.708 to 42.708 s)"."""
    first, count = clock.number, clock.frames
    numbers = f"{first:.8g} to {first + count - 1:.8g}" if count > 1 else f"{first:.8g}"
    frames = f"{count:,} frame{'s' if count > 1 else ''}, {numbers} at {clock.fps:g} a second"
    return f"{frames} ({clock.start:.3f} to {clock.end:.3f} s)"
