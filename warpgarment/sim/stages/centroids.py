"""The mean face centroid of each connected component: z in the paper, whose change from frame to frame is q."""

from __future__ import annotations

import torch

from warpgarment.kernels.deformation.face_means import FaceMeans
from warpgarment.objects.pack import PackedGarments


class ComponentCentroids:
    """Mean face centroids of the components of a batch.

    Args:
        packed: The batch.
    """

    def __init__(self, packed: PackedGarments) -> None:
        of = packed.face_component, packed.component_count, len(packed.rest_vertices), packed.vertex_component
        self._means = FaceMeans(packed.faces, *of)

    def __call__(self, vertices: torch.Tensor) -> torch.Tensor:
        """Positions [V,3] -> centroids [C,3], in metres; differentiable."""
        return self._means(vertices)
