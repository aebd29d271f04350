"""USD meshes with time-sampled points; needs ``pip install "warpgarment[usd]"``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgarment.errors import MeshError, MissingExtra
from warpgarment.geometry.checks import checked_faces, checked_fps, checked_positions

from .atomic import atomic_file
from .data import Format, MeshData, MotionData, ReadOptions
from .polygons import triangulate_counts

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


class UsdMesh(NamedTuple):
    """One mesh of a stage, Y up; positions in metres by the stage's own unit, or unconverted if so asked."""

    name: str
    vertices: np.ndarray  # float32 [T,V,3]
    faces: np.ndarray  # int64 [F,3]
    fps: float | None  # None for a single frame


def _pxr():
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, Vt
    except ImportError:
        raise MissingExtra("usd", "Reading and writing USD") from None
    return Gf, Sdf, Usd, UsdGeom, Vt


def write_usd(path: Path, meshes: Sequence[tuple[str, np.ndarray, np.ndarray]], fps: float) -> None:
    """Writes meshes as one stage, completely or not at all.

    Y up, metresPerUnit 1, one time code a frame from 0, no subdivision, extents for every frame.

    Args:
        path: .usd, .usda or .usdc.
        meshes: Name, vertices [T,V,3] in metres and faces [F,3] of each, such as garment and body; the same T for all.
        fps: Time codes (frames) per second.

    Raises:
        MeshError: Other shapes, indices out of range, or different numbers of frames.
        MissingExtra: usd-core is not installed.
    """
    Gf, _, Usd, UsdGeom, Vt = _pxr()
    path, fps = Path(path), checked_fps(fps)
    if path.suffix not in SUFFIXES[:3]:
        raise ValueError(f"USD is written as .usd, .usda or .usdc, not {path.suffix!r}")
    if not meshes:
        raise MeshError("No mesh to write.")
    checked = []
    for name, vertices, faces in meshes:
        vertices = checked_positions(vertices, name=f"vertices of {name!r}", frames=True, finite=False)
        checked.append((name, vertices, checked_faces(faces, vertices.shape[1], name=f"faces of {name!r}")))
    frames = {len(vertices) for _, vertices, _ in checked}
    if len(frames) > 1:
        raise MeshError(f"The meshes have {' and '.join(map(str, sorted(frames)))} frames. Give them the same number.")
    with atomic_file(path) as temporary:
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(checked[0][1]) - 1)
        root = UsdGeom.Xform.Define(stage, "/root")
        stage.SetDefaultPrim(root.GetPrim())
        taken: set[str] = set()
        for name, vertices, faces in checked:
            mesh = UsdGeom.Mesh.Define(stage, f"/root/{_identifier(name, taken)}")
            mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
            mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, dtype=np.int32)))
            mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1)))
            points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
            for frame, positions in enumerate(vertices):
                points.Set(Vt.Vec3fArray.FromNumpy(positions), frame)
                low, high = positions.min(axis=0), positions.max(axis=0)
                extent.Set(Vt.Vec3fArray([Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())]), frame)
        stage.GetRootLayer().Save()
        del stage


def _identifier(name: str, taken: set[str]) -> str:
    base = re.sub(r"[^A-Za-z0-9_]", "_", name) or "mesh"
    base = f"_{base}" if base[0].isdigit() else base
    unique, n = base, 1
    while unique in taken:
        unique, n = f"{base}_{n}", n + 1
    taken.add(unique)
    return unique


def read_usd(path: Path, *, mesh: str | None = None, frames: bool = True, convert: bool = True) -> UsdMesh:
    """Reads one mesh of a stage, in world space, Y up, polygons as triangles.

    Args:
        path: The file.
        mesh: Name or path of the prim; may be left out where the stage has a single mesh.
        frames: All frames (from the stage's start to its end time code, or the points' own samples), or the first only.
        convert: Scale by the stage's metersPerUnit.

    Raises:
        MeshError: Not a stage, no mesh, several and none named, or topology that changes with time.
        MissingExtra: usd-core is not installed.
        FileNotFoundError: There is no such file.
    """
    _, _, Usd, UsdGeom, _ = _pxr()
    from pxr import Tf

    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException:
        stage = None
    if stage is None:
        raise MeshError(f"{path}: USD cannot open it. It is damaged, cut short, or of another kind.")
    prim = _choose([p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)], mesh, path)
    geometry = UsdGeom.Mesh(prim)
    times, fps = _times(stage, geometry, Usd) if frames else ([Usd.TimeCode.EarliestTime()], None)
    counts = np.array(geometry.GetFaceVertexCountsAttr().Get(times[0]) or [], dtype=np.int64)
    indices = np.array(geometry.GetFaceVertexIndicesAttr().Get(times[0]) or [], dtype=np.int64)
    positions = [_world_points(geometry, UsdGeom, time) for time in times]
    if len(counts) == 0 or counts.sum() != len(indices) or (counts < 3).any():
        raise MeshError(f"{path}: mesh {prim.GetName()!r} has no faces, or face counts that do not fit its indices.")
    if len({len(p) for p in positions}) > 1 or len(positions[0]) == 0:
        raise MeshError(f"{path}: mesh {prim.GetName()!r} has no points, or their number changes with time.")
    if indices.min() < 0 or indices.max() >= len(positions[0]):
        raise MeshError(f"{path}: faces of {prim.GetName()!r} name points beyond the {len(positions[0]):,} it has.")
    vertices = np.stack(positions)
    faces = triangulate_counts(vertices[0], counts, indices)
    if geometry.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded:
        faces = faces[:, ::-1].copy()
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        vertices = np.stack([vertices[..., 0], vertices[..., 2], -vertices[..., 1]], axis=-1)
    if convert:
        vertices = vertices * UsdGeom.GetStageMetersPerUnit(stage)
    return UsdMesh(prim.GetName(), vertices.astype(np.float32), faces, fps)


def _choose(prims: list, mesh: str | None, path: Path):
    if mesh is not None:
        named = [p for p in prims if mesh in (p.GetName(), str(p.GetPath()))]
        if len(named) != 1:
            have = ", ".join(str(p.GetPath()) for p in prims) or "none"
            raise MeshError(f"{path}: {len(named)} meshes named {mesh!r}; the stage holds {have}.")
        return named[0]
    if len(prims) != 1:
        have = ", ".join(str(p.GetPath()) for p in prims[:8])
        raise MeshError(f"{path}: {len(prims)} meshes{': ' + have if have else ''}. Name one with mesh=.")
    return prims[0]


def _times(stage, geometry, Usd):
    samples = geometry.GetPointsAttr().GetTimeSamples()
    rate = stage.GetTimeCodesPerSecond()
    if stage.HasAuthoredTimeCodeRange():
        start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
        if end > start:
            return [Usd.TimeCode(start + k) for k in range(int(np.floor(end - start + 1e-6)) + 1)], rate
    if len(samples) > 1:
        return [Usd.TimeCode(t) for t in samples], rate * (len(samples) - 1) / (samples[-1] - samples[0])
    return [Usd.TimeCode.EarliestTime()], None


def _world_points(geometry, UsdGeom, time) -> np.ndarray:
    points = np.array(geometry.GetPointsAttr().Get(time) or [], dtype=np.float64).reshape(-1, 3)
    matrix = np.array(UsdGeom.Imageable(geometry).ComputeLocalToWorldTransform(time))
    return points @ matrix[:3, :3] + matrix[3, :3]


def _read_mesh(path: Path, options: ReadOptions) -> MeshData:
    found = read_usd(path, mesh=options.mesh, frames=False, convert=options.unit is None)
    return MeshData(found.vertices[0], found.faces)


def _write_mesh(path: Path, data: MeshData) -> None:
    write_usd(path, [(data.name or "garment", np.asarray(data.vertices)[None], data.faces)], 30.0)


def _read_motion(path: Path, options: ReadOptions) -> MotionData:
    found = read_usd(path, mesh=options.mesh, convert=options.unit is None)
    return MotionData(found.vertices, found.faces, found.fps, name=found.name)


def _write_motion(path: Path, data: MotionData) -> None:
    write_usd(path, [(data.name or "mesh", data.vertices, data.faces)], 30.0 if data.fps is None else data.fps)


FORMAT = Format("usd", _read_mesh, _write_mesh, _read_motion, _write_motion, only_read=(".usdz",))
