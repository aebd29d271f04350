"""What users hand to the simulator, brought into one form: lists of garments and bodies, arrays that are copies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from warpgarment.errors import MeshError
from warpgarment.objects.garment import Garment


def as_array(values: Any) -> np.ndarray:
    """Anything array-like as a float32 copy, so that callers may reuse theirs."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().numpy()
    return np.array(values, dtype=np.float32)


def listed(value: Any, kind: type) -> tuple[list, bool]:
    """A list of what is one or several of a kind, and whether it was one.

    Raises:
        ValueError: An empty list.
        TypeError: Another kind.
    """
    if isinstance(value, kind):
        return [value], True
    values = list(value)
    if not values:
        raise ValueError(f"an empty list, expected at least one {kind.__name__}")
    for item in values:
        if not isinstance(item, kind):
            raise TypeError(f"expected {kind.__name__}, got {type(item).__name__}")
    return values, False


def per_garment(value: Any, kind: type, count: int, name: str) -> list:
    """One for each garment, of what is one for all or a list.

    Raises:
        ValueError, TypeError: As `listed`, and lists of another length.
    """
    values, single = listed(value, kind)
    if single:
        return values * count
    if len(values) != count:
        raise ValueError(f"{count} garments and {len(values)} {name}; give one for each, or a single one for all")
    return values


def known_frames(
    garments: Sequence[Garment], single: bool, first_vertices: Any, history: Any, history_length: int
) -> np.ndarray:
    """Frames that a simulation begins with, packed: the rest positions, `first_vertices`, or a history.

    Args:
        garments: The batch.
        single: Whether the caller gave one garment, and so one array, not a list.
        first_vertices: One frame [V,3] per garment, or None.
        history: [H,V,3] per garment, or None.
        history_length: H.

    Returns:
        float32 [K,V,3] with K = 1 or H.

    Raises:
        ValueError: Both, other shapes, or lists of another length than the batch.
        MeshError: Positions that are not finite.
    """
    if first_vertices is not None and history is not None:
        raise ValueError("give first_vertices or history, not both: a history begins with the first frame")
    if first_vertices is None and history is None:
        return np.concatenate([garment.vertices for garment in garments])[None]
    frames: tuple[int, ...]
    name, given, frames = "history", history, (history_length,)
    if history is None:
        name, given, frames = "first_vertices", first_vertices, ()
    arrays = [given] if single else list(given)
    if len(arrays) != len(garments):
        raise ValueError(f"{len(garments)} garments and {len(arrays)} arrays in {name}; give one for each")
    parts = []
    for number, (array, garment) in enumerate(zip(arrays, garments, strict=True)):
        array = as_array(array)
        wanted = (*frames, len(garment.vertices), 3)
        if array.shape != wanted:
            raise ValueError(f"{name} of garment {number} must have shape {list(wanted)}, got {list(array.shape)}")
        if not np.isfinite(array).all():
            raise MeshError(f"{name} of garment {number} holds NaN or infinity; repair what wrote it")
        parts.append(array.reshape(-1, len(garment.vertices), 3))
    return np.concatenate(parts, axis=1)


def counted(frames: range, progress: bool) -> Any:
    """The frames, with a progress bar if wanted."""
    if not progress:
        return frames
    from tqdm import tqdm

    return tqdm(frames, desc="rollout", unit="frame")
