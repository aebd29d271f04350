"""BVH files as moving bodies. What reads them is loaded for those alone."""

from __future__ import annotations

from pathlib import Path

from warpgarment.io.data import Format, MotionData, ReadOptions


def _read(path: Path, options: ReadOptions) -> MotionData:
    from .moved import from_bvh

    return from_bvh(path, options)


FORMAT = Format(read_motion=_read, axis=True, bones=True)
