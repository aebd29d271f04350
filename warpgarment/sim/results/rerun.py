"""A rollout that can be run again with other materials and wind, frame by frame."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.errors import UsageError
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.outfit import Outfit
from warpgarment.objects.wind import Wind
from warpgarment.sim.outdoors import refuse

if TYPE_CHECKING:
    from warpgarment.sim.simulator import Simulator


class Rerun:
    """Garments on a moving body, to be simulated again and again: what `wg.browse` shows with sliders.

        page = wg.browse(wg.Rerun(simulator, outfit, body, first_vertices=first))

    Frames are those of `Simulator.rollout` at the network's rate, and are handed out one at a time, so that a run can
    be watched while it goes on, and given up.

    Args:
        simulator: The simulator.
        garment: A garment, a list, or an `Outfit`.
        body: The body.
        first_vertices: Positions in the first frame [m], as in `rollout`.
        layers: What is worn together, as in `rollout`.
        materials: Materials, as in `rollout`: those of the first run. None: those of an `Outfit`, if it has some.
        wind: The wind of the first run, or None.
        frames: Largest number of frames; None for the whole motion.

    Attributes:
        garments: The garments, a list.
        body: The body at the network's rate, with as many frames as a run has.
        reads: Names of what the network reads, of "materials" and "wind".
        materials: Material of each garment, or None.
        wind: The wind, or None.

    Raises:
        ValueError: Materials or wind are given that the network does not read, or as many materials as garments are
            not.
        UsageError: `frames` is less than 1.
    """

    def __init__(
        self,
        simulator: Simulator,
        garment: Garment | Sequence[Garment],
        body: BodyMotion,
        *,
        first_vertices: Any = None,
        layers: Any = None,
        materials: Material | Sequence[Material | None] | None = None,
        wind: Wind | None = None,
        frames: int | None = None,
    ) -> None:
        if frames is not None and frames < 1:
            raise UsageError(f"frames must be at least 1, got {frames}")
        outfit = isinstance(garment, Outfit)
        self.garments = [garment] if isinstance(garment, Garment) else list(garment)
        if isinstance(garment, Outfit) and materials is None:
            materials = garment.materials
        self.simulator, self._layers = simulator, True if outfit and layers is None else layers
        single = isinstance(garment, Garment) and first_vertices is not None
        self._first = [first_vertices] if single else first_vertices
        shot = body.resampled(simulator.network.config.fps)
        self.body = shot if frames is None else shot.on_clock(_first_of(shot, frames))
        self.reads: Collection[str] = {"materials", "wind"} & set(simulator.network.reads)
        for name, given in {"materials": materials, "wind": wind}.items():
            if given is not None:
                refuse(simulator.network, name)
        count = len(self.garments)
        held = [materials] * count if isinstance(materials, Material | None) else list(materials)
        if len(held) != count:
            raise ValueError(f"{count} garments and {len(held)} materials; give one for each, or a single one for all")
        self.materials, self.wind = held, wind

    def run(
        self, materials: Sequence[Material | None] | None = None, wind: Wind | None = None
    ) -> Iterator[list[np.ndarray]]:
        """Simulates; hands out positions of each garment [m], float32 [V,3], for each frame of `body`.

        Args:
            materials: Material of each garment, or None for one without; None for no materials.
            wind: The wind, or None for none.
        """
        given: dict[str, Any] = {"first_vertices": self._first, "layers": self._layers, "wind": wind}
        if materials is not None and any(material is not None for material in materials):
            given["materials"] = list(materials)
        frames = self.body.vertices
        state: Any = self.simulator.start(self.garments, frames[0], self.body.faces, **given)
        yield state.vertices
        for body in frames[1:]:
            state = self.simulator.step(state, body, wind=wind)
            yield state.vertices


def _first_of(body: BodyMotion, frames: int) -> Any:
    clock = body.clock
    return clock if frames >= clock.frames else clock._replace(frames=frames, last=float(frames - 1))
