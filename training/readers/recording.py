"""The result of every reader: garments in motion, the body under them, and the known properties of cloth and air."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.checks import checked_fps, checked_positions
from warpgarment.geometry.clean import clean_mesh
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from .smpl import SmplPoses


class RecordedGarment(NamedTuple):
    """One garment of a recording.

    Attributes:
        rest: Garment with its rest mesh [m].
        vertices: Vertices of the garment in every frame [m], Y up, float32 [T, V, 3].
    """

    rest: Garment
    vertices: np.ndarray


@dataclass(frozen=True, eq=False)
class Recording:
    """A simulated or captured sequence in SI units, Y up.

    Attributes:
        garments: Garments, innermost first.
        body: Body under the garments; None if the data set has only poses (see `poses`) or no body at all.
        fps: Frames per second.
        materials: Material of each garment, None where it is not known.
        wind: Velocity of the air in each frame [m/s], float32 [T, 3]; None if the air is still or not known.
        source: Format and file, for messages and manifests.
        poses: SMPL parameters, if the data set describes the body by them.
        attributes: Other data of the files, as plain values.

    Raises:
        MeshError: There are no garments, or frames, rates, counts or shapes do not fit each other; the error names the
            part.
    """

    garments: tuple[RecordedGarment, ...]
    body: BodyMotion | None = None
    fps: float = 30.0
    materials: tuple[Material | None, ...] = ()
    wind: np.ndarray | None = None
    source: str = ""
    poses: SmplPoses | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = self.source or "recording"
        if not self.garments:
            raise MeshError(f"{where}: no garments. A recording needs one at least.")
        object.__setattr__(self, "garments", tuple(RecordedGarment(*g) for g in self.garments))
        object.__setattr__(self, "fps", checked_fps(self.fps))
        object.__setattr__(self, "materials", tuple(self.materials) or (None,) * len(self.garments))
        parts = {f"garment {g.rest.name or n}": len(g.vertices) for n, g in enumerate(self.garments)}
        if self.body is not None:
            parts["body"] = len(self.body)
            if abs(self.body.fps - self.fps) > 1e-6 * self.fps:
                raise MeshError(
                    f"{where}: the garments run at {self.fps:g} fps, the body at {self.body.fps:g}. "
                    "Resample one of them, or say which rate is right."
                )
        if self.wind is not None:
            object.__setattr__(self, "wind", checked_positions(self.wind, name="wind"))
            parts["wind"] = len(self.wind)
        if self.poses is not None:
            parts["poses"] = len(self.poses)
        if len(set(parts.values())) > 1:
            counts = ", ".join(f"{name} {count:,}" for name, count in parts.items())
            raise MeshError(f"{where}: numbers of frames differ: {counts}. Cut them to the same frames.")
        if len(self.materials) != len(self.garments):
            raise MeshError(f"{where}: {len(self.materials)} materials for {len(self.garments)} garments.")
        for garment in self.garments:
            if garment.vertices.shape[1:] != garment.rest.vertices.shape:
                raise MeshError(
                    f"{where}: garment {garment.rest.name!r} has {garment.vertices.shape[1]:,} vertices in motion "
                    f"and {len(garment.rest.vertices):,} at rest."
                )

    def __repr__(self) -> str:
        names = ", ".join(g.rest.name or "garment" for g in self.garments)
        body = "no body" if self.body is None else f"a body of {self.body.vertices.shape[1]:,} vertices"
        return f"Recording({self.source!r}, {len(self):,} frames at {self.fps:g} fps: {names} on {body})"

    def __len__(self) -> int:
        return len(self.garments[0].vertices)

    def resampled(self, fps: float) -> Recording:
        """The recording at another rate, with positions interpolated linearly in time and without SMPL poses.

        It has as many whole frames as fit: none holds the end, as that would teach cloth to stop there.

        Args:
            fps: New frames per second.

        Raises:
            MeshError: The rate is not positive.
        """
        if checked_fps(fps) == self.fps:
            return self

        count = int(np.floor((len(self) - 1) * fps / self.fps + 1e-6)) + 1

        def resample(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
            return BodyMotion(vertices, faces, self.fps).resampled(fps, count).vertices

        garments = tuple(RecordedGarment(g.rest, resample(g.vertices, g.rest.faces)) for g in self.garments)
        body = self.body.resampled(fps, count) if self.body is not None else None
        wind = self.wind
        if wind is not None:
            time = np.arange(count) * (self.fps / fps)
            wind = np.stack([np.interp(time, np.arange(len(wind)), column) for column in wind.T], axis=1)
        return replace(self, garments=garments, body=body, wind=wind, fps=fps, poses=None)


def recorded_garment(
    name: str, rest: np.ndarray, faces: np.ndarray, frames: np.ndarray, *, where: str, clean: bool = False
) -> RecordedGarment:
    """A garment from the arrays of a file, after checks.

    Args:
        name: Name of the garment, for messages and manifests.
        rest: Rest positions [m], shape [V, 3].
        faces: Vertex indices of triangles, shape [F, 3].
        frames: Positions [m], Y up, shape [T, V, 3].
        where: Name of the file, for messages.
        clean: Whether the rest mesh is repaired as by `Garment.cleaned_from`; the frames follow their vertices.

    Raises:
        MeshError: Numbers of vertices differ, a frame is not finite, or the mesh is not valid for a garment.
    """
    if frames.ndim != 3 or frames.shape[1:] != np.shape(rest):
        raise MeshError(
            f"{where}: the frames have shape {list(frames.shape)} and the rest mesh {list(np.shape(rest))}: "
            "they belong to different meshes."
        )
    if clean:
        rest, faces, went = clean_mesh(rest, faces)[:3]
        kept = np.flatnonzero(went >= 0)[::-1]  # backwards, so that of merged vertices the first one counts
        origin = np.empty(len(rest), dtype=np.int64)
        origin[went[kept]] = kept
        frames = frames[:, origin]
    bad = ~np.isfinite(frames).all(axis=(1, 2))
    if bad.any():
        which = np.flatnonzero(bad)
        listed = ", ".join(map(str, which[:5])) + (", ..." if len(which) > 5 else "")
        raise MeshError(
            f"{where}: {len(which):,} of {len(bad):,} frames of {name} hold NaN or infinity (frames {listed}). "
            "The simulation failed there or the file is damaged: leave this sample out."
        )
    try:
        garment = Garment(rest, faces, name=name)
    except MeshError as error:
        raise MeshError(f"{where}: {error} (Readers repair meshes if called with clean=True.)") from None
    return RecordedGarment(garment, np.ascontiguousarray(frames, dtype=np.float32))
