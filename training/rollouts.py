"""Rollouts that start from recorded frames of a sequence: warm, from as many as the network remembers, or cold, from
one.

A cold start is the recorded frame repeated on a body that stands still, which is what the network was trained on.
"""

from __future__ import annotations

import warnings

import numpy as np

from warpgarment.objects.body import BodyMotion


def predict(
    simulator, sequence, newest: int, steps: int, *, cold: bool = False, body: BodyMotion | None = None
) -> np.ndarray:
    """Rolls a sequence out from its recorded frames.

    Args:
        simulator: A `Simulator`.
        sequence: A `dataset.Sequence`.
        newest: The newest recorded frame that the network may see.
        steps: Frames to predict; frame `newest + steps` of the body must exist.
        cold: See only that one frame.
        body: `sequence.body()`, where the caller has it already.

    Returns:
        Vertices of frames newest+1 .. newest+steps [m], float32 [steps,V,3]; NaN after a rollout that failed.
    """
    history = simulator.network.config.history
    body = sequence.body() if body is None else body
    if cold:
        first, known = newest, {"first_vertices": np.array(sequence.vertices[newest], np.float32)}
    elif newest >= history - 1:
        first = newest - history + 1
        known = {"history": np.array(sequence.vertices[first : newest + 1], np.float32)}
    else:
        raise ValueError(f"a warm start needs {history} recorded frames; up to frame {newest} there are {newest + 1}")
    part = BodyMotion(body.vertices[first : newest + steps + 1], body.faces, body.fps)
    with warnings.catch_warnings():  # a rollout that fails shows in the figures
        warnings.simplefilter("ignore", RuntimeWarning)
        motion = simulator.rollout(sequence.garment, part, **known)
    predicted = np.full((steps, *sequence.vertices.shape[1:]), np.nan, np.float32)
    moved = np.asarray(motion.vertices)[newest + 1 - first :]
    predicted[: len(moved)] = moved
    return predicted
