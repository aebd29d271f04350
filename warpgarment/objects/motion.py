"""A garment in motion, the result of a rollout."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.geometry.checks import checked_faces, checked_fps, checked_positions

from .status import RolloutStatus, Verdict


class GarmentMotion:
    """Positions of a garment over time, with one status per frame.

    Attributes:
        vertices: Positions [m], Y up, float32, shape [T,V,3]. A rollout that failed may hold NaN; see `status`.
        faces: Vertex indices, int32, shape [F,3].
        fps: Frames per second.
        status: One `RolloutStatus` per frame, or empty if the motion was not simulated.
        name: Name of the garment, for messages and file names.

    Raises:
        MeshError: Shapes do not fit each other, an index is out of range, or the number of statuses is neither zero
            nor the number of frames.
    """

    def __init__(
        self, vertices: Any, faces: Any, fps: float = 30.0, status: Sequence[RolloutStatus] = (), name: str = ""
    ):
        self.vertices = checked_positions(vertices, frames=True, finite=False)
        self.faces = checked_faces(faces, self.vertices.shape[1])
        self.fps = checked_fps(fps)
        self.status = list(status)
        self.name = str(name)
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

    def save(self, path: str | os.PathLike) -> None:
        """Writes the motion, completely or not at all.

        - ``.npz``: positions, faces, rate, status and name; `load` reads all formats, this one without loss;
        - ``.usd``, ``.usda``, ``.usdc``: one mesh with a time sample per frame (extra ``usd``), Y up, metres;
        - ``.pc2``: a point cache, as of Blender, with the first frame as ``.obj`` of the same name beside it;
        - no suffix, or a slash at the end: a folder ``frame_0000.obj``, ``frame_0001.obj``, ...; an existing folder is
          replaced if it holds nothing else.

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
        write_motion(path, MotionData(self.vertices, self.faces, self.fps, name=name, extra=extra))

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
        """Reads what `save` wrote, in any of its formats; only .npz keeps the statuses and the name.

        Args:
            path: File or folder.
            unit: Length unit of the file: "m", "dm", "cm", "mm" or "in". None keeps the numbers, except that USD files
                are converted by their own `metersPerUnit` and `upAxis`.
            fps: Overrides the file's rate; 30, with a warning, where neither says, as .pc2 and folders of .obj do not.
            mesh: See `BodyMotion.load`.
            up: See `BodyMotion.load`.

        Raises:
            MeshError: The file is not of its kind, is damaged, or has no rate.
            FileNotFoundError: There is no such file.
        """
        from warpgarment.io.files import rate_of, read_motion

        path = Path(path)
        data = read_motion(path, unit=unit, mesh=mesh, up=up)
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
            return cls(data.vertices, data.faces, rate, status, name)
        except (MeshError, KeyError, ValueError, TypeError) as error:
            raise MeshError(f"{path}: {error}") from None

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
