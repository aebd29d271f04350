"""Errors of the network's own rollouts, as displacements of recorded frames from which training samples can start.

A few short rollouts start from recorded history (or cold, from frame 0) at random places of the training set. After k
steps, the errors of the network are the differences of the newest k frames from the recorded ones. They displace the
newest frames of a sample's history, and the sample's target leads back to the recorded motion. The pool is refreshed at
regular intervals; between them it does not change, and it is part of the saved training state, so that resumed runs
have the same samples. Several processes share the work, and each gets all rollouts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from warpgarment.training.distributed import Group
from warpgarment.training.rollouts import predict

if TYPE_CHECKING:
    from warpgarment.sim.simulator import Simulator


@dataclass(frozen=True)
class PushforwardConfig:
    """Settings of the pool.

    Attributes:
        share: Share of training samples that start from the pool. 0, the default, switches it off: in all experiments
            so far, it made rollouts worse (benchmarks/results/recipe.md).
        steps: Length of each rollout in frames.
        rollouts: Number of rollouts in the pool.
        every: Number of training steps between refreshes, and before the first one.
        cold: Share of rollouts that start cold at frame 0.
        limit: Largest mean displacement of a frame [m]. From the first larger one on, frames of a rollout are dropped,
            since one step cannot lead back from them.
    """

    share: float = 0.0
    steps: int = 8
    rollouts: int = 24
    every: int = 500
    cold: float = 0.25
    limit: float = 0.05


class Pool:
    """Rollouts as (sequence index, first predicted frame, displacements [K,V,3] in metres)."""

    def __init__(self) -> None:
        self.rollouts: list[tuple[int, int, np.ndarray]] = []
        self.step = 0  # training step of the last refresh

    def fitting(self, sizes: np.ndarray, faces: int, *, whole: bool = False) -> list[tuple[int, int]]:
        """All (rollout, index of the last frame) whose garment has at least `faces` faces; at most with `whole`."""
        return [
            (r, k)
            for r, (s, _, displacement) in enumerate(self.rollouts)
            if (sizes[s] <= faces if whole else sizes[s] >= faces)
            for k in range(len(displacement))
        ]

    def entry(self, rollout: int, last: int) -> tuple[int, int, np.ndarray]:
        """Sequence, newest frame, and displacements of the frames up to it [m], [last + 1, V, 3], oldest first."""
        sequence, first, displacement = self.rollouts[rollout]
        return sequence, first + last, displacement[: last + 1]

    def tensors(self) -> dict[str, torch.Tensor]:
        """The pool as tensors, for the saved training state."""
        saved = {}
        for r, (s, first, displacement) in enumerate(self.rollouts):
            saved[f"pool.{r}.displacement"] = torch.from_numpy(np.ascontiguousarray(displacement))
            saved[f"pool.{r}.place"] = torch.tensor([s, first])
        return saved

    def restore(self, tensors: dict[str, torch.Tensor]) -> None:
        """Restores the pool from the result of `tensors`."""
        self.rollouts = []
        while f"pool.{len(self.rollouts)}.place" in tensors:
            r = len(self.rollouts)
            s, first = tensors[f"pool.{r}.place"].tolist()
            self.rollouts.append((s, first, tensors[f"pool.{r}.displacement"].numpy()))

    def refresh(
        self, simulator: Simulator, sequences: list, config: PushforwardConfig, rng: np.random.Generator, group: Group
    ) -> float:
        """Replaces the pool by new rollouts.

        Args:
            simulator: A simulator with the current network.
            sequences: Training sequences, `SequenceData`; those in pieces are left out.
            config: Settings of the pool.
            rng: Source of the random places, in the same state in all processes.
            group: The processes that share the work.

        Returns:
            Mean vertex error after the last step [m], over the rollouts that stayed finite; NaN if none did.
        """
        places = self._places(sequences, config, rng, simulator.network.config.history)
        found = []
        for number, (s, newest, steps, cold) in enumerate(places):
            data = sequences[s]
            displacement = np.zeros((steps, *data.vertices.shape[1:]), np.float32)
            if number % group.size == group.rank:
                recorded = data.vertices[newest + 1 : newest + 1 + steps].cpu().numpy()
                predicted = predict(simulator, data.source, newest, steps, cold=cold, body=data.body)
                displacement = (predicted - recorded).astype(np.float32)
            found.append(displacement)
        rollouts, errors = [], []
        for number, ((s, newest, steps, _), displacement) in enumerate(zip(places, found, strict=True)):
            group.broadcast(torch.from_numpy(displacement), number % group.size)
            error = np.linalg.norm(displacement, axis=-1).mean(axis=1)
            good = np.isfinite(error) & (error < config.limit)
            keep = steps if good.all() else int(np.argmin(good))
            errors.append(error[-1])
            if keep:
                rollouts.append((s, newest + 1, displacement[:keep]))
        self.rollouts = rollouts
        finite = [e for e in errors if np.isfinite(e)]
        return float(np.mean(finite)) if finite else float("nan")

    @staticmethod
    def _places(
        sequences: list, config: PushforwardConfig, rng: np.random.Generator, history: int
    ) -> list[tuple[int, int, int, bool]]:
        """Random starts of rollouts: sequence, newest recorded frame, number of steps, whether the start is cold."""
        places = []
        recordings = [s for s, data in enumerate(sequences) if data.pieces.whole]
        for _ in range(config.rollouts if recordings else 0):
            s = recordings[int(rng.integers(len(recordings)))]
            data = sequences[s]
            cold = bool(rng.random() < config.cold) or data.count <= history
            newest = 0 if cold else int(rng.integers(history - 1, data.count))
            steps = min(config.steps, data.count - 1 - newest)  # the frame after the last one is a target
            if steps >= 1:
                places.append((s, newest, steps, cold))
        return places
