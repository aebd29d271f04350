"""Recordings from garment animations and a body animation in PC2, OBJ sequences, USD or NPZ.

recording("dress.pc2", "body.pc2", fps=30)                        # with dress.obj and body.obj beside them
recording(["shirt/", "jacket/"], "body.npz", unit="cm")           # folders of .obj, innermost first
recording([("scene.usd", "shirt")], ("scene.usd", "body"))        # meshes of a stage by name
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.data import MotionData
from warpgarment.io.files import read_mesh, read_motion
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.material import Material

from .recording import RecordedGarment, Recording, recorded_garment

Source = str | os.PathLike | tuple[str | os.PathLike, str]
FPS = 30.0  # frames per second if no file specifies a rate
SMALLEST, LARGEST = 0.03, 3.0  # limits of a garment's height over the body's; outside them, their units differ
FARTHEST = 3.0  # largest distance of their centres in body heights; further apart, they do not belong together


def recording(
    garment: Source | Sequence[Source],
    body: Source | BodyMotion | None = None,
    *,
    rest: str | os.PathLike | Sequence[str | os.PathLike] | None = None,
    fps: float | None = None,
    unit: str | None = None,
    body_unit: str | None = None,
    clean: bool = False,
    materials: Sequence[Material | None] = (),
    wind: np.ndarray | None = None,
) -> Recording:
    """A recording of animations of garments and of the body under them.

    Files that say at which frame they start are put together by that: the frames that all have are kept. Those that do
    not say start with the others; so do those that say 0 and have as many frames.

    Args:
        garment: File or folder that `BodyMotion.load` reads, or several, innermost first; (file, mesh) names one mesh
            of a USD stage.
        body: File or folder of the body, in the forms of `garment`, or a `BodyMotion`; None for no body.
        rest: Rest shapes, one mesh file per garment, with the vertices in the order of the animation. None takes the
            mesh beside a .pc2, otherwise the first frame.
        fps: Frames per second, in place of the files' rates; None takes their rate, which must be the same in all
            files, or 30 if no file has one.
        unit: Length unit of the files: "m", "dm", "cm", "mm", "in"; see `Garment.load`.
        body_unit: Length unit of the body's file; None for that of the garments.
        clean: Whether rest meshes that are not valid for a garment are repaired; the frames follow.
        materials: Material of each garment, None where it is not known; empty if none is known.
        wind: Velocity of the air in each frame [m/s], [T, 3].

    Raises:
        MeshError: Frames, rates, vertices or sizes do not fit each other, they have no frame in common, or a file is
            damaged.
        FileNotFoundError: There is no such file.

    Warns:
        UserWarning: A garment has no rest shape of its own, or frames are left out.
    """
    several = isinstance(garment, (list, tuple)) and not _is_one(garment)
    sources = cast(list[Source], list(cast(Sequence, garment)) if several else [garment])
    rests = [rest] if rest is None or isinstance(rest, (str, os.PathLike)) else list(rest)
    if rest is not None and len(rests) != len(sources):
        raise MeshError(f"{len(rests)} rest shapes for {len(sources)} garments. Give one each.")
    rates, starts = dict[str, float](), list[float | None]()
    garments = [
        _garment(source, still, unit, clean, rates, starts)
        for source, still in zip(sources, rests if rest is not None else [None] * len(sources), strict=True)
    ]
    motion = _body(body, body_unit or unit, rates, starts)
    rate = _rate(fps, rates)
    names = ", ".join(str(_split(source)[0]) for source in sources)
    lengths = [len(g.vertices) for g in garments] + ([len(motion)] if motion is not None else [])
    parts = _in_common(starts, lengths, [g.rest.name for g in garments] + ["body"])
    garments = [g._replace(vertices=g.vertices[part]) for g, part in zip(garments, parts, strict=False)]
    if motion is not None and (motion.fps != rate or len(motion) != len(motion.vertices[parts[-1]])):
        motion = BodyMotion(motion.vertices[parts[-1]], motion.faces, rate)
    made = Recording(tuple(garments), motion, rate, tuple(materials), wind, source=names)
    if motion is not None:
        for one in made.garments:
            _check_place(one, motion, names)
    return made


def _is_one(source: Sequence) -> bool:
    """Whether a tuple is (file, mesh), a USD stage and the name of a mesh, rather than two files."""
    return (
        isinstance(source, tuple)
        and len(source) == 2
        and isinstance(source[1], str)
        and Path(source[0]).suffix.lower().startswith(".usd")
        and not Path(source[1]).exists()
    )


def _split(source: Source) -> tuple[Path, str | None]:
    return (Path(source[0]), source[1]) if isinstance(source, tuple) else (Path(source), None)


def _read(
    source: Source, unit: str | None, rates: dict[str, float], starts: list[float | None]
) -> tuple[Path, str, MotionData]:
    path, mesh = _split(source)
    data = read_motion(path, unit=unit, mesh=mesh)
    name = mesh.rsplit("/", 1)[-1] if mesh else path.stem
    if data.fps is not None:
        rates[f"{path.name}{f' ({mesh})' if mesh else ''}"] = float(data.fps)
    elif data.step != 1:
        rates[path.name] = FPS / data.step
    starts.append(data.start if data.seconds is None else data.seconds * (data.fps or FPS))
    return path, name, data


def _garment(
    source: Source,
    rest: str | os.PathLike | None,
    unit: str | None,
    clean: bool,
    rates: dict[str, float],
    starts: list[float | None],
) -> RecordedGarment:
    path, name, data = _read(source, unit, rates, starts)
    frames, faces = np.asarray(data.vertices), np.asarray(data.faces)
    if rest is None and path.suffix.lower() == ".pc2":
        rest = next(p for p in (path.with_suffix(".obj"), path.with_suffix(".ply")) if p.exists())
    if rest is None:
        warnings.warn(
            f"{path}: no rest shape: the first frame serves, and how the cloth is stretched there counts as none. "
            "Give one with rest=.",
            UserWarning,
            stacklevel=3,
        )
        return recorded_garment(name, frames[0], faces, frames, where=str(path), clean=clean)
    still = read_mesh(Path(rest), unit=unit)
    if len(still.vertices) != frames.shape[1]:
        raise MeshError(f"{rest} has {len(still.vertices):,} vertices, {path} {frames.shape[1]:,}.")
    others = np.asarray(still.faces)
    same = others.shape == faces.shape and (np.sort(others, axis=1) == np.sort(faces, axis=1)).all(axis=1).mean() > 0.5
    if not same:  # a few faces may differ, since bent quads can be split along either diagonal
        raise MeshError(f"{rest} and {path} have other faces: they must share one topology and order.")
    return recorded_garment(name, np.asarray(still.vertices), others, frames, where=str(path), clean=clean)


def _body(
    body: Source | BodyMotion | None, unit: str | None, rates: dict[str, float], starts: list[float | None]
) -> BodyMotion | None:
    if body is None:
        return None
    if isinstance(body, BodyMotion):
        rates["body"] = body.fps
        starts.append(body.clock.number or None)
        return body
    path, _, data = _read(body, unit, rates, starts)
    try:
        motion = BodyMotion(data.vertices, data.faces, data.fps or FPS)
        return motion if data.collider_faces is None else motion.submesh(data.collider_faces)
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None


def _rate(fps: float | None, rates: dict[str, float]) -> float:
    if fps is not None:
        return float(fps)
    if len({round(rate, 6) for rate in rates.values()}) > 1:
        listed = ", ".join(f"{name} {rate:g}" for name, rate in rates.items())
        raise MeshError(f"frames per second differ: {listed}. Resample, or say which is right with fps=.")
    return next(iter(rates.values()), FPS)


def _in_common(starts: Sequence[float | None], lengths: Sequence[int], names: Sequence[str]) -> list[slice]:
    """The frames of each file that all have; everything where the files do not differ in when they start.

    A start of 0 counts as not said where all have as many frames, since programs write it when they do not know.

    Args:
        starts: Number of each file's first frame, None where it does not say.
        lengths: Numbers of frames.
        names: For messages.
    """
    known = [start for start in starts if start is not None]
    begins = [min(known, default=0.0) if start is None else start for start in starts]
    if not known or max(known) - min(known) < 1e-3:
        return [slice(None)] * len(starts)
    if len(set(lengths)) == 1 and min(map(abs, known)) < 1e-3:
        others = [start for start in known if abs(start) >= 1e-3]
        if max(others) - min(others) < 1e-3:
            warnings.warn(
                f"some files start at frame {others[0]:g}, some at 0, with {lengths[0]:,} frames all of them: they are "
                "put together from their first frames on.",
                UserWarning,
                stacklevel=3,
            )
            return [slice(None)] * len(starts)
    first, stop = max(begins), min(b + n for b, n in zip(begins, lengths, strict=True))
    listed = ", ".join(f"{name} {b:g} to {b + n - 1:g}" for name, b, n in zip(names, begins, lengths, strict=False))
    if any(abs(first - b - round(first - b)) > 1e-3 for b in begins):
        raise MeshError(f"the frames of the files lie between each other: {listed}. Resample them to the same times.")
    count = round(stop - first)
    if count < 1:
        raise MeshError(f"the files have no frame in common: {listed}. Are their starts right?")
    warnings.warn(
        f"the files start at other frames: {listed}; the {count:,} frames from {first:g} on are kept, which all have.",
        UserWarning,
        stacklevel=3,
    )
    return [slice(round(first - b), round(first - b) + count) for b in begins]


def _check_place(garment: RecordedGarment, body: BodyMotion, names: str) -> None:
    """Raises MeshError unless sizes and places of garment and body fit each other in the first frame."""
    firsts = (garment.vertices[0].astype(np.float64), body.vertices[0].astype(np.float64))
    size, height = (float(np.ptp(first, axis=0).max()) for first in firsts)
    if not SMALLEST <= size / height <= LARGEST:
        raise MeshError(
            f"{names}: the garment {garment.rest.name!r} is {size:.3g} m and the body {height:.3g} m in size: one of "
            "them is in another unit. Say which with unit= and body_unit=."
        )
    centres = [0.5 * (first.min(axis=0) + first.max(axis=0)) for first in firsts]
    apart = float(np.linalg.norm(centres[0] - centres[1]))
    if apart > FARTHEST * height:
        raise MeshError(
            f"{names}: the garment {garment.rest.name!r} starts {apart:.3g} m from the body: they are in other places, "
            "or one has another axis up."
        )
