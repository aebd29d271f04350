"""How a file was read: which of its objects, in which unit and axis, and where its rate came from."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from warpgarment.errors import MeshError

from .data import UNITS, Holds, MotionData
from .files import format_of

GIVEN, FILE, ASSUMED, FITTED = "given", "from the file", "assumed", "by the legs"


class Source(NamedTuple):
    """How a file was read. Where something comes from is "given", "from the file", "assumed" or, of BVH, "by the legs".

    Attributes:
        path: The file or folder.
        mesh: Name of the object that was asked for; None: there was no need to.
        names: Names of the objects that the file holds.
        metres: Metres in a unit of the file.
        metres_from: Where that comes from.
        up: Axis that points up in the file, "y" or "z".
        up_from: Where that comes from.
        fps_from: Where the rate comes from; empty for a single frame.
    """

    path: Path
    mesh: str | None
    names: tuple[str, ...]
    metres: float
    metres_from: str
    up: str
    up_from: str
    fps_from: str = ""

    @property
    def unit(self) -> str:
        """The unit's name, or its length in metres where it has none."""
        return next((name for name, metres in UNITS.items() if metres == self.metres), f"{self.metres:g} m")


def holds(path: Path) -> Holds:
    """What a file says of itself: names of objects, unit and axis; nothing where it cannot be read."""
    suffix = "" if path.is_dir() else path.suffix.lower()
    format = format_of(suffix)
    if format is None or format.holds is None:
        return Holds()
    try:
        return format.holds(path)
    except MeshError:
        return Holds()


def source_of(
    path: Path,
    *,
    unit: str | None = None,
    mesh: str | None = None,
    up: str | None = None,
    fps: float | None = None,
    file_fps: float | None = None,
    frames: int = 1,
    data: MotionData | None = None,
) -> Source:
    """How a file was read, from what the user said and what the file says.

    Args:
        path: The file or folder.
        unit: As in `Garment.load`, and so are `mesh` and `up`.
        mesh: Name that was given.
        up: Axis that was given.
        fps: Rate that was given.
        file_fps: Rate that the file has.
        frames: Number of frames that were read.
        data: What was read.
    """
    found, origin = holds(path), FILE
    if data is not None and (data.metres, data.up) != (None, None):
        found, origin = found._replace(metres=data.metres, up=data.up), FILE if data.metres == 1.0 else FITTED
    metres = UNITS[unit] if unit else found.metres
    axis = up or found.up
    rate = GIVEN if fps is not None else FILE if file_fps is not None else ASSUMED
    return Source(
        path,
        mesh,
        found.names,
        1.0 if metres is None else metres,
        GIVEN if unit else ASSUMED if metres is None else origin,
        axis or "y",
        GIVEN if up else FILE if axis else ASSUMED,
        rate if frames > 1 else "",
    )
