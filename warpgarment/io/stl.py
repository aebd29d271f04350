"""STL, read by trimesh; vertices, which it repeats for every face, are joined where they are at the same place."""

from __future__ import annotations

import os
import struct
from io import BytesIO
from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import open_plain, read_plain

from .data import Format, MeshData, ReadOptions
from .joined import join_exact


def read_stl(path: Path, options: ReadOptions) -> MeshData:
    """A text or binary STL.

    Raises:
        MeshError: Not a file of its kind, cut short, or without triangles.
    """
    import trimesh

    data = _data(path)

    try:
        loaded = trimesh.load_scene(BytesIO(data), file_type="stl", process=False).to_mesh()
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    except Exception as error:  # readers of foreign formats fail in every way there is
        raise MeshError(
            f"{path}: not a readable .stl file ({type(error).__name__}: {error}). "
            "It is damaged, cut short, or of another kind."
        ) from None
    if len(faces) == 0:
        raise MeshError(f"{path}: no triangles in it; it is damaged, cut short, or a point cloud.")
    if _is_cut_short(data):
        raise MeshError(f"{path}: starts with solid and never ends with endsolid; it is cut short.")
    kept, faces = join_exact(vertices, faces)
    return MeshData(vertices[kept], faces)


def _data(path: Path) -> bytes:
    """The bytes of the file, after a look at its beginning: the number of triangles of a binary one gives its size."""
    with open_plain(path) as file:
        head, size = file.read(84), os.fstat(file.fileno()).st_size
    needed = 84 + 50 * struct.unpack_from("<I", head, 80)[0] if len(head) == 84 else -1
    if size != needed and not head.lstrip().startswith(b"solid"):
        raise MeshError(
            f"{path}: not a readable .stl file ({size:,} bytes where its header says {max(needed, 84):,}). "
            "It is damaged, cut short, or of another kind."
        )
    return read_plain(path, text=size != needed)


def _is_cut_short(data: bytes) -> bool:
    """Whether a text STL lacks its last line; a binary one may start with solid too, but holds zeros."""
    return data.lstrip().startswith(b"solid") and b"\0" not in data and b"endsolid" not in data[-512:]


FORMAT = Format(read_mesh=read_stl)
