"""STL, read by trimesh; vertices, which it repeats for every face, are joined where they are at the same place."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError

from .data import Format, MeshData, ReadOptions
from .joined import join_exact


def read_stl(path: Path, options: ReadOptions) -> MeshData:
    """A text or binary STL.

    Raises:
        MeshError: Not a file of its kind, cut short, or without triangles.
    """
    import trimesh

    try:
        loaded = trimesh.load_scene(path, process=False).to_mesh()
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    except Exception as error:  # readers of foreign formats fail in every way there is
        raise MeshError(
            f"{path}: not a readable .stl file ({type(error).__name__}: {error}). "
            "It is damaged, cut short, or of another kind."
        ) from None
    if len(faces) == 0:
        raise MeshError(f"{path}: no triangles in it; it is damaged, cut short, or a point cloud.")
    if _is_cut_short(path):
        raise MeshError(f"{path}: starts with solid and never ends with endsolid; it is cut short.")
    kept, faces = join_exact(vertices, faces)
    return MeshData(vertices[kept], faces)


def _is_cut_short(path: Path) -> bool:
    """Whether a text STL lacks its last line; a binary one may start with solid too, but holds zeros."""
    data = path.read_bytes()
    return data.lstrip().startswith(b"solid") and b"\0" not in data and b"endsolid" not in data[-512:]


FORMAT = Format(read_mesh=read_stl)
