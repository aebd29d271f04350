"""Converts arguments of the simulator to one form: lists of garments and bodies, and arrays that are copies."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch

from warpgarment.errors import MeshError
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.status import RolloutStatus


def as_array(values: Any) -> np.ndarray:
    """Copies a tensor, array or nested list to a float32 array, so that the caller may reuse its own."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().numpy()
    return np.array(values, dtype=np.float32)


def packed_on(arrays: Sequence[np.ndarray], device: torch.device) -> torch.Tensor:
    """Arrays [*,3] end to end on a device; always a copy, so that callers may reuse their arrays.

    Copies to a GPU start from pinned memory; with other memory the host would wait for all earlier work.
    """
    packed = torch.from_numpy(np.concatenate(arrays).astype(np.float32, copy=False))
    return packed.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else packed


def listed(value: Any, kind: type) -> tuple[list, bool]:
    """Returns the argument as a list, and whether a single object was given.

    Args:
        value: An object of class `kind`, or a sequence of them.
        kind: The class.

    Raises:
        ValueError: The sequence is empty.
        TypeError: An object is of another class.
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
    """Returns a list with one object for each garment.

    Args:
        value: One object of class `kind` for all garments, or a sequence with one for each.
        kind: The class.
        count: Number of garments.
        name: Plural noun for the objects, for messages.

    Raises:
        ValueError: The sequence is empty, or its length is not `count`.
        TypeError: An object is of another class.
    """
    values, single = listed(value, kind)
    if single:
        return values * count
    if len(values) != count:
        raise ValueError(f"{count} garments and {len(values)} {name}; give one for each, or a single one for all")
    return values


def known_frames(
    garments: Sequence[Garment], single: bool, length: int, first_vertices: Any, history: Any
) -> np.ndarray:
    """The frames with which a simulation begins, packed: the rest positions, `first_vertices`, or a history.

    Args:
        garments: The batch.
        single: Whether the caller gave one garment, and so one array instead of a list.
        length: Number of frames H of a history.
        first_vertices: First frame of each garment [m], shape [V,3]; or None.
        history: First H frames of each garment [m], shape [H,V,3]; or None.

    Returns:
        Positions [m], float32 [K,V,3] with K = 1 or H.

    Raises:
        ValueError: Both are given, an array has another shape, or a list does not have one array for each garment.
        MeshError: Positions are not finite.
    """
    if first_vertices is not None and history is not None:
        raise ValueError("give first_vertices or history, not both: a history begins with the first frame")
    if first_vertices is None and history is None:
        return np.concatenate([garment.vertices for garment in garments])[None]
    frames: tuple[int, ...]
    name, given, frames = "history", history, (length,)
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


Layers: TypeAlias = bool | Sequence[Sequence[int]] | None


def outfits(layers: Layers, body_of_garment: Sequence[int]) -> list[list[int]]:
    """The outfits of a batch: lists of numbers of garments, innermost first.

    Args:
        layers: None or False for no outfit; True for one on each body, in the order of the batch; or the outfits.
        body_of_garment: Number of the body of each garment.

    Raises:
        ValueError: An outfit is empty, or names a garment that does not exist, is in an outfit already, or is on
            another body than the rest of the outfit.
    """
    if layers is None or layers is False:
        return []
    if layers is True:
        on_body: dict[int, list[int]] = {}
        for garment, body in enumerate(body_of_garment):
            on_body.setdefault(body, []).append(garment)
        return list(on_body.values())
    found = [[int(garment) for garment in outfit] for outfit in layers]
    seen: set[int] = set()
    for number, outfit in enumerate(found):
        if not outfit:
            raise ValueError(f"outfit {number} of layers is empty")
        for garment in outfit:
            if not 0 <= garment < len(body_of_garment):
                raise ValueError(f"layers name garment {garment}; there are {len(body_of_garment)}, from 0")
            if garment in seen:
                raise ValueError(f"layers name garment {garment} twice; a garment is worn in one outfit")
            seen.add(garment)
        if len({body_of_garment[garment] for garment in outfit}) > 1:
            raise ValueError(f"the garments {outfit} of outfit {number} are on different bodies; give them one")
    return found


def warn_of_crossing_start(garments: Sequence[Garment], first: Sequence[RolloutStatus]) -> None:
    """Warns by name of garments that cross in the first frame; only layers are moved apart later."""
    for number, (garment, status) in enumerate(zip(garments, first, strict=True)):
        layers, itself = status.layer_crossings or 0, status.self_crossings or 0
        if layers or itself:
            warnings.warn(
                f"{layers:,} pairs of triangles of {garment.name or f'garment {number}'} and other garments of its "
                f"outfit, and {itself:,} of its own, cross in the first frame. Layers are moved apart over the next "
                "frames, a garment that crosses itself is not. Start from garments that lie over each other, innermost "
                "first in layers",
                RuntimeWarning,
                stacklevel=4,
            )


def counted(frames: range, progress: bool) -> Any:
    """The numbers of the frames, with a progress bar if `progress` is set."""
    if not progress:
        return frames
    from tqdm import tqdm

    return tqdm(frames, desc="rollout", unit="frame")


def given_bodies(vertices: Any, faces: Any, count: int, fps: float) -> tuple[list[BodyMotion], list[int]]:
    """Bodies of one frame, and the number of the body of each garment.

    Args:
        vertices: Positions [m], shape [U,3], of one body for all garments; or a list with one for each.
        faces: Vertex indices, shape [G,3]; a list if `vertices` is one.
        count: Number of garments.
        fps: Frames per second.

    Raises:
        ValueError: Lists of other lengths.
        MeshError: The arrays are no body.
    """
    if isinstance(vertices, (list, tuple)):
        if len(vertices) != count or len(faces) != count:
            raise ValueError(
                f"{count} garments, {len(vertices)} bodies and {len(faces)} arrays of body faces; give one of each per "
                "garment, or one body for all"
            )
        on = list(range(count))
    else:
        vertices, faces, on = [vertices], [faces], [0] * count
    return [BodyMotion(as_array(v)[None], f, fps) for v, f in zip(vertices, faces, strict=True)], on


def next_bodies(vertices: Any, count: int, frame: int) -> list[np.ndarray]:
    """Bodies of the next frame [m], each float32 [U,3].

    Args:
        vertices: Positions of one body, or a list of them.
        count: Number of vertices of all bodies at the start.
        frame: Number of the frame, for messages.

    Raises:
        ValueError: The number of vertices is another one.
        MeshError: Positions are not finite.
    """
    arrays = [as_array(v) for v in (vertices if isinstance(vertices, (list, tuple)) else [vertices])]
    found = sum(len(array) for array in arrays)
    if found != count or any(array.shape[1:] != (3,) for array in arrays):
        raise ValueError(f"bodies had {count} vertices at the start, now there are {found}")
    if not all(np.isfinite(array).all() for array in arrays):
        raise MeshError(f"body_vertices of frame {frame} hold NaN or infinity; skip or repair the frame")
    return arrays
