"""The state of a simulation between two frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Generic, TypeVar

import torch

from .frame import Frame
from .graph import GraphedFrames
from .history import History
from .results.recording import Outcome, read, seen
from .scene import Scene

Vertices = TypeVar("Vertices")
Status = TypeVar("Status")


@dataclasses.dataclass(frozen=True)
class SimulationState(Generic[Vertices, Status]):
    """Garments and bodies at one frame, with the history the network needs. `Simulator.step` returns a new one.

    States are values: `step` does not change its argument, so a state may be kept, and stepped twice with different
    bodies. All states of a `start` share the search trees of the bodies, so they must not be stepped from several
    threads at a time.

    `step` does not wait for a GPU; reading `vertices` or `status` does.

    For one garment the type is `SimulationState[np.ndarray, RolloutStatus]`, for a list of garments
    `SimulationState[list[np.ndarray], list[RolloutStatus]]`.
    """

    scene: Scene
    single: bool  # whether one garment was given instead of a list
    frame: int  # number of the frame, from 0
    now: Frame
    graph: GraphedFrames | None = None  # replays frames, for all states of a `start`

    @property
    def vertices(self) -> Vertices:
        """Positions [m], float32 [V,3]; a list of such for a list of garments. NaN for a garment that has failed."""
        parts: Any = [part.copy() for part in self._read.parts]
        return parts[0] if self.single else parts

    @property
    def status(self) -> Status:
        """The `RolloutStatus` of this frame; a list of them for a list of garments."""
        statuses: Any = list(self._read.statuses)
        return statuses[0] if self.single else statuses

    @cached_property
    def _read(self) -> Outcome:
        return read(self.scene, self.frame, [seen(self.scene, self.now.outcome, self.now.body)])[0]


def starting_states(
    scene: Scene,
    single: bool,
    known: torch.Tensor,
    bodies: Sequence[torch.Tensor],
    wind: Sequence[torch.Tensor | None],
    graph: GraphedFrames | None,
) -> list[SimulationState[Any, Any]]:
    """States of the known frames: one for a cold start, as many as the network's history otherwise.

    Args:
        scene: The scene.
        single: Whether one garment was given instead of a list.
        known: Garments in the known frames [m], packed, shape [K,V,3].
        bodies: Bodies in these frames [m], packed, shape [U,3] each.
        wind: Velocity of the air in these frames [m/s], shape [B,3] each; None for still air.
        graph: What replays later frames.
    """
    reads, count = scene.network.reads, scene.packed.count
    features = scene.features(known[0], bodies[0], bodies[0])
    history = History.cold(features, scene.packed.component_count, scene.network.config.history)
    finite = torch.ones(count, dtype=torch.bool, device=known.device)
    unsolved = torch.zeros((2, 3), dtype=torch.float64, device=known.device)
    air = [known.new_zeros((count, 3)) if blowing is None else blowing for blowing in wind]
    states: list[SimulationState[Any, Any]] = []
    for frame, (vertices, body) in enumerate(zip(known, bodies, strict=True)):
        if frame:
            features = scene.features(known[frame - 1], bodies[frame - 1], body)
            velocity = scene.centroids(vertices) - scene.centroids(known[frame - 1])
            history = history.followed(scene.stacks(history, features), velocity)
        depth = scene.contact.depth(vertices, body)
        past = [max(frame - k, 0) for k in (1, 2)] if "previous" in reads else []
        blown = [air[frame], air[max(frame - 1, 0)]] if "wind" in reads else []
        now = Frame(
            vertices,
            body,
            history.features,
            history.velocities,
            finite,
            depth,
            unsolved,
            scene.measure_meeting(vertices, finite),
            previous=_stacked([known[k] for k in past], vertices),
            previous_body=_stacked([bodies[k] for k in past], body),
            wind=_stacked(blown, air[0]),
        )
        states.append(SimulationState(scene, single, frame, now, graph))
    return states


def _stacked(frames: list[torch.Tensor], like: torch.Tensor) -> torch.Tensor:
    """Frames [*,3] as [K,*,3]; of no frames [0,*,3]."""
    return torch.stack(frames) if frames else like.new_empty((0, *like.shape))
