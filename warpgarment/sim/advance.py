"""One frame of a batch to the next one (Algorithm 1).

A CPU replays what does the same in every frame (`kernels/replay`): `_begin`, for networks that allow it, parts of
the passes of contact (`stages/contact.py`), and `_end`. Between them the host looks if anything is deep in a body.
"""

from __future__ import annotations

import functools
from typing import Any

import torch

from warpgarment.kernels.features.channels import FEATURES
from warpgarment.kernels.threads import torch_on_one
from warpgarment.nn.inputs import Frames

from .frame import Frame, earlier
from .scene import Scene


@torch_on_one()
def advance(scene: Scene, now: Frame, next_body: torch.Tensor) -> Frame:
    """Computes frame t+1 from frame t and the bodies at t+1 [m], shape [U,3]. The host does not wait for a GPU.

    The wind of `now` must be that of t+1 and t (`Frame.blown`), and is that of the result.
    """
    before, kept = now.positions, scene.pieces.kept
    stacked, features, solved, finite, origin, solve = _begun(scene, now, next_body)
    solved = scene.relax(solved, finite)
    *moved, report = scene.contact(solved, next_body, finite, origin, measure=scene.meet is None)
    pushed, finite, depth = map(kept, moved)
    meeting = now.meeting
    if scene.meet is not None:
        pushed, meeting, deep = scene.meet(before, pushed, features, next_body, finite, origin)
        depth = torch.where(finite, deep, depth)
    after, finite, depth = scene.correct(before, pushed, next_body, finite, depth)
    end = before, after, now.velocities, solve, report
    velocities, solves = scene.pieces("end", functools.partial(_end, scene), end)
    return Frame(
        after,
        next_body,
        Frames(stacked.frames[1:]) if isinstance(stacked, Frames) else stacked[:, 1:],
        kept(velocities),
        finite,
        depth,
        kept(solves),
        meeting,
        earlier(now.previous, before),
        earlier(now.previous_body, now.body),
        now.wind,
    )


def _begun(scene: Scene, now: Frame, next_body: torch.Tensor) -> tuple[Any, ...]:
    """Features of the history with frame t, those of frame t, and the results of `_step`."""
    past, depends = now.features, scene.replayed()
    scene.bodies.at(now.body)
    if depends is None or not isinstance(past, Frames) or any(f.stride() != (FEATURES, 1) for f in past.frames):
        features = scene.features(now.positions, now.body, next_body)
        stacked = scene.stacks(now.history, features)
        return (stacked, features, *_step(scene, now, stacked, features, next_body))
    moving = now.positions, now.body, next_body, now.velocities, now.finite, now.wind, now.previous, now.previous_body
    begin = functools.partial(_begin, scene, now)
    features, *more = scene.pieces("begin", begin, moving, frames=past.frames, depends=depends)
    features = scene.pieces.kept(features)
    return (Frames((*past.frames, features)), features, *more)


def _begin(scene: Scene, like: Frame, *moving: Any) -> tuple[Any, ...]:
    """Features of frame t and the results of `_step`.

    Args:
        scene: The scene, whose bodies are where they are in frame t.
        like: A frame of the scene.
        moving: What is new in each frame, in the order of `_begun`, then the features of earlier frames.
    """
    positions, body, next_body, velocities, finite, wind, previous, previous_body, *frames = moving
    now = like._replace(
        positions=positions,
        body=body,
        velocities=velocities,
        finite=finite,
        wind=wind,
        previous=previous,
        previous_body=previous_body,
    )
    scene.bodies.placed = body
    features = scene.features(positions, body, next_body)
    return (features, *_step(scene, now, Frames((*frames, features)), features, next_body))


def _step(
    scene: Scene, now: Frame, stacked: torch.Tensor | Frames, features: torch.Tensor, next_body: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, torch.Tensor]:
    """Positions at t+1 before physics and contact, which garments are finite so far, origins of the vertices, and the
    report of the solve."""
    step = scene.predict(scene.inputs(now, stacked, next_body))
    solved, finite = scene.reconstruct(now.positions, step, features, next_body)
    return solved, finite & now.finite, scene.contact.origin(now.positions, features), scene.reconstruct.summary()


def _end(
    scene: Scene,
    before: torch.Tensor,
    after: torch.Tensor,
    velocities: torch.Tensor,
    solve: torch.Tensor,
    report: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Velocities of the history one frame later [C,H-1,3], and the reports of the solves [2,3]."""
    newest = scene.centroids(after) - scene.centroids(before)
    return torch.cat([velocities[:, 1:], newest[:, None]], dim=1), torch.stack([solve, report])
