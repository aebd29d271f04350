"""What files hold, and what a file format is: the contract between `io.files` and the module of each format."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from warpgarment.errors import UsageError
from warpgarment.io.surface.record import Surface

UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "in": 0.0254}


class MeshData(NamedTuple):
    """What a file of a mesh holds, unchecked beyond the format.

    Attributes:
        vertices: Positions, shape [V,3].
        faces: Vertex indices, counter-clockwise seen from outside, shape [F,3].
        pins: Vertex indices, shape [P], in formats that keep them.
        name: Of the mesh inside the file; empty where it has none.
        surface: Its polygons, texture coordinates and materials; None: nothing that the triangles do not say. Where
            there is one, `faces` are its polygons as `triangulate_counts` cuts them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    pins: np.ndarray | None = None
    name: str = ""
    surface: Surface | None = None


class MotionData(NamedTuple):
    """What a file of a moving mesh holds, unchecked beyond the format.

    Attributes:
        vertices: Positions, shape [T,V,3].
        faces: Vertex indices, counter-clockwise seen from outside, shape [F,3].
        fps: Frames per second; None where the file does not say.
        collider_faces: Faces that take part in collisions, bool [F]; None: all.
        name: Of the mesh inside the file; empty where it has none.
        extra: Further arrays by name, in formats that keep them.
        step: How many frames of the rate lie between two of these, as the file says; `fps` is for one of them.
        start: Number of the first frame, in steps, counted from time 0; None where the file does not say.
        seconds: Time of the first frame [s], where the file says that in place of a number, or besides.
        last: When the last frame is reached, in frames after the first, where that is not T - 1.
        surface: As of `MeshData`.
        metres: Metres in a unit of the file, where reading it has shown that and `Format.holds` does not say.
        up: Axis that points up in the file, likewise.
    """

    vertices: np.ndarray
    faces: np.ndarray
    fps: float | None = None
    collider_faces: np.ndarray | None = None
    name: str = ""
    extra: Mapping[str, np.ndarray] = {}
    step: float = 1.0
    start: float | None = None
    seconds: float | None = None
    last: float | None = None
    surface: Surface | None = None
    metres: float | None = None
    up: str | None = None

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray, clock: Any, **more: Any) -> MotionData:
        """A motion with frames at the times of an `objects.clock.Clock`."""
        held = clock.last if clock.last != clock.frames - 1 else None
        return cls(vertices, faces, clock.fps, start=clock.number, seconds=clock.start, last=held, **more)


class ReadOptions(NamedTuple):
    """What the user says about a file.

    Attributes:
        mesh: Name of the mesh to read, where the file holds several; None: the only one.
        unit: Length unit of the file, a key of `UNITS`; None: the one that the file names, otherwise metres.
        up: Axis that points up in the file, "y" or "z"; None: the one that the file names, otherwise Y.
        shape: The body that a file of bones moves, as `warpgarment.bodies.shapes.shape_of` takes it.
        rest: Whether that body is wanted at rest, one frame, in place of its motion.
    """

    mesh: str | None = None
    unit: str | None = None
    up: str | None = None
    shape: Any = None
    rest: bool = False


class Holds(NamedTuple):
    """What a file says of itself.

    Attributes:
        names: Names of the objects (or, of OBJ without objects, groups) that have faces, each of which can be read.
        metres: Metres in its unit; None: it does not say.
        up: Axis that points up, "y" or "z"; None: it does not say.
    """

    names: tuple[str, ...] = ()
    metres: float | None = None
    up: str | None = None


class Format(NamedTuple):
    """A file format: four functions, each None where the format has no such thing.

    The functions that read get a path that exists. They return positions in metres where the file names its unit and
    `ReadOptions.unit` is None, otherwise in the numbers of the file, which `io.files` then scales; likewise with Y up
    where the file names its axis and `ReadOptions.up` is None, otherwise with the axes of the file. They raise
    MeshError, beginning with the path, for a file that is damaged, cut short or of another kind; the arrays are checked
    (indices in range, finite positions) by the objects made of them. A mesh is also a motion of one frame: a format
    whose motions are nothing more leaves `read_motion` out.

    The functions that write get metres, and make the file appear completely or not at all (see `io.disk.atomic`).

    Attributes:
        extra: The extra of this package that brings what the format needs; None: nothing more is needed.
        read_mesh: Reads a mesh at rest.
        write_mesh: Writes one.
        read_motion: Reads a mesh in motion.
        write_motion: Writes one.
        only_read: Suffixes of the format that are read and never written.
        axis: Whether the files say which axis is up, or the format does.
        holds: Lists what a file holds, without reading its positions; None: one object, without a name.
        named: Whether meshes in a file have names; otherwise `ReadOptions.mesh` is refused before reading.
        bones: Whether the files hold the motion of bones, which move the body of `ReadOptions.shape`.
        recognised: Whether a file is of this format, by what it holds, where another one has the same suffix.
    """

    extra: str | None = None
    read_mesh: Callable[[Path, ReadOptions], MeshData] | None = None
    write_mesh: Callable[[Path, MeshData], None] | None = None
    read_motion: Callable[[Path, ReadOptions], MotionData] | None = None
    write_motion: Callable[[Path, MotionData], None] | None = None
    only_read: tuple[str, ...] = ()
    named: bool = False
    axis: bool = False
    holds: Callable[[Path], Holds] | None = None
    bones: bool = False
    recognised: Callable[[Path], bool] | None = None


def scale_of(unit: str | None) -> float:
    """Metres in a unit; 1 for None.

    Raises:
        UsageError: An unknown unit.
    """
    if unit is None:
        return 1.0
    if unit not in UNITS:
        raise UsageError(f"unit must be one of {', '.join(UNITS)}, got {unit!r}")
    return UNITS[unit]
