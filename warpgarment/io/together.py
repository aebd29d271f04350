"""Several meshes in one file, for the formats that hold them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .surface.record import Surface, say_left_out

TOGETHER = (".usd", ".usda", ".usdc", ".abc")
"""Formats of which one file holds several meshes."""


def write_together(
    path: Path,
    meshes: Sequence[tuple[str, np.ndarray, np.ndarray]],
    fps: float,
    surfaces: Sequence[Surface | None],
    *,
    start: float = 0.0,
) -> None:
    """Writes meshes in motion as one file, each by its name.

    Args:
        path: The file, with a suffix of `TOGETHER`.
        meshes: Name, vertices [T,V,3] in metres and faces [F,3] of each; the same T for all.
        fps: Frames per second.
        surfaces: What is written of each mesh instead of its triangles; None: nothing.
        start: Number of the first frame.

    Raises:
        MeshError, MissingExtra, OutputError: As of the format.
    """
    if path.suffix.lower() == ".abc":
        from .alembic import KEEPS, write_alembic

        for surface in surfaces:
            say_left_out(path, surface, sets=1, keeps=KEEPS)
        write_alembic(path, meshes, fps, surfaces, start=start / fps)
        return
    from .usd import write_usd

    write_usd(path, meshes, fps, surfaces, start=start)
