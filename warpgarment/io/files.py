"""Reads and writes meshes and motions by suffix: `FORMATS` names the module of each format, loaded when it is used."""

from __future__ import annotations

import importlib
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from warpgarment.errors import MeshError, UsageError
from warpgarment.io.disk.outputs import names_folder
from warpgarment.io.disk.plain import check_plain

from .data import UNITS, Format, MeshData, MotionData, ReadOptions, scale_of
from .parts import ALL, unnamed

# Suffixes -> the module whose FORMAT reads and writes them; "" is a folder. docs/extending.md adds one.
FORMATS: dict[tuple[str, ...], str] = {
    (".obj",): "warpgarment.io.obj",
    (".ply",): "warpgarment.io.ply",
    (".off",): "warpgarment.io.off",
    (".npz",): "warpgarment.io.npz",
    (".stl",): "warpgarment.io.stl",
    (".glb", ".gltf"): "warpgarment.io.gltf",
    (".abc",): "warpgarment.io.alembic",
    (".usd", ".usda", ".usdc", ".usdz"): "warpgarment.io.usd",
    (".pc2",): "warpgarment.io.pc2",
    (".mdd",): "warpgarment.io.caches.mdd",
    (".bvh",): "warpgarment.bodies.bvh_file",
    ("",): "warpgarment.io.folder",
}
# Modules of formats that have a suffix from above, and are recognised by what a file holds.
ALIKE: dict[str, str] = {".npz": "warpgarment.bodies.amass_file"}
CACHES = (".pc2", ".mdd")  # of positions alone, with a mesh of the same name beside them
ASSUMED = 30.0  # frames a second where nobody says
BIGGEST, SMALLEST = 10.0, 0.05  # sizes [m] beyond which a garment's unit is probably another

LYING = 1.2, 2.4  # lengths along Z [m] of bodies that probably stand

Ability = Literal["read_mesh", "write_mesh", "read_motion", "write_motion"]


def format_of(suffix: str) -> Format | None:
    """The format of a lower-case suffix, "" being a folder; None where there is none."""
    module = next((module for suffixes, module in FORMATS.items() if suffix in suffixes), None)
    return None if module is None else importlib.import_module(module).FORMAT


def has_bones(path: Path) -> bool:
    """Whether a file that is there holds the motion of bones alone, which a body of the user's choice follows."""
    suffix = "" if path.is_dir() else path.suffix.lower()
    format = _alike(path, suffix) or format_of(suffix)
    return format is not None and format.bones


def suffixes(ability: Ability) -> list[str]:
    """Suffixes of the formats that can do something, in the order of `FORMATS`; a mesh is read as a motion too."""
    return [suffix for every in FORMATS for suffix in _able(every, ability)]


def _able(every: tuple[str, ...], ability: Ability) -> list[str]:
    """Those of the suffixes of a format with which it can do something."""
    format = format_of(every[0])
    assert format is not None
    able = getattr(format, ability) or (ability == "read_motion" and format.read_mesh)
    return [s for s in every if ability.startswith("read") or s not in format.only_read] if able else []


def listed(names: Sequence[str]) -> str:
    """Suffixes as a list in words: ".obj, .ply or a folder without a suffix"."""
    words = [name or "a folder without a suffix" for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} or {words[-1]}"


def read_mesh(
    path: Path,
    *,
    unit: str | None = None,
    mesh: str | None = None,
    up: str | None = None,
    expect_garment: bool = True,
) -> MeshData:
    """Reads a mesh as `Garment.load` describes; the arrays are not checked beyond the format.

    Args:
        path: The file.
        unit: See `Garment.load`.
        mesh: See `Garment.load`.
        up: See `Garment.load`.
        expect_garment: Warn about sizes that no garment has.

    Raises:
        MeshError: Not a file of its kind, cut short, or a suffix that is not known.
        FileNotFoundError: There is no such file.
    """
    path, scale, options = Path(path), scale_of(unit), ReadOptions(mesh, unit, _axis(up))
    format = _reader(path, "read_mesh", options)
    assert format.read_mesh is not None
    data = format.read_mesh(path, options)
    data = data._replace(vertices=_placed(data.vertices, scale, up))
    if expect_garment:
        _warn_about_size(path, np.asarray(data.vertices), scale)
    return data


def read_motion(
    path: Path,
    *,
    unit: str | None = None,
    mesh: str | None = None,
    up: str | None = None,
    shape: Any = None,
    rest: bool = False,
) -> MotionData:
    """Reads a moving mesh as `BodyMotion.load` describes; the arrays are not checked beyond the format.

    Args:
        path: File or folder.
        unit: See `BodyMotion.load`.
        mesh: See `BodyMotion.load`.
        up: See `BodyMotion.load`.
        shape: See `BodyMotion.load`.
        rest: See `BodyMotion.load`.

    Raises:
        UsageError: A shape for a file that has a body, or a body that is not known.
        MeshError: Not a file of its kind, cut short, arrays that do not fit each other, or a suffix that is not known.
        FileNotFoundError: There is no such file.
    """
    path, scale, options = Path(path), scale_of(unit), ReadOptions(mesh, unit, _axis(up), shape, rest)
    format = _reader(path, "read_motion", options)
    if shape is not None and not format.bones:
        raise UsageError(f"{path} has a body of its own. shape= is for motions of bones alone: BVH and AMASS.")
    if format.read_motion is not None:
        data = format.read_motion(path, options)
    else:
        assert format.read_mesh is not None
        single = format.read_mesh(path, options)
        data = MotionData(np.asarray(single.vertices)[None], single.faces, name=single.name, surface=single.surface)
    data = data._replace(vertices=_placed(data.vertices, scale, up))
    if up is None and not format.axis:
        _warn_about_axis(path, np.asarray(data.vertices))
    return data


def whole_output(path: Path, mesh: str | None) -> str | None:
    """The name to read a result by: all objects of a folder of OBJ or a point cache, where none is named.

    What `write_motion` writes is one mesh, and keeps the names of the objects that its input was made of.
    """
    return ALL if mesh is None and (path.is_dir() or path.suffix.lower() in CACHES) else mesh


def rate_of(path: Path, data: MotionData, fps: float | None) -> float:
    """Frames per second of a motion that was read: the user's, else the file's, else 30, with a warning.

    A format that says how many frames lie between two samples (`MotionData.step`) has as many fewer a second.

    Args:
        path: The file, for the message.
        data: What was read.
        fps: What the user says.

    Warns:
        UserWarning: Nobody says, and there is more than one frame.
    """
    if fps is None and data.fps is None and len(data.vertices) > 1:
        warnings.warn(
            f"{path}: the file has no rate; {ASSUMED:g} frames a second are assumed. Give it with fps=.",
            UserWarning,
            stacklevel=3,
        )
    rate = fps if fps is not None else data.fps if data.fps is not None else ASSUMED
    return rate / data.step


def start_of(data: MotionData, fps: float) -> float:
    """Time of the first frame [s]: what the file says in seconds, else the number of the frame, at this rate; else 0.

    Args:
        data: What was read.
        fps: Frames per second, as `rate_of` has them.
    """
    return data.seconds if data.seconds is not None else (data.start or 0.0) / fps


def write_mesh(path: Path, data: MeshData) -> None:
    """Writes a mesh by suffix, completely or not at all.

    Args:
        path: The file; parent folders are made.
        data: Positions in metres; pins are kept by .npz only.

    Raises:
        UsageError: A suffix that is not written.
    """
    format = _writer(Path(path), "write_mesh")
    assert format.write_mesh is not None
    format.write_mesh(Path(path), data)


def write_motion(path: str | os.PathLike[str], data: MotionData) -> None:
    """Writes a moving mesh by suffix, as `GarmentMotion.save` describes, completely or not at all.

    Args:
        path: The file, or a folder: without a suffix, with a slash at its end, or one that exists; parent folders are
            made.
        data: Positions in metres, with a rate; `extra` is kept by .npz only.

    Raises:
        UsageError: A suffix that is not written.
    """
    plain = Path(str(path))
    format = _writer(plain, "write_motion", folder=names_folder(path))
    assert format.write_motion is not None
    format.write_motion(plain, data)


def _axis(up: str | None) -> str | None:
    if up not in (None, "y", "z"):
        raise UsageError(f'up must be "y" or "z", got {up!r}')
    return up


def _placed(vertices: np.ndarray, scale: float, up: str | None) -> np.ndarray:
    """Positions in metres and Y up, of numbers of another unit or axis; what is no array of numbers stays."""
    if scale == 1.0 and up != "z":
        return vertices
    array = np.asarray(vertices)
    if array.dtype.kind not in "fiu" or array.ndim < 2 or array.shape[-1] != 3:
        return vertices
    if up == "z":
        array = np.stack([array[..., 0], array[..., 2], -array[..., 1]], axis=-1)
    return array.astype(np.float64) * scale if scale != 1.0 else array


def _reader(path: Path, ability: Literal["read_mesh", "read_motion"], options: ReadOptions) -> Format:
    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    if not path.is_dir():
        check_plain(path)
    suffix = "" if path.is_dir() else path.suffix.lower()
    every = next((every for every in FORMATS if suffix in every), None)
    if every and suffix in _able(every, ability) and (suffix or path.is_dir()):
        format = _alike(path, suffix) if ability == "read_motion" else None
        format = format or format_of(suffix)
        assert format is not None
        if not format.named:
            unnamed(path, options.mesh)
        return format
    kind = "a folder" if path.is_dir() else suffix or "files without a suffix"
    raise MeshError(
        f"{path}: cannot read {kind}{' as a mesh' if ability == 'read_mesh' else ''}; use {listed(suffixes(ability))}."
    )


def _alike(path: Path, suffix: str) -> Format | None:
    """The format of `ALIKE` that a file is of; None where it is of the format of its suffix."""
    if suffix not in ALIKE:
        return None
    format: Format = importlib.import_module(ALIKE[suffix]).FORMAT
    return format if format.recognised and format.recognised(path) else None


def _writer(path: Path, ability: Literal["write_mesh", "write_motion"], folder: bool = False) -> Format:
    suffix, able = path.suffix.lower(), suffixes(ability)
    if folder or (suffix not in able and "" in able and path.is_dir()):
        suffix = ""
    format = format_of(suffix)
    if suffix not in able or format is None:
        also = ", or a name with a slash at the end for a folder" if "" in able else ""
        raise UsageError(f"cannot write {suffix or 'a file without a suffix'}; use {listed(able)}{also}")
    return format


def _warn_about_axis(path: Path, vertices: np.ndarray) -> None:
    """Warns where the first frame is as long as people are tall, along Z, and lies flat."""
    if vertices.ndim != 3 or vertices.shape[-1] != 3 or vertices.dtype.kind != "f" or not vertices.size:
        return
    _, y, z = np.ptp(vertices[0], axis=0).tolist()
    if LYING[0] <= z <= LYING[1] and z > 2.5 * y:
        warnings.warn(
            f"{path}: {z:.2g} m along Z and {y:.2g} m along Y, which is taken for up: it lies on its back. If Z points "
            'up in the file, say so with up="z".',
            UserWarning,
            stacklevel=4,
        )


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
