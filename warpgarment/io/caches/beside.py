"""The mesh beside a cache of positions: its faces and looks, which a cache cannot hold."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.data import Holds, MotionData, ReadOptions
from warpgarment.io.disk.atomic import atomic_files
from warpgarment.io.obj import chosen_polygons, obj_holds, read_polygons, surface_of
from warpgarment.io.parts import unnamed
from warpgarment.io.ply import read_ply
from warpgarment.io.polygons import triangulate_counts
from warpgarment.io.surface.obj import OBJ_KEEPS, obj_files
from warpgarment.io.surface.record import Surface, say_left_out

FAR = 2.0  # how much an edge is stretched, beyond which it is another one


class Covered(NamedTuple):
    """Positions [T,V,3] of a cache with faces [F,3] and surface of the mesh beside it."""

    vertices: np.ndarray
    faces: np.ndarray
    surface: Surface | None


def covered(path: Path, positions: np.ndarray, options: ReadOptions) -> Covered:
    """Positions of a cache, with the faces of the mesh of the same name beside it.

    Args:
        path: The cache.
        positions: What it holds [T,V,3].
        options: Names the object of the mesh.

    Raises:
        MeshError: There is no mesh, it is damaged, or has another number of vertices.
    """
    mesh = mesh_of(path)
    if mesh.suffix.lower() == ".ply":
        unnamed(path, options.mesh)
        ply = read_ply(mesh)
        rest, faces, surface = ply.vertices, ply.faces, ply.surface
        count, used = len(rest), np.arange(len(rest))
    else:
        found = read_polygons(mesh)
        used, rest, counts, corners = chosen_polygons(mesh, found, options.mesh)
        count, faces = len(found.vertices), triangulate_counts(rest, counts, corners)
        surface = surface_of(mesh, found, options.mesh, used)
    if count != positions.shape[1]:
        raise MeshError(f"{path} has {positions.shape[1]:,} points and {mesh.name} {count:,} vertices.")
    vertices = positions[:, used]
    _warn_about_order(path, mesh, rest, vertices[0], faces)
    return Covered(vertices, faces, surface)


def mesh_of(path: Path) -> Path:
    """The mesh beside a cache.

    Raises:
        MeshError: There is none.
    """
    beside = [path.with_suffix(suffix) for suffix in (".obj", ".OBJ", ".ply", ".PLY")]
    mesh = next((candidate for candidate in beside if candidate.exists()), None)
    if mesh is None:
        raise MeshError(
            f"{path}: a point cache has no faces; put {path.stem}.obj, with the same vertex order, beside it."
        )
    return mesh


def write_covered(path: Path, data: MotionData, write: Callable[[Path], None]) -> None:
    """Writes a cache, and its first frame as .obj of the same name beside it, which holds what a cache cannot.

    Args:
        path: The cache.
        data: The motion.
        write: Function that writes the cache to exactly the path that it is given.
    """
    say_left_out(path, data.surface, sets=1, keeps=OBJ_KEEPS)
    texts = obj_files(path.with_suffix(".obj"), data.vertices[0], data.faces, data.name, data.surface)
    with atomic_files(*texts, path) as (*files, cache):
        for file, text in zip(files, texts.values(), strict=True):
            file.write_text(text, encoding="utf-8")
        write(cache)


def holds_beside(path: Path) -> Holds:
    """Objects of the .obj beside a cache."""
    beside = next((p for p in (path.with_suffix(".obj"), path.with_suffix(".OBJ")) if p.exists()), None)
    return obj_holds(beside) if beside else Holds()


def _warn_about_order(path: Path, mesh: Path, rest: np.ndarray, first: np.ndarray, faces: np.ndarray) -> None:
    """Warns where the edges of the first frame are far from those of the mesh, as they are in another order.

    What the two have in common is looked for in the ratios of lengths: cloth and skin stretch by some per cent, and a
    unit changes all of them alike.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    before, after = (np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (rest.astype(float), first))
    real = (before > 0) & np.isfinite(after)
    if not real.any():
        return
    ratio = after[real] / before[real]
    middle = float(np.median(ratio))
    odd = (ratio > FAR * middle) | (ratio < middle / FAR)
    if middle == 0 or odd.mean() > 0.2:
        warnings.warn(
            f"{path}: {np.count_nonzero(odd):,} of {len(ratio):,} edges have another length in the first frame than in "
            f"{mesh.name}, by more than a factor of {FAR:g}: its vertices seem to be in another order.",
            UserWarning,
            stacklevel=7,
        )
