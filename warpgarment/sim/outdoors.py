"""Converts materials and wind, as users give them, to the inputs of networks that read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, fields
from typing import Any

import numpy as np
import torch

from warpgarment.nn import checkpoint
from warpgarment.nn.network import GarmentNetwork
from warpgarment.objects.material import Material
from warpgarment.objects.wind import FASTEST, Wind, too_fast

from .arguments import as_array, packed_on

Materials = Material | Sequence[Material | None] | None


def as_materials(
    materials: Materials, count: int, network: GarmentNetwork, device: torch.device
) -> torch.Tensor | None:
    """Materials as a tensor.

    Args:
        materials: One material for all garments; a sequence with one, or None, for each garment; or None.
        count: Number of garments B.
        network: The network that is to read them.
        device: Device of the result.

    Returns:
        The fields of the materials, float32 [B,M], NaN for a garment without one; None if None is given.

    Raises:
        ValueError: The network reads no materials, or a sequence has another length.
        TypeError: An entry is no material.
    """
    if materials is None:
        return None
    refuse(network, "materials")
    given = [materials] * count if isinstance(materials, Material) else list(materials)
    if len(given) != count:
        raise ValueError(f"{count} garments and {len(given)} materials; give one for each, or a single one for all")
    for item in given:
        if not isinstance(item, Material | None):
            raise TypeError(f"expected a Material or None, got {type(item).__name__}")
    unknown = (np.nan,) * len(fields(Material))
    rows = [unknown if item is None else astuple(item) for item in given]
    return torch.tensor(rows, dtype=torch.float32, device=device)


def as_wind(wind: Any, count: int, network: GarmentNetwork, *, frame: int | None = None) -> np.ndarray | None:
    """Wind as an array.

    Args:
        wind: A `Wind`; or velocity of the air [m/s], shape [3], [T,3], or [T,B,3] with one for each garment; or None.
        count: Number of garments B.
        network: The network that is to read it.
        frame: Number of the only frame that is wanted, of which an array then has to be; None for all frames.

    Returns:
        Velocities [m/s], float32 [T,B,3]; None if None is given.

    Raises:
        ValueError: The network reads no wind; the shape is another one; a number is not finite; or the air is faster
            than 100 m/s.
    """
    if wind is None:
        return None
    refuse(network, "wind")
    if isinstance(wind, Wind):
        blown = wind.velocities(network.config.fps)[:, None]
        blown = blown if frame is None else blown[[min(frame, len(blown) - 1)]]
        return np.repeat(blown, count, axis=1)
    given = as_array(wind)
    shape, given = given.shape, given[None] if given.ndim == 1 else given
    if given.ndim == 2:
        given = given[:, None]
    if given.ndim != 3 or not len(given) or given.shape[1] not in (1, count) or given.shape[2] != 3:
        raise ValueError(f"wind must have shape [3], [T,3] or [T,{count},3], got {list(shape)}")
    if frame is not None and len(given) != 1:
        raise ValueError(f"wind of one frame must have shape [3] or [1,{count},3], got {len(given)} frames")
    speed = np.linalg.norm(given, axis=-1)
    if not np.isfinite(given).all():
        raise ValueError(f"wind holds NaN or infinity (first: frame {int(np.argwhere(~np.isfinite(speed))[0, 0])})")
    if speed.max() > FASTEST:
        raise ValueError(too_fast(speed))
    return np.array(np.broadcast_to(given, (len(given), count, 3)), np.float32)


def air_of(wind: np.ndarray | None, frame: int, device: torch.device) -> torch.Tensor | None:
    """The wind of a frame [m/s], shape [B,3], of the result of `as_wind`; the last one holds on."""
    return None if wind is None else packed_on(list(wind[[min(frame, len(wind) - 1)]]), device)


def refuse(network: GarmentNetwork, name: str) -> None:
    """Raises ValueError if a network does not read an input that was given."""
    if name in network.reads:
        return
    shipped = [known for known, reads in checkpoint.shipped_reads().items() if name in reads]
    ships = f"; of those that ship, {', '.join(shipped)}" if shipped else ""
    raise ValueError(
        f"{name} given, but this {type(network).__name__} reads none. A LayersNet does, and so does a network trained "
        f"with the setting outdoor{ships}"
    )
