"""The state of a simulation between two frames."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, Generic, TypeVar

from .frame import Frame
from .graph import GraphedFrames
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
        return read(self.scene, self.frame, [seen(self.scene, self.now)])[0]
