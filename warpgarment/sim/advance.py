"""One frame of a batch to the next one (Algorithm 1)."""

from __future__ import annotations

import torch

from warpgarment.kernels.threads import torch_on_one

from .frame import Frame, earlier
from .scene import Scene


@torch_on_one()
def advance(scene: Scene, now: Frame, next_body: torch.Tensor) -> Frame:
    """Computes frame t+1 from frame t and the bodies at t+1 [m], shape [U,3]. The host does not wait for a GPU.

    The wind of `now` must be that of t+1 and t (`Frame.blown`), and is that of the result.
    """
    before = now.positions
    features = scene.features(before, now.body, next_body)
    stacked = scene.stacks(now.history, features)
    step = scene.predict(scene.inputs(now, stacked, next_body))
    solved, finite = scene.reconstruct(before, step, features, next_body)
    solved = scene.relax(solved, finite)
    origin = scene.contact.origin(before, features)
    pushed, finite, depth, report = scene.contact(
        solved, next_body, finite & now.finite, origin, measure=scene.meet is None
    )
    meeting = now.meeting
    if scene.meet is not None:
        pushed, meeting, deep = scene.meet(before, pushed, features, next_body, finite, origin)
        depth = torch.where(finite, deep, depth)
    after, finite, depth = scene.correct(before, pushed, next_body, finite, depth)
    history = now.history.followed(stacked, scene.centroids(after) - scene.centroids(before))
    solves = torch.stack([scene.reconstruct.summary(), report])
    return Frame(
        after,
        next_body,
        history.features,
        history.velocities,
        finite,
        depth,
        solves,
        meeting,
        earlier(now.previous, before),
        earlier(now.previous_body, now.body),
        now.wind,
    )
