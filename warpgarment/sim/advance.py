"""One frame of a batch to the next one (Algorithm 1)."""

from __future__ import annotations

import torch

from warpgarment.nn.inputs import FrameInputs

from .frame import Frame
from .scene import Scene


def advance(scene: Scene, now: Frame, next_body: torch.Tensor) -> Frame:
    """Computes frame t+1 from frame t and the bodies at t+1 [m], shape [U,3]. The host does not wait for a GPU."""
    before = now.positions
    features = scene.features(before, now.body, next_body)
    stacked = now.history.stacked(features)
    step = scene.predict(FrameInputs(stacked, now.velocities, before, now.body, next_body))
    solved, finite = scene.reconstruct(before, step, features, next_body)
    origin = scene.contact.origin(before, features)
    meets = scene.meet.on
    pushed, finite, depth, report = scene.contact(solved, next_body, finite & now.finite, origin, measure=not meets)
    pushed, meeting = scene.meet(before, pushed, features, finite)
    if meets:
        depth = torch.where(finite, scene.contact.depth(pushed, next_body), depth)
    after, finite, depth = scene.correct(before, pushed, next_body, finite, depth)
    history = now.history.followed(stacked, scene.centroids(after) - scene.centroids(before))
    solves = torch.stack([scene.reconstruct.summary(), report])
    return Frame(after, next_body, history.features, history.velocities, finite, depth, solves, meeting)
