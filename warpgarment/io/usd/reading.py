"""Reads one mesh of a USD stage over time: its points, transforms of it and its parents, skeleton, blend shapes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.data import Holds
from warpgarment.io.disk.plain import check_plain
from warpgarment.io.polygons import triangulate_counts
from warpgarment.io.surface.record import Surface, worth_keeping
from warpgarment.io.times import Frames, frames_of
from warpgarment.progress import parts

from .looks import surface_of
from .skeleton import Skinning, skinning_of
from .writing import pxr

LARGEST = 512 << 20  # bytes of positions beyond which there must be a sample for every other frame


class UsdMesh(NamedTuple):
    """One mesh of a stage, Y up; positions in metres by the stage's own unit, or unconverted if so asked."""

    name: str
    vertices: np.ndarray  # float32 [T,V,3]
    faces: np.ndarray  # int64 [F,3]
    fps: float | None  # None for a single frame
    start: float = 0.0  # time of the first frame in frames: its time code, where the stage counts frames; of one, [s]
    surface: Surface | None = None  # polygons as they are seen from outside; None: triangles alone


def read_usd(
    path: Path, *, mesh: str | None = None, frames: bool = True, convert: bool = True, turn: bool = True
) -> UsdMesh:
    """Reads one mesh of a stage, in world space, Y up, polygons as triangles that look outwards as USD defines it.

    Instances are looked into. A mesh that no renderer shows (invisible, or of another purpose than default and render)
    is read only if it is named.

    Args:
        path: The file.
        mesh: Name or path of the prim; may be left out where the stage shows a single mesh.
        frames: All frames, as `times.frames_of` has them, or the first only.
        convert: Scale by the stage's metersPerUnit.
        turn: Turn a stage whose upAxis is Z.

    Raises:
        MeshError: Not a stage, no mesh, several and none named, attributes of other types or sizes, or topology that
            changes with time.
        MissingExtra: usd-core is not installed.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    with _opened(path) as stage:
        return _read(stage, path, mesh, frames, convert, turn)


def _read(stage: Any, path: Path, mesh: str | None, frames: bool, convert: bool, turn: bool) -> UsdMesh:
    _, _, Usd, UsdGeom, _ = pxr()
    prim = _choose(stage, mesh, path, Usd, UsdGeom)
    where = f"{path}: mesh {prim.GetName()!r}"
    skinning = skinning_of(prim)
    chosen = _frames(stage, prim, skinning, where, UsdGeom) if frames else Frames(np.zeros(0), None)
    times = [Usd.TimeCode(float(code)) for code in chosen.codes] or [Usd.TimeCode.EarliestTime()]
    if not frames and (codes := _samples(prim, skinning, UsdGeom)[0]).size:
        times = [Usd.TimeCode(float(codes[0]))]

    counts = _array(prim, "faceVertexCounts", times[0], where, integers=True)
    indices = _array(prim, "faceVertexIndices", times[0], where, integers=True)
    if len(counts) == 0 or counts.sum() != len(indices) or (counts < 3).any():
        raise MeshError(f"{where} has no faces, or face counts that do not fit its indices.")
    vertices = _positions(prim, skinning, times, where, UsdGeom)
    if indices.min() < 0 or indices.max() >= vertices.shape[1]:
        raise MeshError(f"{where}: faces name points beyond the {vertices.shape[1]:,} it has.")
    try:
        faces = triangles = triangulate_counts(vertices[0], counts, indices)
    except MeshError as error:
        raise MeshError(f"{where}: {error}") from None
    left = UsdGeom.Mesh(prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
    if left != (_determinant(prim, skinning, times[0], UsdGeom) < 0):
        faces = faces[:, ::-1].copy()
    surface = worth_keeping(where, lambda: surface_of(prim, counts, indices, vertices.shape[1], times[0]))
    if surface is not None:
        surface = surface.following(triangles, faces)
    if turn and UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        vertices = np.stack([vertices[..., 0], vertices[..., 2], -vertices[..., 1]], axis=-1)
    if convert:
        vertices = vertices * UsdGeom.GetStageMetersPerUnit(stage)
    fps = chosen.fps
    start = float(chosen.codes[0]) * (fps or 1.0) / stage.GetTimeCodesPerSecond() if len(chosen.codes) else 0.0
    with np.errstate(over="ignore"):
        return UsdMesh(prim.GetName(), vertices.astype(np.float32), faces, fps, start, surface)


def usd_holds(path: Path) -> Holds:
    """Meshes that a stage shows, by path where two have the same name, its unit and axis; raises as `read_usd`."""
    _, _, Usd, UsdGeom, _ = pxr()
    with _opened(path) as stage:
        prims = [p for p in stage.Traverse(Usd.TraverseInstanceProxies()) if p.IsA(UsdGeom.Mesh)]
        shown = [p for p in prims if _is_shown(p, Usd, UsdGeom)] or prims
        names = [p.GetName() for p in shown]
        names = [name if names.count(name) == 1 else str(p.GetPath()) for name, p in zip(names, shown, strict=True)]
        up = "z" if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else "y"
        return Holds(tuple(names), float(UsdGeom.GetStageMetersPerUnit(stage)), up)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The stage of a file; what USD finds damaged, also while a value is unpacked when it is first read, is named."""
    from pxr import Tf, Usd

    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    check_plain(path)
    try:
        stage = Usd.Stage.Open(str(path))
        if stage is None:
            raise MeshError(f"{path}: USD cannot open it. It is damaged, cut short, or of another kind.")
        yield stage
    except Tf.ErrorException as error:
        raise MeshError(
            f"{path}: USD cannot read it ({_words(error)}). It is damaged, cut short, or of another kind."
        ) from None


def _words(error: Exception) -> str:
    """The end of what USD says; it quotes the file, whose bytes may be no text."""
    try:
        return " ".join(str(error).split())[-200:]
    except UnicodeDecodeError:
        return "it is not text in UTF-8"


def _choose(stage: Any, mesh: str | None, path: Path, Usd: Any, UsdGeom: Any) -> Any:
    prims = [p for p in stage.Traverse(Usd.TraverseInstanceProxies()) if p.IsA(UsdGeom.Mesh)]
    shown = [p for p in prims if _is_shown(p, Usd, UsdGeom)]
    if mesh is None:
        found = shown or prims
        problem = f"{len(found)} meshes: "
    else:
        named = [p for p in prims if mesh in (p.GetName(), str(p.GetPath()))]
        found = [p for p in named if p in shown] or named
        problem = f"{len(found)} meshes named {mesh!r}; the stage holds "
    if len(found) == 1:
        return found[0]
    if not prims:
        kinds = ", ".join(sorted({str(p.GetTypeName()) for p in stage.Traverse()} - {""})) or "nothing"
        raise MeshError(f"{path}: no mesh in this stage; it holds {kinds}. Are its references and payloads there?")
    have = ", ".join(str(p.GetPath()) for p in (found or prims)[:8])
    more = f", and {len(found or prims) - 8} more" if len(found or prims) > 8 else ""
    raise MeshError(f"{path}: {problem}{have}{more}. Name one with mesh=.")


def _is_shown(prim: Any, Usd: Any, UsdGeom: Any) -> bool:
    imageable = UsdGeom.Imageable(prim)
    visible = imageable.ComputeVisibility(Usd.TimeCode.EarliestTime()) != UsdGeom.Tokens.invisible
    return visible and imageable.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)


def _samples(prim: Any, skinning: Skinning | None, UsdGeom: Any) -> tuple[np.ndarray, bool]:
    """Time codes at which something that moves the mesh has a value, sorted, and whether transforms or joints do."""
    turns = [*skinning.samples] if skinning else []
    above = skinning.frame if skinning else prim
    while above and not above.IsPseudoRoot():
        xform = UsdGeom.Xformable(above)
        if xform:
            turns += xform.GetTimeSamples()
            if xform.GetResetXformStack():
                break
        above = above.GetParent()
    codes = np.unique(np.array([*prim.GetAttribute("points").GetTimeSamples(), *turns], dtype=np.float64))
    codes = codes[np.isfinite(codes)]
    if len(codes) > 1:  # codes that differ by rounding are one
        codes = codes[np.diff(codes, prepend=-np.inf) > 1e-9 * max(1.0, float(np.abs(codes).max()))]
    return codes, len(set(turns)) > 1


def _frames(stage: Any, prim: Any, skinning: Skinning | None, where: str, UsdGeom: Any) -> Frames:
    codes, turns = _samples(prim, skinning, UsdGeom)
    span = (stage.GetStartTimeCode(), stage.GetEndTimeCode()) if stage.HasAuthoredTimeCodeRange() else None
    found = frames_of(codes, stage.GetTimeCodesPerSecond(), span, turns=turns, where=where)
    points = prim.GetAttribute("points").Get(float(codes[0])) if len(codes) else prim.GetAttribute("points").Get()
    size = 12 * len(found.codes) * (len(points) if hasattr(points, "__len__") else 0)
    if size > LARGEST and len(found.codes) > 2 * len(codes):
        raise MeshError(
            f"{where}: {len(found.codes):,} frames from {len(codes):,} time samples would take {size:,} bytes; beyond "
            f"{LARGEST:,} each frame needs a sample. Shorten the stage's range."
        )
    return found


def _positions(prim: Any, skinning: Skinning | None, times: list, where: str, UsdGeom: Any) -> np.ndarray:
    """World positions, float64 [T,V,3]."""
    found: list[np.ndarray] = []
    for time in parts(times, "reading"):
        points = _array(prim, "points", time, where, columns=3)
        if skinning is not None:
            try:
                points = skinning.points(prim.GetAttribute("points").Get(time), time)
            except (ValueError, TypeError) as error:
                raise MeshError(f"{where} cannot be moved by its skeleton: {error}.") from None
        matrix = _matrix(skinning.frame if skinning else prim, time, UsdGeom)
        if len(points) == 0 or (found and len(points) != len(found[0])):
            raise MeshError(f"{where} has no points, or their number changes with time.")
        found.append(points @ matrix[:3, :3] + matrix[3, :3])
    return np.stack(found)


def _matrix(prim: Any, time: Any, UsdGeom: Any) -> np.ndarray:
    return np.array(UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(time))


def _determinant(prim: Any, skinning: Skinning | None, time: Any, UsdGeom: Any) -> float:
    return float(np.linalg.det(_matrix(skinning.frame if skinning else prim, time, UsdGeom)[:3, :3]))


def _array(
    prim: Any, name: str, time: Any, where: str, *, columns: int | None = None, integers: bool = False
) -> np.ndarray:
    """An attribute's numbers, [N] or [N,columns]; other types are refused, whatever the schema says they are."""
    attribute = prim.GetAttribute(name)
    value = attribute.Get(time)
    if value is None:
        return np.zeros((0, columns) if columns else 0, dtype=np.int64 if integers else np.float64)
    listed = hasattr(value, "__len__") and not isinstance(value, str)
    array: np.ndarray = np.array(value) if listed else np.zeros(())
    right = array.dtype.kind in ("iu" if integers else "fiu") and array.ndim == (2 if columns else 1)
    if array.size and not (right and (columns is None or array.shape[-1] == columns)):
        wanted = f"{'whole numbers' if integers else 'numbers'}{f' in rows of {columns}' if columns else ''}"
        raise MeshError(f"{where}: {name} holds {array.dtype} of shape {list(array.shape)} where a mesh has {wanted}.")
    return array.reshape((-1, columns) if columns else -1).astype(np.int64 if integers else np.float64)
