"""Which frame of a motion is shown at a moment: playing, held, scrubbed, faster or slower."""

from __future__ import annotations


class Playhead:
    """A place among frames that moves with the clock on the wall.

    Frames that come too late are left out, so that a motion lasts as long as it should on a slow machine too. After the
    last frame comes the first one.

    Args:
        frames: Number of frames T, at least 1.
        fps: Frames per second at speed 1.

    Attributes:
        playing: Whether it moves.
    """

    def __init__(self, frames: int, fps: float) -> None:
        self.frames, self.fps = frames, fps
        self.playing = False
        self._speed = 1.0
        self._place, self._since = 0.0, 0.0  # where it was, at which moment [s]

    def at(self, now: float, ready: int | None = None) -> int:
        """The frame that is shown at a moment.

        Args:
            now: The moment [s].
            ready: Number of frames that are there so far, at least 1: playback waits for the others. None: all.
        """
        most = self.frames if ready is None else min(ready, self.frames)
        place = self._moved(now)
        if most < self.frames and place >= most - 1:
            if self.playing:
                self._place, self._since = most - 1.0, now
            return most - 1
        if place >= self.frames:
            self._place, self._since = place % self.frames, now
        return int(self._moved(now) + 1e-6) % self.frames  # a moment that is rounded down is that of its frame

    def wait(self, now: float) -> float | None:
        """Seconds until the next frame; None while it does not move."""
        if not self.playing:
            return None
        place = self._moved(now)
        return max(0.0, (int(place) + 1 - place) / (self.fps * self._speed))

    def play(self, now: float) -> None:
        """Moves from now on."""
        self._place, self._since, self.playing = self._moved(now), now, True

    def hold(self, now: float) -> None:
        """Stays where it is."""
        self._place, self._since, self.playing = self._moved(now), now, False

    def seek(self, frame: float, now: float) -> None:
        """Goes to a frame, and goes on from there if it is playing."""
        self._place, self._since = float(min(max(frame, 0), self.frames - 1)), now

    def turn(self, speed: float, now: float) -> None:
        """Moves at another speed from now on, a factor greater than 0."""
        if speed != self._speed:
            self._place, self._since, self._speed = self._moved(now), now, speed

    def _moved(self, now: float) -> float:
        passed = (now - self._since) * self.fps * self._speed if self.playing else 0.0
        return self._place + passed
