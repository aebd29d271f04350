r"""Rollouts as tensors through which gradients flow, to the wind, the material, the first frame and the network.

    predict -> singular values -> Poisson -> collisions -> features of the next frame -> predict -> ...

The stages are those of `Simulator.rollout`, and so are the positions. Gradients are those of the frame as it was
decided: with the nearest body faces, the contacts, and the rotation by which the body turns the cloth there held fixed.
On a body that is not touched they agree with finite differences to a few per cent; where cloth is in contact, finite
differences themselves jump.
"""

from __future__ import annotations

from dataclasses import astuple
from typing import TYPE_CHECKING, Any

import torch

from warpgarment.errors import UsageError
from warpgarment.nn.run import evaluating
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.pack import PackedBodies
from warpgarment.sim.advance import advance
from warpgarment.sim.arguments import counted, known_frames, packed_on
from warpgarment.sim.brought import Brought
from warpgarment.sim.outdoors import refuse

if TYPE_CHECKING:
    from warpgarment.sim.simulator import Simulator


def rollout(
    simulator: Simulator,
    garment: Garment,
    body: BodyMotion,
    *,
    first_vertices: Any = None,
    frames: int | None = None,
    wind: torch.Tensor | None = None,
    material: torch.Tensor | Material | None = None,
    progress: bool = False,
) -> torch.Tensor:
    """Simulates a garment as `Simulator.rollout` does, with gradients.

    Every frame keeps what its gradient needs, about 20 MB for 1,800 faces with `layers`. Gradients flow to the weights
    of the network too, unless it was given `requires_grad_(False)`, which saves time and memory.

    Args:
        simulator: The simulator.
        garment: The garment, all vertices of which must be simulated.
        body: The body, which is resampled to the network's rate.
        first_vertices: Positions in the first frame [m], shape [V,3]; None for `garment.vertices`.
        frames: Largest number of frames; None for the whole motion.
        wind: Velocity of the air [m/s], shape [3], or [T,3] at the network's rate, of which the last row holds on.
        material: The fields of a `Material` in their order, shape [6]; or a `Material`.
        progress: Whether to show a progress bar.

    Returns:
        Positions [m], float32 [T,V,3].

    Raises:
        ValueError: A shape is another one, or the network does not read the wind or materials.
        UsageError: The garment has vertices that are carried and not simulated, or `frames` is less than 1.
    """
    fps, device = simulator.network.config.fps, simulator.device
    if frames is not None and frames < 1:
        raise UsageError(f"frames must be at least 1, got {frames}")
    start = None if first_vertices is None else torch.as_tensor(first_vertices)
    brought = Brought([garment], known_frames([garment], True, 1, start, None))
    if brought.rides or len(brought.simulated[0].vertices) != len(garment.vertices):
        raise UsageError(
            "gradients need a garment all of whose vertices are simulated: one piece, its seams joined. "
            "Garment.load(path, clean=True) joins seams."
        )
    air = _rows(simulator, "wind", wind, 3)
    cloth = torch.tensor(astuple(material)) if isinstance(material, Material) else material
    cloth = _rows(simulator, "materials", cloth, len(astuple(Material())))
    if cloth is not None and len(cloth) != 1:
        raise ValueError(f"material must have the shape of the fields of one Material, got {list(cloth.shape)}")
    moving = body.resampled(fps, frames)
    bodies = PackedBodies.pack([moving.faces], [moving.vertices.shape[1]], [0], device)
    places = [packed_on([moving.vertices[t]], device) for t in range(min(moving.frames, frames or moving.frames))]
    blowing = [None if air is None else air[min(t, len(air) - 1)][None] for t in range(len(places))]
    still = None if blowing[0] is None else blowing[0].detach()
    with evaluating(simulator.network):
        state = simulator._begin(brought, True, bodies, places[:1], 1, [], cloth, [still])[0]
        state.scene.features.sliding = True
        now = state.now
        if start is not None:
            now = now._replace(positions=start.to(device, torch.float32))
        found = [now.positions]
        for t in counted(range(1, len(places)), progress):
            now = advance(state.scene, now.blown(blowing[t]), places[t])
            found.append(now.positions)
    return torch.stack(found)


def _rows(simulator: Simulator, name: str, value: torch.Tensor | None, width: int) -> torch.Tensor | None:
    """An input of the network as float32 [T,K] on the device; None if None is given."""
    if value is None:
        return None
    refuse(simulator.network, name)
    if value.ndim not in (1, 2) or value.shape[-1] != width or not len(value):
        raise ValueError(f"{name} must have shape [{width}] or [T,{width}], got {list(value.shape)}")
    return value.to(simulator.device, torch.float32).reshape(-1, width)
