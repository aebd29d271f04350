"""The surface of garments between their vertices, where the body must not come through.

Collision refinement moves vertices. Between vertices that are all outside, a round or a pointed body can still come
through an edge or a face, and an onlooker sees it. There, the corners are made to keep a larger distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.surface_depth import SurfaceDepth, surface_depth
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

AMPLE = 1.5  # corners are moved by this multiple of the depth between them, since a corner that is far does not follow


class Surface:
    """Edges and faces of a batch.

    Args:
        garments: In the order of the batch.
        packed: The same, packed.
    """

    def __init__(self, garments: Sequence[Garment], packed: PackedGarments) -> None:
        device = packed.faces.device
        starts = packed.vertex_offsets[:-1]
        edges = np.concatenate([garment.edges + start for garment, start in zip(garments, starts, strict=True)])
        self._edges = torch.from_numpy(edges.astype(np.int32)).to(device)
        self._packed = packed

    def depth(self, vertices: torch.Tensor, bodies: BodyMeshes, body_of_vertex: torch.Tensor) -> SurfaceDepth:
        """How deep vertices [V,3], edges and faces are in the bodies."""
        packed = self._packed
        return surface_depth(
            vertices, bodies, body_of_vertex, self._edges, packed.faces, packed.garment_of_vertex, packed.count
        )


def distance_to_keep(
    epsilon: torch.Tensor,
    missing: torch.Tensor,
    vertices: torch.Tensor,
    bodies: BodyMeshes,
    body_of_vertex: torch.Tensor,
) -> torch.Tensor:
    """Distances from the body at which nothing of it comes through edges and faces.

    Args:
        epsilon: Distance that each vertex is to keep now [m], float32 [V].
        missing: How much deeper edges and faces are than their corners, see `SurfaceDepth` [m], float32 [V].
        vertices: Positions that this is said of [m], float32 [V,3].
        bodies: The bodies in the same frame.
        body_of_vertex: Body of each vertex, int32 [V].

    Returns:
        Float32 [V]: `epsilon`; or if that is more, where something is missing, the vertex's distance from the body now
        and `AMPLE` times what is missing.
    """
    body = torch.where(missing > 0, body_of_vertex, -1)
    wanted = bodies.query(vertices.detach(), body).distance + AMPLE * missing
    return torch.where(wanted > epsilon, wanted, epsilon)  # NaN where nothing was asked
