"""Formats that repeat vertices, for every face (STL) or at texture seams (glTF): read by trimesh, and joined again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError

from .data import Format, MeshData, ReadOptions


def read_joined(path: Path, options: ReadOptions) -> MeshData:
    """All meshes of a file as one, vertices at exactly the same place joined.

    Raises:
        MeshError: Not a file of its kind, cut short, or without triangles.
    """
    import trimesh

    suffix = path.suffix.lower()
    try:
        loaded = trimesh.load_scene(path, process=False).to_mesh()
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    except Exception as error:  # readers of foreign formats fail in every way there is
        raise MeshError(
            f"{path}: not a readable {suffix} file ({type(error).__name__}: {error}). "
            "It is damaged, cut short, or of another kind."
        ) from None
    if len(faces) == 0:
        raise MeshError(f"{path}: no triangles in it; it is damaged, cut short, or a point cloud.")
    if suffix == ".stl" and _is_cut_short(path):
        raise MeshError(f"{path}: starts with solid and never ends with endsolid; it is cut short.")
    return MeshData(*join_exact(vertices, faces))


def _is_cut_short(path: Path) -> bool:
    """Whether a text STL lacks its last line; a binary one may start with solid too, but holds zeros."""
    data = path.read_bytes()
    return data.lstrip().startswith(b"solid") and b"\0" not in data and b"endsolid" not in data[-512:]


def join_exact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joins vertices [V,3] at exactly the same place, keeping the order of first appearance.

    Returns:
        The vertices that stay, and the faces [F,3] that name them.
    """
    first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)[1:]
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return vertices[np.sort(first)], rank[inverse.reshape(-1)][faces]


FORMAT = Format(read_mesh=read_joined)
