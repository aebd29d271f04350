"""What a user brings and what is simulated of it: seams are joined, small loose pieces ride on the cloth.

    brought --reduced--> simulated --rollout--> simulated --restored--> brought

Vertices that were joined are simulated once and copied to all of them; those of buttons are carried by the cloth below
them (`geometry/riding.py`). A garment without either is simulated as it is.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import numpy as np

from warpgarment.geometry.riding import Carried, Loose, loose_pieces

if TYPE_CHECKING:
    from .garment import Garment


class Simulated:
    """A garment as it is simulated, and the way back to all vertices that were brought.

    Args:
        brought: Positions of all vertices at rest [m], shape [U,3].
        garment: What is simulated, before its loose pieces are taken away; V vertices.
        went: The vertex of `garment` for each vertex that was brought, -1 for one that no face has, shape [U].

    Attributes:
        garment: What is simulated, V vertices.
        pieces: Number of loose pieces that ride on it.
        far: Number of pieces as small that are too far from it.
        riders: Vertices that ride, int64 [R].
    """

    def __init__(self, brought: np.ndarray, garment: Garment, went: np.ndarray) -> None:
        loose = loose_pieces(garment.vertices, garment.faces, garment.pins)
        cloth = loose.unit < 0
        self.garment = garment if cloth.all() else _cloth(garment, cloth)
        self.pieces, self.far = loose.pieces, loose.far
        number = np.where(cloth, np.cumsum(cloth) - 1, -1)
        self._source = np.where(went >= 0, number[went], -1)
        self.riders = np.flatnonzero(self._source < 0)
        self._as_it_is = len(self.riders) == 0 and np.array_equal(self._source, np.arange(len(garment.vertices)))
        shown = np.unique(self._source[self._source >= 0], return_index=True)[1]
        self._shown = np.flatnonzero(self._source >= 0)[shown]
        if len(self.riders):
            unit = _units(loose, went[self.riders])
            self._carried = Carried(brought[self.riders], unit, self.garment.vertices, self.garment.faces)

    @property
    def whole(self) -> bool:
        """Whether all vertices are simulated, each as itself."""
        return self._as_it_is

    def reduced(self, positions: np.ndarray) -> np.ndarray:
        """Positions [..., U, 3] of all vertices -> [..., V, 3] of those that are simulated."""
        return positions if self._as_it_is else positions[..., self._shown, :]

    def restored(self, positions: np.ndarray) -> np.ndarray:
        """Simulated positions of one frame [V,3] -> float32 [U,3] of all vertices."""
        if self._as_it_is:
            return positions
        result = positions[np.maximum(self._source, 0)]
        if len(self.riders):
            result[self.riders] = self._carried.at(positions)
        return result

    def from_frame(self, brought: np.ndarray) -> Simulated:
        """The same, whose loose pieces keep the places on the cloth that they have in a frame, not those at rest.

        Args:
            brought: Positions of all vertices in that frame [m], shape [U,3].
        """
        if not len(self.riders):
            return self
        other = copy.copy(self)
        other._carried = copy.copy(self._carried)
        other._carried.bind(brought[self.riders], self.reduced(brought))
        return other

    def message(self, what: str) -> str:
        """Sentences for a warning about `what`; empty where no piece is small."""
        said = []
        if self.pieces:
            said.append(
                f"{what} has {_count(self.pieces, 'small loose piece')} ({len(self.riders):,} vertices, such as "
                "buttons and zips): not simulated, but carried by the cloth below."
            )
        if self.far:
            said.append(
                f"{what} has {_count(self.far, 'small piece')} not connected with the rest and too far from it to be "
                "carried: simulated as cloth, which may drift away. Join or remove what should not."
            )
        return " ".join(said)


def _cloth(garment: Garment, cloth: np.ndarray) -> Garment:
    """The part of a garment that has the vertices of a mask [V]."""
    number = np.cumsum(cloth) - 1
    faces = number[garment.faces[cloth[garment.faces[:, 0]]]]
    return type(garment)(garment.vertices[cloth], faces, pins=number[garment.pins], name=garment.name)


def _units(loose: Loose, went: np.ndarray) -> np.ndarray:
    """Numbers of the rigid pieces of riding vertices, of which some (went < 0) belong to no face, without gaps [R]."""
    unit = np.where(went >= 0, loose.unit[went], len(loose.unit) + np.arange(len(went)))
    return np.unique(unit, return_inverse=True)[1].reshape(-1)


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"
