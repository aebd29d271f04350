"""The bodies of a batch in motion: one set of search trees, which follow wherever they are needed."""

from __future__ import annotations

import torch

from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.objects.pack import PackedBodies


class MovingBodies:
    """Packed bodies whose search trees are moved only if the last caller had them elsewhere.

    Args:
        vertices: Bodies in the first frame [m], packed, shape [U,3].
        packed: Topology of the bodies.

    Attributes:
        placed: The positions to which the trees were last moved; None where that is not known.
    """

    def __init__(self, vertices: torch.Tensor, packed: PackedBodies) -> None:
        self._meshes = BodyMeshes(vertices, packed.faces, packed.vertex_offsets, packed.face_offsets)
        self.placed: torch.Tensor | None = vertices

    def at(self, vertices: torch.Tensor) -> BodyMeshes:
        """The meshes of the bodies at these positions [m], shape [U,3]."""
        if self.placed is not vertices:
            self._meshes.update(vertices)
            self.placed = vertices
        return self._meshes
