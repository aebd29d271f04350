"""One frame of a batch to the next one (Algorithm 1)."""

from __future__ import annotations

import torch

from warpgarment.nn.inputs import FrameInputs, VertexStep

from .frame import Frame
from .scene import Scene


def advance(scene: Scene, now: Frame, next_body: torch.Tensor) -> Frame:
    """Algorithm 1: frame t, and the bodies at t+1 [U,3], to frame t+1. Only a CPU looks at a number on the way."""
    vertices = now.positions
    features = scene.features(vertices, now.body, next_body)
    stacked = now.history.stacked(features)
    step = scene.predict(FrameInputs(stacked, now.velocities, vertices, now.body, next_body))
    solved, finite = scene.reconstruct(vertices, step, features, next_body)
    # of positions that the network gave itself, no system was solved
    poisson = now.solves.new_zeros(3) if isinstance(step, VertexStep) else scene.poisson.summary()
    origin = scene.carried(vertices, features) if scene.collision_passes else None
    committed, finite, depth, collision = scene.push_out(solved, next_body, finite & now.finite, origin)
    velocity = scene.components_mean(committed) - scene.components_mean(vertices)
    history = now.history.followed(stacked, velocity)
    solves = torch.stack([poisson, collision])
    return Frame(committed, next_body, history.features, history.velocities, finite, depth, solves)
