"""BVH files as moving bodies."""

from __future__ import annotations

from warpgarment.io.data import Format

from .moved import from_bvh

FORMAT = Format(read_motion=from_bvh, axis=True, bones=True)
