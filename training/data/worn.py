"""One garment of a sequence, on the body and in the wind of that sequence, in place of the whole outfit.

Simulations move each garment of an outfit by itself, with its own heading and its own mean. So networks that see one
garment at a time are trained on the garments one by one:

    sequence = Sequence.load(folder)
    shirt, jacket = (WornGarment(sequence, k) for k in range(len(sequence.layers)))
"""

from __future__ import annotations

import numpy as np

from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material

from .sequence import Layer, Sequence


class WornGarment:
    """One garment of a sequence; its attributes are those of a `Sequence` of one garment.

    Args:
        whole: The sequence.
        number: Number of the garment, from 0, the innermost one.

    Attributes:
        name: Name of the sequence, and of the garment if there are several.
        layers: The garment alone, with its own vertices and faces from 0 on.
        faces: Range of its faces in those of the sequence.
    """

    def __init__(self, whole: Sequence, number: int) -> None:
        self.whole, self.number = whole, number
        layer = whole.layers[number]
        self.name = f"{whole.name}/{layer.name}" if len(whole.layers) > 1 else whole.name
        self.faces = layer.faces
        vertices, faces = (slice(0, part.stop - part.start) for part in (layer.vertices, layer.faces))
        self.layers = (Layer(layer.name, layer.category, vertices, faces, layer.entry),)
        self._vertices = layer.vertices

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.whole.fps

    @property
    def vertices(self) -> np.ndarray:
        """Vertices of the garment [m], float32 [T,V,3]."""
        return self.whole.vertices[:, self._vertices]

    @property
    def garment(self) -> Garment:
        """The rest mesh."""
        return self.whole.worn[self.number]

    @property
    def worn(self) -> tuple[Garment, ...]:
        """The garment."""
        return (self.garment,)

    @property
    def materials(self) -> tuple[Material | None, ...]:
        """Its material; None where the manifest has none."""
        return (self.whole.materials[self.number],)

    @property
    def wind(self) -> np.ndarray | None:
        """Velocity of the air in each frame [m/s], float32 [T,3]; None for still air."""
        return self.whole.wind

    @property
    def collider_faces(self) -> np.ndarray:
        """Mask of the faces of the whole body with which cloth collides, bool [G]."""
        return self.whole.collider_faces

    def body(self) -> BodyMotion:
        """The part of the body with which cloth collides."""
        return self.whole.body()

    def body_in(self, frames: slice | list[int]) -> BodyMotion:
        """The whole body in the given frames."""
        return self.whole.body_in(frames)

    def body_vertices_in(self, frames: slice | list[int], used: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Vertices of the body in the given frames [m], [T,U,3], or those with the indices `used` alone."""
        return self.whole.body_vertices_in(frames, used)
