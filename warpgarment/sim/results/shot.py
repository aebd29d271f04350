"""Results at the frames of the shot, where its rate is not the network's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np
import torch

from warpgarment.errors import MeshError, UsageError
from warpgarment.geometry.checks import checked_fps
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.sim.scene import Scene

from .recording import read, seen

Rate: TypeAlias = float | Literal["body"] | None


def rates_of(bodies: Sequence[BodyMotion], wanted: Rate, network: float) -> list[float]:
    """Frames per second of the results on each body.

    Args:
        bodies: The bodies.
        wanted: As `out_fps` of `Simulator.rollout`.
        network: The network's rate.

    Raises:
        UsageError: No rate.
    """
    if wanted is None:
        return [network] * len(bodies)
    if wanted == "body":
        return [body.fps for body in bodies]
    try:
        return [checked_fps(wanted)] * len(bodies)
    except (MeshError, ValueError, TypeError):
        raise UsageError(f'out_fps must be a positive number or "body", got {wanted!r}.') from None


def frames_needed(frames: int | None, out: float, network: float) -> int | None:
    """Frames at the network's rate that cover so many of another one; None: all."""
    if frames is None or out == network:
        return frames
    return int(min(np.ceil((frames - 1) * network / out - 1e-6) + 1, 2.0**62))


def bodies_of_shot(
    bodies: Sequence[BodyMotion],
    rates: Sequence[float],
    frames: int | None,
    garments: Sequence[Garment],
    on: Sequence[int],
) -> list[BodyMotion]:
    """The bodies at the rates of the results, made before the simulation so that a rate that is none is found there.

    Args:
        bodies: The bodies as they were given.
        rates: Frames per second of the results on each.
        frames: No more than so many frames; None: all.
        garments: The garments.
        on: Which body each is on.

    Raises:
        MeshError: Frames of so high a rate would fill memory.
    """
    for garment, b in zip(garments, on, strict=True):
        bodies[b].clock.resampled(rates[b], frames, points=len(garment.vertices))
    return [body.resampled(rate, frames) for body, rate in zip(bodies, rates, strict=True)]


@torch.inference_mode()
def brought_to_shot(
    scene: Scene,
    motions: Sequence[GarmentMotion],
    on: Sequence[int],
    bodies: Sequence[BodyMotion],
    simulated: Sequence[BodyMotion],
    rates: Sequence[float],
    frames: int | None,
) -> list[GarmentMotion]:
    """Results at other rates than the network's.

    Positions are interpolated in a straight line in time. Between two frames of the network they are then moved out of
    the body as it is in the shot, by the contact stage of the simulation, and the depth is measured there. Garments of
    an outfit may cross between two frames of the network; such pairs are counted, not moved apart.

    Args:
        scene: The scene of the rollout.
        motions: Its results, at the network's rate.
        on: Which body each garment is on.
        bodies: The bodies at the rates of the results, see `bodies_of_shot`.
        simulated: The bodies at the network's rate.
        rates: Frames per second of the results on each body.
        frames: No more than so many frames; None: all.
    """
    found = [motion.resampled(rates[b], frames) for motion, b in zip(motions, on, strict=True)]
    where = [now.clock.places(body.clock.times) for now, body in zip(simulated, bodies, strict=True)]
    for frame in range(max(motion.frames for motion in found)):
        at = [min(frame, body.frames - 1) for body in bodies]
        shown = [body.vertices[t] for body, t in zip(bodies, at, strict=True)]
        same = [
            places[t] % 1 == 0 and np.array_equal(body, now.vertices[int(places[t])])
            for places, t, body, now in zip(where, at, shown, simulated, strict=True)
        ]
        moving = [not same[b] and frame < m.frames and _is_finite(m, frame) for m, b in zip(found, on, strict=True)]
        if not any(moving):
            continue
        pending = torch.tensor(moving, device=scene.packed.faces.device)
        parts = [_last_finite(motion, frame) for motion in found]
        cloth = _tensor(parts if scene.brought is None else [scene.brought.reduced(parts)], pending.device)
        body = _tensor(shown, pending.device)
        moved, finite, depth, report = scene.contact(cloth, body, pending)
        solves = torch.stack([torch.zeros_like(report), report])
        tensors = (moved, finite, depth, solves, scene.measure_meeting(moved, finite))
        outcome = read(scene, frame, [seen(scene, tensors, body)])[0]
        for i in np.flatnonzero(moving):
            found[i].vertices[frame], found[i].status[frame] = outcome.parts[i], outcome.statuses[i]
    return found


def _is_finite(motion: GarmentMotion, frame: int) -> bool:
    return bool(np.isfinite(motion.vertices[frame]).all())


def _last_finite(motion: GarmentMotion, frame: int) -> np.ndarray:
    """Positions in a frame, or the last before it that are finite."""
    frame = min(frame, motion.frames - 1)
    while frame and not _is_finite(motion, frame):
        frame -= 1
    return motion.vertices[frame]


def _tensor(arrays: Sequence[np.ndarray], device: torch.device) -> torch.Tensor:
    return torch.from_numpy(np.concatenate(arrays)).to(device)
