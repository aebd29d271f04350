"""Folders of OBJ files, one a frame, with the same faces."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError

from .atomic import atomic_folder
from .data import Format, MotionData, ReadOptions
from .obj import obj_text, read_polygons
from .polygons import triangulate

FRAME = "frame_*.obj"


def read_folder(path: Path, options: ReadOptions) -> MotionData:
    """The frames of a folder, in the order of the numbers in their names.

    Raises:
        MeshError: No .obj files, one that cannot be read, or frames of different topology.
    """
    files = sorted(
        path.glob("*.obj"), key=lambda file: [int(n) if n.isdigit() else n for n in re.split(r"(\d+)", file.name)]
    )
    if not files:
        raise MeshError(f"{path}: no .obj files in this folder.")
    first, polygons = read_polygons(files[0])
    frames = [first]
    for file in files[1:]:
        vertices, same = read_polygons(file)
        if vertices.shape != first.shape or same != polygons:
            raise MeshError(
                f"{file}: {len(vertices):,} vertices and {len(same):,} faces, unlike {files[0].name} with "
                f"{len(first):,} and {len(polygons):,}, or in another order. All frames must share one topology."
            )
        frames.append(vertices)
    return MotionData(np.stack(frames).astype(np.float32), triangulate(first, polygons))


def write_folder(path: Path, data: MotionData) -> None:
    """Writes frame_0000.obj, frame_0001.obj, ...; a folder that holds nothing else is replaced."""
    digits = max(4, len(str(len(data.vertices) - 1)))
    with atomic_folder(path, FRAME) as folder:
        for frame, positions in enumerate(data.vertices):
            text = obj_text(positions, data.faces, data.name)
            (folder / f"frame_{frame:0{digits}d}.obj").write_text(text, encoding="utf-8")


FORMAT = Format(read_motion=read_folder, write_motion=write_folder)
