"""Meshes in motion, by suffix."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.skinning import linear_blend_skinning

from .atomic import atomic_files, atomic_folder
from .mesh import READABLE, read_mesh, scale_of
from .npz import read_npz, write_npz
from .obj import obj_text, read_polygons
from .pc2 import read_pc2, write_pc2_to
from .polygons import triangulate
from .usd import SUFFIXES as USD_SUFFIXES

SKINNED = ("rest_vertices", "faces", "bone_indices", "bone_weights", "bone_transforms")
FRAME = "frame_*.obj"


class SequenceData(NamedTuple):
    """What a file of a moving mesh holds, in metres, unchecked beyond the format."""

    vertices: np.ndarray  # [T,V,3]
    faces: np.ndarray  # [F,3]
    fps: float | None = None
    collider_faces: np.ndarray | None = None


def read_sequence(path: Path, *, unit: str | None = None, mesh: str | None = None) -> SequenceData:
    """Reads a moving mesh as `BodyMotion.load` describes.

    Raises:
        MeshError: Not a file of its kind, cut short, or arrays that do not fit each other.
        FileNotFoundError: There is no such file.
    """
    path, scale = Path(path), scale_of(unit)
    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    suffix = path.suffix.lower()
    if path.is_dir():
        data = _read_folder(path)
    elif suffix == ".npz":
        data = _read_npz(path)
    elif suffix == ".pc2":
        data = _read_pc2(path)
    elif suffix in USD_SUFFIXES:
        from .usd import read_usd

        found = read_usd(path, mesh=mesh, convert=unit is None)
        data = SequenceData(found.vertices, found.faces, found.fps)
    elif suffix in READABLE:
        single = read_mesh(path, expect_garment=False)
        data = SequenceData(np.asarray(single.vertices)[None], single.faces)
    else:
        raise MeshError(
            f"{path}: cannot read {suffix}; use .npz, .pc2, {', '.join(USD_SUFFIXES)}, a folder of .obj, or a mesh."
        )
    return data if scale == 1.0 else data._replace(vertices=np.asarray(data.vertices, dtype=np.float64) * scale)


def _read_npz(path: Path) -> SequenceData:
    arrays = read_npz(path, required=("faces",))
    if "vertices" in arrays:
        vertices = arrays["vertices"]
        vertices = vertices[None] if vertices.ndim == 2 else vertices
    else:
        missing = [key for key in SKINNED if key not in arrays]
        if missing:
            raise MeshError(
                f"{path}: neither 'vertices' nor {missing[0]!r} in it; it holds {', '.join(sorted(arrays))}."
            )
        try:
            vertices = linear_blend_skinning(*(arrays[k] for k in ("rest_vertices", *SKINNED[2:])))
        except MeshError as error:
            raise MeshError(f"{path}: {error}") from None
    try:
        fps = float(arrays["fps"]) if "fps" in arrays else None
    except (TypeError, ValueError):
        raise MeshError(f"{path}: fps must be a single number.") from None
    return SequenceData(vertices, arrays["faces"], fps, arrays.get("collider_faces"))


def _read_pc2(path: Path) -> SequenceData:
    beside = [path.with_suffix(suffix) for suffix in (".obj", ".ply")]
    mesh = next((candidate for candidate in beside if candidate.exists()), None)
    if mesh is None:
        raise MeshError(
            f"{path}: a point cache has no faces; put {beside[0].name}, with the same vertex order, beside it."
        )
    vertices, rest = read_pc2(path), read_mesh(mesh, expect_garment=False)
    if len(rest.vertices) != vertices.shape[1]:
        raise MeshError(f"{path} has {vertices.shape[1]:,} points and {mesh.name} {len(rest.vertices):,} vertices.")
    return SequenceData(vertices, rest.faces)


def _read_folder(path: Path) -> SequenceData:
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
    return SequenceData(np.stack(frames).astype(np.float32), triangulate(first, polygons))


def write_sequence(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    fps: float,
    *,
    name: str,
    extra: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Writes vertices [T,V,3] and faces [F,3] as `GarmentMotion.save` describes, completely or not at all.

    Args:
        path: .npz, .usd, .usda, .usdc, .pc2, or a folder without a suffix.
        vertices: Positions [m].
        faces: Indices.
        fps: Frames per second; .pc2 and .obj cannot keep it.
        name: Of the mesh inside the file.
        extra: More arrays for .npz.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        write_npz(path, {"vertices": vertices, "faces": faces, "fps": np.array(fps, dtype=np.float64), **(extra or {})})
    elif suffix in USD_SUFFIXES[:3]:
        from .usd import write_usd

        write_usd(path, [(name, vertices, faces)], fps)
    elif suffix == ".pc2":
        with atomic_files(path.with_suffix(".obj"), path) as (mesh, cache):
            mesh.write_text(obj_text(vertices[0], faces, name), encoding="utf-8")
            write_pc2_to(cache, vertices)
    elif suffix == "":
        digits = max(4, len(str(len(vertices) - 1)))
        with atomic_folder(path, FRAME) as folder:
            for frame, positions in enumerate(vertices):
                text = obj_text(positions, faces, name)
                (folder / f"frame_{frame:0{digits}d}.obj").write_text(text, encoding="utf-8")
    else:
        raise ValueError(f"cannot write {suffix}; use .npz, .usd, .usda, .usdc, .pc2, or a folder without a suffix")
