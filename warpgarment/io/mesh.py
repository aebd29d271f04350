"""Single meshes, by suffix."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from warpgarment.errors import MeshError

from .atomic import atomic_file
from .npz import read_npz, write_npz
from .obj import read_obj, write_obj
from .ply import read_ply
from .usd import SUFFIXES as USD_SUFFIXES

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}
JOINED = (".stl", ".glb", ".gltf")  # formats that repeat vertices
READABLE = (".obj", ".ply", ".npz", *JOINED, *USD_SUFFIXES)
BIGGEST, SMALLEST = 10.0, 0.05  # sizes [m] beyond which a garment's unit is probably another


class MeshData(NamedTuple):
    """What a mesh file holds, in metres, unchecked."""

    vertices: np.ndarray
    faces: np.ndarray
    pins: np.ndarray | None = None
    name: str = ""


def scale_of(unit: str | None) -> float:
    """Metres in a unit; 1 for None.

    Raises:
        ValueError: An unknown unit.
    """
    if unit is None:
        return 1.0
    if unit not in UNITS:
        raise ValueError(f"unit must be one of {', '.join(UNITS)}, got {unit!r}")
    return UNITS[unit]


def read_mesh(path: Path, *, unit: str | None = None, mesh: str | None = None, expect_garment: bool = True) -> MeshData:
    """Reads a mesh as `Garment.load` describes; the arrays are not checked beyond the format.

    Args:
        path: The file.
        unit: See `Garment.load`.
        mesh: See `Garment.load`.
        expect_garment: Warn about sizes that no garment has.

    Raises:
        MeshError: Not a file of its kind, cut short, or a suffix that is not known.
        FileNotFoundError: There is no such file.
    """
    path, scale = Path(path), scale_of(unit)
    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    suffix = path.suffix.lower()
    if suffix not in READABLE:
        raise MeshError(f"{path}: cannot read {suffix or 'files without a suffix'}; use one of {', '.join(READABLE)}.")
    if suffix == ".obj":
        data = MeshData(*read_obj(path))
    elif suffix == ".ply":
        data = MeshData(*read_ply(path))
    elif suffix == ".npz":
        arrays = read_npz(path, required=("vertices", "faces"))
        name = str(arrays["name"]) if "name" in arrays else ""
        data = MeshData(arrays["vertices"], arrays["faces"], arrays.get("pins"), name)
    elif suffix in USD_SUFFIXES:
        from .usd import read_usd

        found = read_usd(path, mesh=mesh, frames=False, convert=unit is None)
        data = MeshData(found.vertices[0], found.faces)
    else:
        data = _read_with_trimesh(path, suffix)
    if scale != 1.0:
        data = data._replace(vertices=np.asarray(data.vertices, dtype=np.float64) * scale)
    if expect_garment:
        _warn_about_size(path, np.asarray(data.vertices), scale)
    return data


def _read_with_trimesh(path: Path, suffix: str) -> MeshData:
    import trimesh

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
    return MeshData(*_join_exact(vertices, faces))


def _is_cut_short(path: Path) -> bool:
    """Whether a text STL lacks its last line; a binary one may start with solid too, but holds zeros."""
    data = path.read_bytes()
    return data.lstrip().startswith(b"solid") and b"\0" not in data and b"endsolid" not in data[-512:]


def _join_exact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joins vertices at exactly the same place, keeping the order of first appearance."""
    first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)[1:]
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return vertices[np.sort(first)], rank[inverse.reshape(-1)][faces]


def _warn_about_size(path: Path, vertices: np.ndarray, scale: float) -> None:
    if vertices.ndim != 2 or not len(vertices) or vertices.dtype.kind != "f" or not np.isfinite(vertices).all():
        return
    size = float(np.ptp(vertices, axis=0).max())
    if SMALLEST <= size <= BIGGEST or size == 0:
        return
    fits = [f'unit="{name}" ({size / scale * metres:.2g} m)' for name, metres in UNITS.items()
            if 0.2 <= size / scale * metres <= 2.5]  # fmt: skip
    advice = (
        f"Is it in another unit? Try {' or '.join(fits)}."
        if fits
        else "Check the scale it was exported with, and unit=."
    )
    warnings.warn(f"{path}: the garment would be {size:.3g} m in size. {advice}", UserWarning, stacklevel=4)


def write_mesh(
    path: Path, vertices: np.ndarray, faces: np.ndarray, *, pins: np.ndarray | None = None, name: str = ""
) -> None:
    """Writes a mesh by suffix, completely or not at all: .obj, .ply, .npz (with pins), .usd, .usda, .usdc.

    Raises:
        ValueError: Another suffix.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".obj":
        write_obj(path, vertices, faces, name)
    elif suffix == ".npz":
        extra = {} if pins is None or len(pins) == 0 else {"pins": pins}
        write_npz(path, {"vertices": vertices, "faces": faces, "name": np.array(name), **extra})
    elif suffix == ".ply":
        import trimesh

        data = cast(bytes, trimesh.Trimesh(vertices, faces, process=False).export(file_type="ply"))
        with atomic_file(path) as temporary:
            temporary.write_bytes(data)
    elif suffix in USD_SUFFIXES[:3]:
        from .usd import write_usd

        write_usd(path, [(name or "garment", vertices[None], faces)], 30.0)
    else:
        raise ValueError(
            f"cannot write {suffix or 'a file without a suffix'}; use .obj, .ply, .npz, .usd, .usda or .usdc"
        )
