"""Writes meshes with time-sampled points as a USD stage."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError, MissingExtra, OutputError
from warpgarment.geometry.checks import checked_faces, checked_fps, checked_positions
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.surface.record import Surface, of_triangles
from warpgarment.progress import parts

from .dressing import Wardrobe, coordinates_name, dress, identifier

SUFFIXES = (".usd", ".usda", ".usdc")


def pxr() -> tuple[Any, ...]:
    """USD's modules Gf, Sdf, Usd, UsdGeom and Vt.

    Raises:
        MissingExtra: usd-core is not installed.
    """
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, Vt
    except ImportError:
        raise MissingExtra("usd", "Reading and writing USD") from None
    return Gf, Sdf, Usd, UsdGeom, Vt


def write_usd(
    path: Path,
    meshes: Sequence[tuple[str, np.ndarray, np.ndarray]],
    fps: float,
    surfaces: Sequence[Surface | None] = (),
    *,
    start: float = 0.0,
) -> None:
    """Writes meshes as one stage, completely or not at all.

    Y up, metresPerUnit 1, one time code a frame from `start`, no subdivision, extents for every frame.

    Args:
        path: .usd, .usda or .usdc.
        meshes: Name, vertices [T,V,3] in metres and faces [F,3] of each, such as garment and body; the same T for all.
        fps: Time codes (frames) per second.
        surfaces: What is written of each mesh instead of its triangles; None, or none for all: nothing.
        start: Time code of the first frame.

    Raises:
        MeshError: Other shapes, indices out of range, or different numbers of frames.
        MissingExtra: usd-core is not installed.
    """
    Gf, _, Usd, UsdGeom, Vt = pxr()
    path, fps = Path(path), checked_fps(fps)
    if path.suffix.lower() not in SUFFIXES:
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
    with atomic_file(path) as temporary, _said(path):
        stage = Usd.Stage.CreateNew(str(temporary))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(start)
        stage.SetEndTimeCode(start + len(checked[0][1]) - 1)
        root = UsdGeom.Xform.Define(stage, "/root")
        stage.SetDefaultPrim(root.GetPrim())
        taken, wardrobe = {"materials"}, Wardrobe(stage, path)
        for (name, vertices, faces), surface in zip(checked, surfaces or [None] * len(checked), strict=True):
            mesh = UsdGeom.Mesh.Define(stage, f"/root/{identifier(name, taken)}")
            mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
            surface = surface or of_triangles(faces)
            coordinates = coordinates_name(surface)
            dress(mesh, surface, partial(wardrobe.material, coordinates=coordinates))
            points, extent = mesh.CreatePointsAttr(), mesh.CreateExtentAttr()
            for frame, positions in enumerate(parts(vertices, f"writing {name}")):
                points.Set(Vt.Vec3fArray.FromNumpy(positions), start + frame)
                low, high = positions.min(axis=0), positions.max(axis=0)
                extent.Set(Vt.Vec3fArray([Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())]), start + frame)
        if not stage.GetRootLayer().Save():
            raise OutputError(f"{path}: USD could not save it. Is there room on the disk?")
        del stage


@contextlib.contextmanager
def _said(path: Path) -> Iterator[None]:
    """Makes an OutputError of what USD's writer complains about."""
    from pxr import Tf

    try:
        yield
    except Tf.ErrorException as error:
        said = "; ".join(str(entry.commentary) for entry in error.args) or str(error)
        raise OutputError(f"{path}: USD cannot write it: {said}") from error
