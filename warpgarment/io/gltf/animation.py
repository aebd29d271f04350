"""Nodes of a glTF scene over time: keyframes of translations, rotations, scales and weights of morph targets."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from .container import Document
from .schema import ANIMATION, Damaged

SIZES = {"translation": 3, "rotation": 4, "scale": 3}
DEFAULTS = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}


class Channels:
    """The keyframes of an animation, by node and what they move.

    Args:
        document: The file.
        where: Its path, for messages.
    """

    def __init__(self, document: Document, where: object):
        self._keys: dict[tuple[int, str], tuple[np.ndarray, np.ndarray, str]] = {}
        animations = document.json.get("animations", [])
        if not isinstance(animations, list):
            raise Damaged("animations is no list")
        if len(animations) > 1:
            names = ", ".join(str(a.get("name", k)) for k, a in enumerate(animations[:8]) if isinstance(a, dict))
            warnings.warn(
                f"{where}: {len(animations)} animations ({names}); the first is read.", UserWarning, stacklevel=6
            )
        if not animations:
            return
        animation = document.item("animations", 0)
        ANIMATION("animations[0]", animation)
        for channel in animation["channels"]:
            target = channel["target"]
            if "node" in target:
                document.item("nodes", target["node"])
            if "node" not in target or target["path"] not in (*SIZES, "weights"):
                continue
            if channel["sampler"] >= len(animation["samplers"]):
                raise Damaged(f"an animation has no sampler {channel['sampler']}")
            sampler = animation["samplers"][channel["sampler"]]
            times = document.array(sampler["input"]).astype(np.float64)
            values = document.array(sampler["output"]).astype(np.float64)
            if times.ndim != 1 or len(times) == 0 or not (np.diff(times) > 0).all() or not np.isfinite(times).all():
                raise Damaged("the times of an animation do not rise")
            kind = sampler.get("interpolation", "LINEAR")
            rows = len(times) * (3 if kind == "CUBICSPLINE" else 1)
            if values.size == 0 or values.size % rows:
                raise Damaged(f"{values.size} values of an animation at {len(times)} times")
            values = values.reshape(rows, -1)
            if target["path"] in SIZES and values.shape[1] != SIZES[target["path"]]:
                raise Damaged(f"an animation's {target['path']} has {values.shape[1]} values")
            self._keys[target["node"], target["path"]] = (times, values, kind)

    def times(self) -> np.ndarray:
        """Times of all keyframes [s], sorted; those that differ by rounding are one."""
        if not self._keys:
            return np.zeros(0)
        times = np.unique(np.concatenate([times for times, _, _ in self._keys.values()]))
        return times[np.diff(times, prepend=-np.inf) > 1e-4]

    def values(self, node: int, path: str, times: np.ndarray) -> np.ndarray | None:
        """Values [T,width] at some times; None where the animation does not move this."""
        if (node, path) not in self._keys:
            return None
        keys, values, kind = self._keys[node, path]
        if kind == "CUBICSPLINE":
            return _normal(_spline(keys, values.reshape(len(keys), 3, -1), times), path)
        before = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 1)
        if kind == "STEP" or len(keys) == 1:
            return values[before]
        before = np.minimum(before, len(keys) - 2)
        share = np.clip((times - keys[before]) / (keys[before + 1] - keys[before]), 0.0, 1.0)[:, None]
        if path == "rotation":
            return _slerp(values[before], values[before + 1], share)
        return values[before] * (1 - share) + values[before + 1] * share


def _slerp(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Rotations between unit quaternions [T,4], along the shorter arc."""
    cosine = (a * b).sum(axis=1, keepdims=True)
    b, cosine = np.where(cosine < 0, -b, b), np.minimum(np.abs(cosine), 1.0)
    angle = np.arccos(cosine)
    sine = np.maximum(np.sin(angle), 1e-12)
    near = angle < 1e-6
    first = np.where(near, 1 - share, np.sin((1 - share) * angle) / sine)
    return _normal(first * a + np.where(near, share, np.sin(share * angle) / sine) * b, "rotation")


def _spline(keys: np.ndarray, values: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Cubic Hermite splines; values [K,3,width] are the tangent in, the value and the tangent out of each key."""
    if len(keys) == 1:
        return np.broadcast_to(values[:1, 1], (len(times), values.shape[2]))
    k = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 2)
    span = (keys[k + 1] - keys[k])[:, None]
    t = np.clip((times[:, None] - keys[k][:, None]) / span, 0.0, 1.0)
    return (
        (2 * t**3 - 3 * t**2 + 1) * values[k, 1]
        + span * (t**3 - 2 * t**2 + t) * values[k, 2]
        + (3 * t**2 - 2 * t**3) * values[k + 1, 1]
        + span * (t**3 - t**2) * values[k + 1, 0]
    )


def _normal(values: np.ndarray, path: str) -> np.ndarray:
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12) if path == "rotation" else values


def local_matrices(node: dict[str, Any], number: int, channels: Channels, times: np.ndarray) -> np.ndarray:
    """Transforms of a node in its parent's space [T,4,4], or [1,4,4] where it does not move."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(1, 4, 4).transpose(0, 2, 1)
    parts = {}
    for path, default in DEFAULTS.items():
        moved = channels.values(number, path, times)
        still = np.array(node.get(path, default), dtype=np.float64).reshape(1, SIZES[path])
        parts[path] = still if moved is None else moved
    x, y, z, w = parts["rotation"].T
    turn = np.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ], axis=-1).reshape(-1, 3, 3)  # fmt: skip
    count = max(map(len, parts.values()))
    matrices = np.zeros((count, 4, 4))
    matrices[:, :3, :3] = turn * parts["scale"][:, None, :]
    matrices[:, :3, 3] = parts["translation"]
    matrices[:, 3, 3] = 1.0
    return matrices
