"""Batches of jobs: which of them run together, and one rollout for all of these."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from warpgarment.cli.shot import Checked, Loaded
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.sim import memory
from warpgarment.sim.results.shot import frames_needed
from warpgarment.sim.simulator import Simulator

from .entries import Job

ON_CPU, ON_GPU = 8, 256  # garments of a batch: more do not make a CPU faster, and are lost if a run is killed


class Ready(NamedTuple):
    """A job whose files are loaded."""

    job: Job
    shot: Loaded
    mark: str


def kind(known: Checked) -> tuple[Any, ...]:
    """What jobs of one rollout have in common: its arguments that are not lists."""
    shot = known.shot
    return str(shot.frames), str(shot.out_fps), shot.layers, any(known.materials), known.windy


class Waiting:
    """Loaded jobs that wait until there are enough of their kind and length, or no memory for more.

    Jobs of a batch are of one kind, and the longest is less than twice as long as the shortest: all of them are
    simulated as long as the longest.

    Args:
        simulator: What simulates them.
        most: Most garments of a batch.
    """

    def __init__(self, simulator: Simulator, most: int) -> None:
        self.simulator, self.most = simulator, most
        self._batches: dict[tuple[Any, ...], list[Ready]] = {}

    def add(self, ready: Ready) -> Iterator[list[Ready]]:
        """Takes a job, and yields the batches that are to be run now."""
        key = (kind(ready.shot.checked), self._steps(ready).bit_length())
        batch = self._batches.get(key, [])
        if batch and not self._fits([*batch, ready]):
            yield self._batches.pop(key)
        self._batches.setdefault(key, []).append(ready)
        if _count(self._batches[key]) >= self.most:
            yield self._batches.pop(key)
        while len(self._batches) > 1 and not self._all_fit():
            yield self._batches.pop(max(self._batches, key=lambda key: _count(self._batches[key])))

    def rest(self) -> Iterator[list[Ready]]:
        """Yields all that still wait."""
        while self._batches:
            yield self._batches.pop(next(iter(self._batches)))

    def _fits(self, batch: Sequence[Ready]) -> bool:
        """Whether a batch fits on the device, and its results in the memory of the host."""
        if _count(batch) > self.most:
            return False
        device = self.simulator.device
        room = memory.free(device)
        if room is None:
            return True
        garments, bodies, _ = _lists(batch, share=True)
        layers = _worn(batch) if batch[0].shot.checked.shot.layers else []
        needed = memory.predict(
            garments,
            list({id(body): body for body in bodies}.values()),
            self.simulator.network.config,
            half=self.simulator.half,
            device=device,
            physics=self.simulator.physics,
            correctors=self.simulator.correctors,
            layers=layers,
        ).total
        host = sum(self._host(ready) for ready in batch)
        if device.type != "cpu":
            return needed <= memory.USABLE * room and host <= memory.USABLE * (memory.free("cpu") or host)
        return needed + host <= memory.USABLE * room

    def _all_fit(self) -> bool:
        room = memory.free("cpu")
        waiting = [ready for batch in self._batches.values() for ready in batch]
        return room is None or sum(map(self._host, waiting)) <= 0.5 * room

    def _host(self, ready: Ready) -> int:
        """Bytes of the positions of a job that a rollout allocates: body and cloth at the rates of network and shot."""
        shot = ready.shot
        frames = shot.frames(self.simulator.network.config.fps)
        points = shot.body.vertices.shape[1] + 2 * sum(len(garment.vertices) for garment in shot.garments.values())
        return 12 * points * (frames + self._steps(ready))

    def _steps(self, ready: Ready) -> int:
        """Number of frames that the network simulates."""
        network, body, frames = self.simulator.network.config.fps, ready.shot.body, ready.shot.checked.shot.frames
        rate = body.fps if ready.shot.rate == "body" else ready.shot.rate or network
        return body.clock.resampled(network, frames_needed(frames, rate, network))[0].frames


def rolled(simulator: Simulator, batch: Sequence[Ready], progress: bool = False) -> list[dict[str, GarmentMotion]]:
    """Simulates a batch of one kind in one rollout; returns the motions of each job by the names of its garments.

    Raises:
        ValueError, MeshError, NotEnoughMemory: As of `Simulator.rollout`.
    """
    shot = batch[0].shot.checked.shot
    garments, bodies, first = _lists(batch, share=not simulator.network.reads)
    known = [material for ready in batch for material in _materials(ready)]
    motions = simulator.rollout(
        garments,
        bodies,
        first_vertices=first,
        frames=shot.frames,
        out_fps=batch[0].shot.rate,
        layers=_worn(batch) if shot.layers else None,
        materials=known if any(known) else None,
        wind=_wind(batch, simulator.network.config.fps),
        progress=progress,
    )
    rest = iter(motions)
    return [{name: next(rest) for name in ready.shot.garments} for ready in batch]


def _count(batch: Sequence[Ready]) -> int:
    return sum(len(ready.shot.garments) for ready in batch)


def _lists(batch: Sequence[Ready], share: bool) -> tuple[list[Garment], list[BodyMotion], list[np.ndarray]]:
    """Garments, with body and first positions of each.

    Networks that see other garments on a body get a body of its own for each job, as garments of one job see those of
    no other; otherwise jobs share the bodies that they have in common, and their search trees.
    """
    garments: list[Garment] = []
    bodies: list[BodyMotion] = []
    first: list[np.ndarray] = []
    for ready in batch:
        shot = ready.shot
        mine = list(shot.garments.values())
        garments += mine
        bodies += [shot.body if share else copy.copy(shot.body)] * len(mine)
        first += [garment.vertices for garment in mine] if shot.first is None else shot.first
    return garments, bodies, first


def _worn(batch: Sequence[Ready]) -> list[list[int]]:
    """The outfit of each job, as numbers of garments in the batch."""
    found, start = [], 0
    for ready in batch:
        found.append(list(range(start, start + len(ready.shot.garments))))
        start += len(ready.shot.garments)
    return found


def _materials(ready: Ready) -> list[Any]:
    return ready.shot.checked.materials or [None] * len(ready.shot.garments)


def _wind(batch: Sequence[Ready], fps: float) -> np.ndarray | None:
    """Velocity of the air at each frame for each garment [m/s], float32 [T,B,3]; the last row of each holds on."""
    if batch[0].shot.wind is None:
        return None
    rows = [ready.shot.wind.velocities(fps) for ready in batch for _ in ready.shot.garments if ready.shot.wind]
    longest = max(map(len, rows))
    return np.stack([np.concatenate([row, np.repeat(row[-1:], longest - len(row), 0)]) for row in rows], axis=1)
