"""The state of a simulation between two frames."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any, Generic, TypeVar

from .frame import Frame
from .graph import GraphedFrames
from .recording import Outcome, read, seen
from .scene import Scene

Vertices = TypeVar("Vertices")
Status = TypeVar("Status")


@dataclasses.dataclass(frozen=True)
class SimulationState(Generic[Vertices, Status]):
    """Garments and bodies at one frame, with the history the network needs. `Simulator.step` returns a new one.

    States are values: stepping one leaves it as it was, so a state may be kept, and stepped twice with different
    bodies. The bodies' search trees are shared by all states of a `start` and moved as needed, so states of one `start`
    must not be stepped from several threads at a time.

    Stepping does not wait for a GPU; looking at `vertices` or `status` does.

    Of one garment it is a `SimulationState[np.ndarray, RolloutStatus]`, of a list of garments a
    `SimulationState[list[np.ndarray], list[RolloutStatus]]`.
    """

    scene: Scene
    single: bool  # one garment, not a list
    frame: int
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
