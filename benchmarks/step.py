"""Whole frames: a rollout of the bundled dress, and of several at once, by stage."""

from __future__ import annotations

import time
from collections.abc import Iterator

import torch

from warpgarment.simulator import Simulator

from .scenes import dressed

FRAMES = 16


def rows(faces: int, device: torch.device, weights: str) -> Iterator[dict]:
    """Milliseconds per frame, together and by stage, for 1, 2 and 4 face splits, and per garment in a batch of four."""
    scene = dressed(faces)
    simulator = Simulator.from_pretrained(weights, device=device)
    simulator.timings.synchronise = True
    count = len(scene.garment.faces)

    def frame_ms(number: int, splits: int) -> float:
        garments, firsts = [scene.garment] * number, [scene.first] * number
        simulator.rollout(garments, scene.body, first_vertices=firsts, frames=3, face_splits=splits)
        simulator.timings.clear()
        # the difference of two lengths leaves out what happens once per rollout
        spent = []
        for frames in (3, 3 + FRAMES):
            began = time.perf_counter()
            simulator.rollout(garments, scene.body, first_vertices=firsts, frames=frames, face_splits=splits)
            spent.append(time.perf_counter() - began)
        return 1e3 * (spent[1] - spent[0]) / FRAMES

    for splits in (1, 2, 4):
        together = frame_ms(1, splits)
        yield {"faces": count, "stage": f"whole frame, {splits} face splits", "ms": together}
        if splits == 1:
            steps = 4 + FRAMES
            for stage, seconds in simulator.timings.items():
                yield {"faces": count, "stage": f"  of which {stage}", "ms": 1e3 * seconds / steps}
    yield {"faces": count, "stage": "whole frame per garment, batch of 4", "ms": frame_ms(4, 1) / 4}
