"""The moving bodies of a batch, with one set of search trees that is updated when a caller needs other positions."""

from __future__ import annotations

import torch

from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.objects.pack import PackedBodies


class MovingBodies:
    """Packed bodies whose search trees are updated only if the positions differ from those of the last call.

    Args:
        vertices: Bodies in the first frame [m], packed, shape [U,3].
        packed: Topology of the bodies.

    Attributes:
        placed: The positions of the last update [m], shape [U,3]; None if they are not known.
    """

    def __init__(self, vertices: torch.Tensor, packed: PackedBodies) -> None:
        self._meshes = BodyMeshes(vertices, packed.faces, packed.vertex_offsets, packed.face_offsets)
        self.placed: torch.Tensor | None = vertices

    @property
    def moved(self) -> BodyMeshes:
        """The meshes where the last update left them."""
        return self._meshes

    def at(self, vertices: torch.Tensor) -> BodyMeshes:
        """The meshes of the bodies at these positions [m], shape [U,3]."""
        if self.placed is not vertices:
            self.placed = None  # an interrupt may leave them anywhere
            self._meshes.update(vertices)
            self.placed = vertices
        return self._meshes
