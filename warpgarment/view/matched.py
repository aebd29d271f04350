"""Motions of other rates and starts, side by side at the same moments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from warpgarment.errors import UsageError
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.clock import SLACK, Clock, in_words
from warpgarment.objects.motion import GarmentMotion

Motion: TypeAlias = BodyMotion | GarmentMotion


def in_step(motions: Sequence[Motion]) -> bool:
    """Whether frame k of each motion is at the same moment, to a hundredth of a frame."""
    clocks = [motion.clock for motion in motions]
    first, most = clocks[0], max(clock.frames for clock in clocks)
    return all(
        abs(clock.start - first.start) * first.fps < SLACK and abs(clock.fps / first.fps - 1) * most < SLACK
        for clock in clocks
    )


def matched(motions: Sequence[Motion], names: Sequence[str], *, by: int = 0) -> list[Motion]:
    """All motions at the frames of one of them that lie in the time of all of them.

    A motion of a single frame beside others that move lasts all the time.

    Args:
        motions: Garments and bodies.
        names: What they are called in the error.
        by: Which of them has the frames.

    Returns:
        Motions with the same frames, in step.

    Raises:
        UsageError: They have no frame in common; the message names them and their times.
    """
    clocks = [motion.clock for motion in motions]
    lasting = [clock for k, clock in enumerate(clocks) if clock.frames > 1 or k == by]
    first, last = max(clock.start for clock in lasting), min(clock.end for clock in lasting)
    clock = clocks[by]
    slack = SLACK / clock.fps
    shown = np.flatnonzero((clock.times >= first - slack) & (clock.times <= last + slack))
    if not len(shown):
        listed = "; ".join(f"{name} has {in_words(one)}" for name, one in zip(names, clocks, strict=True))
        raise UsageError(f"no frame in common: {listed}.")
    part = slice(int(shown[0]), int(shown[-1]) + 1)
    times = clock.times[part]
    held = clock.last - part.start if part.stop == clock.frames else None
    common = Clock.checked(len(times), clock.fps, clock.start + part.start / clock.fps, held)
    return [motion.on_clock(common) for motion in motions]
