"""Sizes of a batch, from which its memory is predicted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from .body import BodyMotion
from .garment import Garment
from .pack import PackedBodies


class Sizes(NamedTuple):
    """Numbers of garments, vertices and faces of a batch, and of the bodies under it."""

    garments: int
    vertices: int
    faces: int
    body_vertices: int
    body_faces: int

    @classmethod
    def of(cls, garments: Sequence[Garment], bodies: PackedBodies | Sequence[BodyMotion]) -> Sizes:
        """Counts the garments, and the bodies under them, each once."""
        if isinstance(bodies, PackedBodies):
            body_vertices, body_faces = bodies.vertex_offsets[-1], bodies.face_offsets[-1]
        else:
            body_vertices = sum(body.vertices.shape[1] for body in bodies)
            body_faces = sum(len(body.faces) for body in bodies)
        vertices, faces = sum(len(g.vertices) for g in garments), sum(len(g.faces) for g in garments)
        return cls(len(garments), vertices, faces, body_vertices, body_faces)
