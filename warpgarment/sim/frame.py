"""One frame of a batch on the device, the next one from it, and reading what the host wants to know of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from warpgarment.objects.status import RolloutStatus

from .history import History
from .scene import Scene

READ_EVERY = 16  # frames of a rollout that a GPU computes before the host looks at them


class Frame(NamedTuple):
    """One frame of a batch: tensors on the device alone, so that a frame can follow another without the host."""

    positions: torch.Tensor  # [V,3] packed; of a garment that failed, where it was last finite
    body: torch.Tensor  # [U,3] packed
    features: torch.Tensor  # of the history, [F,H-1,34]
    velocities: torch.Tensor  # of the history, [C,H-1,3]
    finite: torch.Tensor  # bool [B]
    depth: torch.Tensor  # [B] metres
    solves: (
        torch.Tensor
    )  # float64 [2,3]: Poisson and collisions; iterations, components stopped, largest error of these

    @property
    def history(self) -> History:
        """What the network remembers."""
        return History(self.features, self.velocities)

    @property
    def outcome(self) -> tuple[torch.Tensor, ...]:
        """What `read` reads."""
        return self.positions, self.finite, self.depth, self.solves


def advance(scene: Scene, now: Frame, next_body: torch.Tensor) -> Frame:
    """Algorithm 1: frame t, and the bodies at t+1 [U,3], to frame t+1. Only a CPU looks at a number on the way."""
    vertices = now.positions
    features = scene.features(vertices, now.body, next_body)
    stacked = now.history.stacked(features)
    step = scene.predict(stacked, now.velocities)
    solved, finite = scene.reconstruct(vertices, step, features, next_body)
    poisson = scene.poisson.summary()
    origin = scene.carried(vertices, features) if scene.collision_passes else None
    committed, finite, depth, collision = scene.push_out(solved, next_body, finite & now.finite, origin)
    velocity = scene.components_mean(committed) - scene.components_mean(vertices)
    history = now.history.followed(stacked, velocity)
    solves = torch.stack([poisson, collision])
    return Frame(committed, next_body, history.features, history.velocities, finite, depth, solves)


class Outcome(NamedTuple):
    """A frame as the host sees it."""

    parts: list[np.ndarray]  # positions of each garment [V,3]; NaN for one that has failed
    statuses: list[RolloutStatus]
    alive: bool  # whether any garment is finite


def read(scene: Scene, first: int, frames: Sequence[tuple[torch.Tensor, ...]]) -> list[Outcome]:
    """Reads frames from the device, all in one go, and warns of solves that did not converge.

    Args:
        scene: Theirs.
        first: Number of the first frame.
        frames: `Frame.outcome` of this and the following frames.
    """
    positions, finite, depth, solves = (torch.stack(tensors).cpu().numpy() for tensors in zip(*frames, strict=True))
    found = []
    for k in range(len(frames)):
        parts = [part.copy() for part in scene.packed.split(positions[k])]
        for part, sound in zip(parts, finite[k], strict=True):
            if not sound:
                part[:] = np.nan
        scene.tell(solves[k])
        iterations = [int(n) for n in solves[k, :, 0]]
        judged = zip(finite[k], depth[k], strict=True)
        statuses = [RolloutStatus.judged(first + k, bool(f), float(d), *iterations) for f, d in judged]
        found.append(Outcome(parts, statuses, bool(finite[k].any())))
    return found


class Recording:
    """What a rollout keeps of its frames, read from the device some frames at a time.

    Args:
        scene: Of the rollout.
        lengths: Frames of each garment; later ones are not kept, nor what follows a frame that is not finite.
        every: Frames that are read together.
    """

    def __init__(self, scene: Scene, lengths: Sequence[int], every: int) -> None:
        self.scene, self.lengths, self.every = scene, lengths, every
        sizes = [(length, len(garment.vertices), 3) for length, garment in zip(lengths, scene.garments, strict=True)]
        self.positions = [np.full(size, np.nan, np.float32) for size in sizes]
        self.statuses: list[list[RolloutStatus]] = [[] for _ in lengths]
        self._unread: list[tuple[torch.Tensor, ...]] = []
        self._first = 0  # number of the first frame that was not read

    def add(self, outcome: tuple[torch.Tensor, ...], *, last: bool) -> bool:
        """Takes the next frame; False once it is known that no garment is finite any more."""
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
