"""Readers of motion files under the names that scripts know from before they were the library's: see `bodies`."""

from __future__ import annotations

from pathlib import Path

from warpgarment.bodies import amass, bvh
from warpgarment.bodies.clip import Clip


def read_bvh(path: str | Path, up: str | None = None) -> Clip:
    """A BVH file: `warpgarment.bodies.bvh.read_bvh`."""
    return bvh.read_bvh(path, up)


def bvh_length(path: str | Path) -> tuple[int, float]:
    """Number of frames and rate of a BVH file: `warpgarment.bodies.bvh.bvh_length`."""
    return bvh.bvh_length(path)


def read_amass(path: str | Path, up: str = "z") -> Clip:
    """An AMASS file: `warpgarment.bodies.amass.read_amass`."""
    return amass.read_amass(path, up)
