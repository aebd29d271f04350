"""Training runs that take seconds, and readers of their logs."""

from __future__ import annotations

import json
from pathlib import Path

from warpgarment.training.samples.noise import NoiseConfig
from warpgarment.training.samples.pushforward import PushforwardConfig
from warpgarment.training.train.config import TrainConfig

SHAPE = ("embedding=16", "layers=1", "feed_forward=16", "heads=2", "geodesic_radius=0.2")


def config_for(data: Path, out: Path, **changes) -> TrainConfig:
    """The configuration of a run of twelve steps with dropout, noise, a pool, and validation and saves in between."""
    settings = {
        "steps": 12, "batch_size": 4, "overrides": (*SHAPE, "dropout=0.1"), "validate_every": 8, "validate_frames": 3,
        "save_every": 4, "log_every": 1, "statistics_batches": 2, "device": "cpu", "threads": 1,
        "pushforward": PushforwardConfig(every=5, rollouts=2, steps=2, share=0.5), "noise": NoiseConfig(features=0.01),
    }  # fmt: skip
    return TrainConfig(data=data, out=out, **(settings | changes))


def entries_of(out: Path) -> list[dict]:
    """Entries of the log that have a loss."""
    entries = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [entry for entry in entries if "loss" in entry]


def losses_of(out: Path) -> dict[int, float]:
    """Loss by step; fails if a step occurs twice."""
    losses = {entry["step"]: entry["loss"] for entry in entries_of(out)}
    assert len(losses) == len(entries_of(out))
    return losses


SETTINGS = {"overrides": (*SHAPE, "dropout=0.0"), "noise": NoiseConfig(), "log_every": 1}
