"""What a mesh or a motion is, in figures: what is shown before a simulation, so that a wrong unit is seen before it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warpgarment.geometry.riding import loose_pieces
from warpgarment.geometry.seams import coinciding_borders
from warpgarment.io.source import Source

from .body import BodyMotion
from .garment import Garment
from .motion import GarmentMotion


class Facts(NamedTuple):
    """Figures of a garment, a body or a motion.

    Attributes:
        source: How its file was read; None where it was made of arrays.
        pieces: Number of connected pieces, joined seams being connections.
        vertices: Number of vertices.
        faces: Number of faces.
        size: Sides of the bounding box of the first frame along X, Y and Z [m].
        frames: Number of frames.
        fps: Frames per second; None for a mesh at rest.
        open_seams: Vertices on open borders that lie where others do, and are not joined with them.
        joined: Vertices that are simulated as one with another, since a seam was joined.
        riding: Small loose pieces, which in a garment ride on the cloth.
    """

    source: Source | None
    pieces: int
    vertices: int
    faces: int
    size: tuple[float, float, float]
    frames: int = 1
    fps: float | None = None
    open_seams: int = 0
    joined: int = 0
    riding: int = 0

    @property
    def seconds(self) -> float:
        """Duration from the first frame to the last [s]."""
        return (self.frames - 1) / self.fps if self.fps else 0.0

    @classmethod
    def of(cls, what: Garment | BodyMotion | GarmentMotion) -> Facts:
        """Figures of a garment, a body or a motion."""
        source = getattr(what, "source", None)
        if isinstance(what, Garment):
            simulated = what.simulated
            joined = len(what.vertices) - len(simulated.riders) - len(simulated.garment.vertices)
            found = cls.measured(what.vertices[None], what.faces, source=source)
            return found._replace(
                pieces=what.components[2],
                open_seams=0 if joined else found.open_seams,
                joined=joined,
                riding=simulated.pieces,
            )
        return cls.measured(what.vertices, what.faces, what.fps, source)

    @classmethod
    def measured(
        cls, vertices: np.ndarray, faces: np.ndarray, fps: float | None = None, source: Source | None = None
    ) -> Facts:
        """Figures of positions [m], shape [T,V,3], and faces [F,3]; what has indices out of range has no pieces."""
        from warpgarment.kernels.mesh.laplacian import components  # loads torch

        first = np.asarray(vertices[0], np.float64)
        finite = first[np.isfinite(first).all(axis=1)]
        x, y, z = np.ptp(finite, axis=0).tolist() if len(finite) else (0.0, 0.0, 0.0)
        sound = len(finite) == len(first) and len(faces) > 0 and faces.min() >= 0 and faces.max() < len(first)
        return cls(
            source,
            components(len(first), faces)[2] if sound else 0,
            len(first),
            len(faces),
            (x, y, z),
            len(vertices),
            fps,
            open_seams=coinciding_borders(first, faces).sides if sound else 0,
            riding=loose_pieces(first, faces).pieces if sound else 0,
        )
