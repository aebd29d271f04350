"""Means of rollouts, over the sequences that stayed finite; the others are counted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from .figures import OF_FRAMES

Rollout = dict[str, Any]


def means(rollouts: Iterable[Rollout], garment: Callable[[int, list[str]], bool] | None = None) -> dict[str, Any]:
    """The means of rollouts.

    Args:
        rollouts: Rollouts of one row.
        garment: Which garments count for the error, by number and the categories of the outfit; None: all.

    Returns:
        `sequences`, `failed`, `frames`; `error_mm`, `spread_mm` (standard deviation) and `garments`, their number, over
        garments; each of `OF_FRAMES` as the mean over sequences, NaN if none has it; `ms`, time of a frame.
    """
    rollouts = list(rollouts)
    good = [r for r in rollouts if r["finite"]]
    errors = [
        error
        for r in good
        for k, error in enumerate(r["error_mm"])
        if garment is None or garment(k, r["garments"])
    ]  # fmt: skip
    frames, seconds = sum(r["frames"] for r in rollouts), sum(r["seconds"] for r in rollouts)
    result: dict[str, Any] = {"sequences": len(rollouts), "failed": len(rollouts) - len(good), "frames": frames}
    result |= {"garments": len(errors), "error_mm": _mean(errors), "ms": 1000.0 * seconds / frames if frames else None}
    result["spread_mm"] = float(np.std(errors)) if errors else math.nan
    return result | {key: _mean([r[key] for r in good if r[key] is not None]) for key in OF_FRAMES}


def beside(rollouts: list[Rollout], others: list[Rollout]) -> float:
    """Mean error of rollouts as a share of that of others, over the sequences in which both stayed finite."""
    other = {r["sequence"]: r["error_mm"] for r in others if r["finite"]}
    both = [(r["error_mm"], other[r["sequence"]]) for r in rollouts if r["finite"] and r["sequence"] in other]
    if not both:
        return math.nan
    ours, theirs = (np.concatenate(errors).mean() for errors in zip(*both, strict=True))
    return float(ours / theirs) if theirs > 0.0 else math.nan


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else math.nan
