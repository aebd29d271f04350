"""Copies the frames of a batch from the device, with their statuses."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from warpgarment.objects.clock import Clock
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.objects.status import RolloutStatus
from warpgarment.sim.arguments import warn_of_crossing_start
from warpgarment.sim.scene import Scene

READ_EVERY = 16  # number of frames of a rollout that a GPU computes before the host reads them


class Outcome(NamedTuple):
    """One frame on the host."""

    parts: list[np.ndarray]  # positions of each garment [V,3]; NaN for one that has failed
    statuses: list[RolloutStatus]
    alive: bool  # whether any garment is finite


def read(scene: Scene, first: int, frames: Sequence[tuple[torch.Tensor, ...]]) -> list[Outcome]:
    """Reads frames from the device in one transfer, and warns of solves that did not converge.

    Args:
        scene: The scene that the frames belong to.
        first: Number of the first frame.
        frames: `seen` of this and the following frames.
    """
    positions, finite, depth, solves, meeting, *body = (
        torch.stack(tensors).cpu().numpy() for tensors in zip(*frames, strict=True)
    )
    brought, found = scene.brought, []
    for k in range(len(frames)):
        parts = [part.copy() for part in scene.packed.split(positions[k])]
        if brought is not None:
            parts = brought.restored(parts)
        if brought is not None and body:
            depth[k] = np.maximum(depth[k], brought.depth(parts, torch.from_numpy(body[0][k]), scene.packed_bodies))
        for part, sound in zip(parts, finite[k], strict=True):
            if not sound:
                part[:] = np.nan
        _warn_if_stopped(scene, solves[k])
        iterations = [int(n) for n in solves[k, :, 0]]
        judged = zip(finite[k], depth[k], meeting[k], strict=True)
        statuses = [RolloutStatus.judged(first + k, bool(f), float(d), *iterations, **_met(m)) for f, d, m in judged]
        found.append(Outcome(parts, statuses, bool(finite[k].any())))
    return found


def seen(scene: Scene, outcome: tuple[torch.Tensor, ...], body: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """What `read` reads of a frame.

    Args:
        scene: The scene that the frame belongs to.
        outcome: Its `Frame.outcome`.
        body: Packed positions of the bodies [m], [U,3]: read where vertices are carried, which may be inside them.
    """
    rides = scene.brought is not None and scene.brought.rides
    return (*outcome, body) if rides else outcome


def _met(figures: np.ndarray) -> dict[str, Any]:
    """Crossing pairs and lag of a garment as `RolloutStatus` has them, from its row of `frame.FIGURES`."""
    layers, itself, lag, unseen = figures
    counted = unseen == 0  # not for NaN
    return {
        "layer_crossings": int(layers) if counted else None,
        "self_crossings": int(itself) if counted else None,
        "lag": float(lag) if lag >= 0 else None,
    }


def _warn_if_stopped(scene: Scene, solves: np.ndarray) -> None:
    """Warns of solves that stopped at their limit of iterations; `solves` [2,3] is that of `Frame`, on the host."""
    for solver, (_, stopped, error) in zip((scene.reconstruct.solver, scene.contact.solver), solves, strict=True):
        if solver is not None:
            solver.warn_if_stopped(stopped, error)


class Recording:
    """Positions and statuses of a rollout, read from the device some frames at a time.

    Args:
        scene: The scene of the rollout.
        lengths: Number of frames of each garment. Later frames are not kept, nor those after one that is not finite.
        every: Number of frames that are read together.
    """

    def __init__(self, scene: Scene, lengths: Sequence[int], every: int) -> None:
        self.scene, self.lengths, self.every = scene, lengths, every
        garments = scene.garments if scene.brought is None else scene.brought.garments
        sizes = [(length, len(garment.vertices), 3) for length, garment in zip(lengths, garments, strict=True)]
        self.positions = [np.full(size, np.nan, np.float32) for size in sizes]
        self.statuses: list[list[RolloutStatus]] = [[] for _ in lengths]
        self._unread: list[tuple[torch.Tensor, ...]] = []
        self._first = 0  # number of the first frame that has not been read

    def add(self, outcome: tuple[torch.Tensor, ...], *, last: bool) -> bool:
        """Adds the next frame; returns False if a frame has been read in which no garment is finite."""
        self._unread.append(outcome)
        if len(self._unread) < self.every and not last:
            return True
        frames = read(self.scene, self._first, self._unread)
        first, self._first = self._first, self._first + len(frames)
        self._unread.clear()
        for number, frame in enumerate(frames, first):
            for i, (part, status) in enumerate(zip(frame.parts, frame.statuses, strict=True)):
                failed = self.statuses[i] and not self.statuses[i][-1].finite
                if number < self.lengths[i] and not failed:
                    self.positions[i][number] = part
                    self.statuses[i].append(status)
            if not frame.alive:
                return False
        return True

    def motions(
        self, garments: Sequence[Garment], clocks: Sequence[Clock], fps: float, given: Sequence[np.ndarray] | None
    ) -> list[GarmentMotion]:
        """The motion of each garment, with a warning for those that stopped.

        Args:
            garments: The garments as users brought them.
            clocks: Times of the bodies' frames, for each garment.
            fps: Frames per second of the rollout.
            given: Known first frames of each garment, [K,V,3], which are returned as they are; None: none.
        """
        warn_of_crossing_start(garments, [statuses[0] for statuses in self.statuses])
        results = []
        for i, (garment, clock, statuses) in enumerate(zip(garments, clocks, self.statuses, strict=True)):
            if not statuses[-1].finite:
                label = garment.name or f"garment {i}"
                warnings.warn(f"{label} stopped: {statuses[-1].message}", RuntimeWarning, stacklevel=3)
            moved = self.positions[i][: len(statuses)]
            if given is not None:
                moved[: len(given[i])] = given[i]
            last = clock.last if len(moved) == clock.frames else None
            told: dict[str, Any] = {"start": clock.start, "last": last, "surface": garment.surface}
            results.append(GarmentMotion(moved, garment.faces, fps, statuses, garment.name, **told))
        return results
