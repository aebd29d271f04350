"""A garment in motion, the result of a rollout."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.checks import checked_faces, checked_fps, checked_positions
from warpgarment.io.surface.record import Surface

from .clock import Clock, between
from .status import RolloutStatus, Verdict


class GarmentMotion:
    """Positions of a garment over time, with one status per frame.

    Attributes:
        vertices: Positions [m], Y up, float32, shape [T,V,3]. A rollout that failed may hold NaN; see `status`.
        faces: Vertex indices, int32, shape [F,3].
        fps: Frames per second.
        status: One `RolloutStatus` per frame, or empty if the motion was not simulated.
        name: Name of the garment, for messages and file names.
        start: Time of the first frame [s].
        last: When the last frame is reached, in frames after the first, as in `BodyMotion`.
        surface: Polygons, texture coordinates, materials and groups of the garment's file, for `save`; None: triangles.

    Raises:
        MeshError: Shapes do not fit each other, an index is out of range, a time is none, or the number of statuses is
            neither zero nor the number of frames.
    """

    def __init__(
        self,
        vertices: Any,
        faces: Any,
        fps: float = 30.0,
        status: Sequence[RolloutStatus] = (),
        name: str = "",
        *,
        start: float = 0.0,
        last: float | None = None,
        surface: Surface | None = None,
    ):
        self.vertices = checked_positions(vertices, frames=True, finite=False)
        self.faces = checked_faces(faces, self.vertices.shape[1])
        _, self.fps, self.start, self.last = Clock.checked(len(self.vertices), fps, start, last)
        self.status = list(status)
        self.name = str(name)
        self.surface = surface
        if surface is not None:
            surface.check_vertices(self.vertices.shape[1])
        if self.status and len(self.status) != len(self.vertices):
            raise MeshError(f"{len(self.status)} statuses for {len(self.vertices)} frames. Give one a frame, or none.")

    def __repr__(self) -> str:
        frames, count = self.vertices.shape[:2]
        return f"GarmentMotion({self.name!r}, {frames:,} frames at {self.fps:g} fps, {count:,} vertices)"

    def __len__(self) -> int:
        return self.frames

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.vertices)

    @property
    def clock(self) -> Clock:
        """When the frames are."""
        return Clock.checked(self.frames, self.fps, self.start, self.last)

    def resampled(self, fps: float, frames: int | None = None) -> GarmentMotion:
        """The motion at another rate, as `BodyMotion.resampled`.

        Between two frames the status is the worse of theirs: how deep the cloth is there is not measured. A motion that
        ends with a frame of NaN does so again.

        Args:
            fps: New frames per second.
            frames: No more than so many of the new frames; None: all.

        Raises:
            MeshError: The rate is not positive, or so much higher than the motion's that the frames would fill memory.
        """
        if checked_fps(fps) == self.fps:
            return self
        clock, places = self.clock.resampled(fps, frames, points=self.vertices.shape[1])
        vertices = between(self.vertices, places)
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=(1, 2)))
        if len(bad) and not np.isfinite(self.vertices[-1]).all():
            vertices, places = vertices[: bad[0] + 1], places[: bad[0] + 1]
            clock = clock if len(vertices) == clock.frames else Clock.checked(len(vertices), fps, self.start)
        return self._on(clock, vertices, places)

    def on_clock(self, clock: Clock) -> GarmentMotion:
        """The motion at the frames of another clock, in a straight line between its own; before and after it stands
        still. Between two frames the status is the worse of theirs."""
        places = self.clock.places(clock.times)
        return self._on(clock, between(self.vertices, places), places)

    def _on(self, clock: Clock, vertices: np.ndarray, places: np.ndarray) -> GarmentMotion:
        status = []
        for frame, place in enumerate(places if self.status else ()):
            near = (self.status[int(np.floor(place))], self.status[int(np.ceil(place))])
            worse = max(near, key=lambda status: (not status.finite, status.max_penetration))
            status.append(replace(worse, frame=frame))
        times: dict[str, Any] = {"start": clock.start, "last": clock.last}
        return GarmentMotion(vertices, self.faces, clock.fps, status, self.name, **times, surface=self.surface)

    def save(self, path: str | os.PathLike) -> None:
        """Writes the motion, completely or not at all.

        - ``.npz``: positions, faces, rate, start [s], status and name; `load` reads all formats, this one without loss;
        - ``.usd``, ``.usda``, ``.usdc``: one mesh with a time sample per frame (extra ``usd``), Y up, metres; time
          codes are frames, and the first one is `start` x `fps`: 1001 for a shot that starts there;
        - ``.abc``: an Alembic archive (extra ``alembic``), with frames at their times in seconds;
        - ``.glb``, ``.gltf``: triangles with a morph target per frame, which an animation shows one after another, from
          `start` on;
        - ``.pc2``: a point cache, as of Blender, with the first frame as ``.obj`` of the same name beside it; the
          header says at which frame it starts;
        - ``.mdd``: the same for LightWave, Maya and Houdini, with the time of each frame in seconds;
        - no suffix, or a slash at the end: a folder ``frame_1001.obj``, ``frame_1002.obj``, ..., the first number being
          `start` x `fps` (with a warning where that is not whole); an existing folder is replaced if it holds nothing
          else.

        Polygons, texture coordinates, materials (base colour, opacity, name of a picture) and groups that were read
        with the garment are written too, in the order of its file; materials of OBJ into a .mtl beside it. glTF has
        triangles alone and neither objects nor groups. A warning says in one line what a format leaves out.

        Args:
            path: File or folder to write; parent folders are made.

        Raises:
            ValueError: The suffix is not one of these.
            FileExistsError: The folder holds files that are not frames.
            OutputError: The disk is full, or cannot be written to; what was there before stays.
            MissingExtra: The format is USD and the extra is not installed (``pip install "warpgarment[usd]"``).
        """
        from warpgarment.io.data import MotionData
        from warpgarment.io.files import write_motion

        name, extra = self.name or "garment", self._status_arrays()
        motion = MotionData.of(self.vertices, self.faces, self.clock, name=name, extra=extra, surface=self.surface)
        write_motion(path, motion)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        *,
        unit: str | None = None,
        fps: float | None = None,
        mesh: str | None = None,
        up: str | None = None,
    ) -> GarmentMotion:
        """Reads what `save` wrote, in any of its formats; only .npz keeps the statuses, the name and all of the time.

        Args:
            path: File or folder.
            unit: Length unit of the file: "m", "dm", "cm", "mm" or "in". None keeps the numbers, except that USD files
                are converted by their own `metersPerUnit` and `upAxis`.
            fps: Overrides the file's rate; 30, with a warning, where neither says, as .pc2 and folders of .obj do not.
            mesh: See `BodyMotion.load`; None reads all objects of a folder of OBJ or of a .pc2's mesh as one.
            up: See `BodyMotion.load`.

        Raises:
            MeshError: The file is not of its kind, is damaged, or has no rate.
            FileNotFoundError: There is no such file.

        Warns:
            UserWarning: Frames hold NaN or infinity without a status that says so.
        """
        from warpgarment.io.files import rate_of, read_motion, start_of, whole_output

        path = Path(path)
        data = read_motion(path, unit=unit, mesh=whole_output(path, mesh), up=up)
        if path.suffix.lower() == ".npz" and data.fps is None and fps is None:
            raise MeshError(f"{path}: no array named 'fps'; it is not what GarmentMotion.save writes. Give fps=.")
        rate = rate_of(path, data, fps)
        try:
            status: list[RolloutStatus] = []
            if "status_finite" in data.extra:
                verdicts = [Verdict(str(v)) for v in data.extra["status_verdict"]]
                columns = [data.extra[f"status_{key}"].tolist() for key in _STATUS]
                met = [_optional(data.extra.get(f"status_{key}"), kind, len(verdicts)) for key, kind in _MET.items()]
                rows = zip(*columns, verdicts, *met, strict=True)
                status = [RolloutStatus(*row) for row in rows]
            name = str(data.extra["name"]) if "name" in data.extra else path.stem
            times: dict[str, Any] = {"start": start_of(data, rate), "last": data.last}
            motion = cls(data.vertices, data.faces, rate, status, name, **times, surface=data.surface)
        except (MeshError, KeyError, ValueError, TypeError) as error:
            raise MeshError(f"{path}: {error}") from None
        said = np.array([not one.finite for one in status] or [False] * motion.frames)
        bad = ~np.isfinite(motion.vertices).all(axis=(1, 2)) & ~said
        if bad.any():
            warnings.warn(
                f"{path}: {bad.sum():,} of {motion.frames:,} frames hold NaN or infinity (first: frame "
                f"{int(bad.argmax())}), and the file does not say that a rollout failed. It may be damaged.",
                UserWarning,
                stacklevel=2,
            )
        return motion

    def _status_arrays(self) -> dict[str, np.ndarray]:
        arrays = {"name": np.array(self.name)}
        if self.status:
            for key in _STATUS:
                arrays[f"status_{key}"] = np.array([getattr(s, key) for s in self.status])
            for key in _MET:
                values = [getattr(s, key) for s in self.status]
                if any(value is not None for value in values):
                    arrays[f"status_{key}"] = np.array([np.nan if v is None else v for v in values], np.float64)
            arrays["status_verdict"] = np.array([s.verdict.value for s in self.status])
        return arrays


def _optional(values: np.ndarray | None, kind: type, count: int) -> list[Any]:
    """Numbers of a figure that may be missing, with None for NaN or where there is no array."""
    return [None] * count if values is None else [None if np.isnan(v) else kind(v) for v in values]


_MET = {"layer_crossings": int, "self_crossings": int, "lag": float}  # figures that are None where not measured
_STATUS = ("frame", "finite", "max_penetration", "poisson_iterations", "collision_iterations")
