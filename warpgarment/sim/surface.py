"""Depth of garments in the body between their vertices, and the distance of vertices that removes it.

Collision refinement moves vertices. Between vertices that are all outside, a round or a pointed body can still come
visibly through an edge or a face. The corners of such edges and faces must keep a larger distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.kernels.sdf.surface_depth import SurfaceDepth, surface_depth
from warpgarment.kernels.sdf.vertex_depth import Measured, measured
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

REACH = 0.75  # of a mean edge, to which distances of vertices are looked for: balls of that radius hold most faces
AMPLE = 1.5  # corners are moved by this multiple of the depth between them, since a corner that is far does not follow


class Surface:
    """Edges and faces of a batch, of which the depth is measured.

    Args:
        garments: The garments, in the order of the batch.
        packed: The same garments, packed.
    """

    def __init__(self, garments: Sequence[Garment], packed: PackedGarments) -> None:
        device = packed.faces.device
        starts = packed.vertex_offsets[:-1]
        edges = np.concatenate([garment.edges + start for garment, start in zip(garments, starts, strict=True)])
        self._edges = torch.from_numpy(edges.astype(np.int32)).to(device)
        self._packed = packed
        one, other = packed.rest_vertices[self._edges.long()].unbind(1)
        length = (one - other).norm(dim=1)
        self._limit = REACH * float(length.mean()) if len(length) else 0.0

    def measured(self, vertices: torch.Tensor, bodies: BodyMeshes, body_of_vertex: torch.Tensor) -> Measured:
        """Depths of vertices [V,3] alone, and the balls around those that are outside."""
        return measured(vertices, bodies, body_of_vertex, limit=self._limit)

    def depth(
        self,
        vertices: torch.Tensor,
        bodies: BodyMeshes,
        body_of_vertex: torch.Tensor,
        before: Measured | None = None,
    ) -> SurfaceDepth:
        """Depth of vertices [V,3], edges and faces in the bodies [m]; `before` is that of `surface_depth`."""
        packed = self._packed
        return surface_depth(
            vertices,
            bodies,
            body_of_vertex,
            self._edges,
            packed.faces,
            packed.garment_of_vertex,
            packed.count,
            limit=self._limit,
            before=before,
        )


def distance_to_keep(
    epsilon: torch.Tensor,
    missing: torch.Tensor,
    vertices: torch.Tensor,
    bodies: BodyMeshes,
    body_of_vertex: torch.Tensor,
) -> torch.Tensor:
    """Distances that vertices must keep, so that the body does not come through edges and faces.

    Args:
        epsilon: Distance that each vertex is to keep now [m], float32 [V].
        missing: Depth of edges and faces beyond that of their corners, see `SurfaceDepth` [m], float32 [V].
        vertices: Positions at which `missing` was measured [m], float32 [V,3].
        bodies: The bodies in the same frame.
        body_of_vertex: Body of each vertex, int32 [V].

    Returns:
        Distances [m], float32 [V]: `epsilon`; where `missing` is positive, the vertex's distance from the body now plus
        `AMPLE` times `missing`, if that is more.
    """
    body = torch.where(missing > 0, body_of_vertex, -1)
    wanted = bodies.query(vertices.detach(), body).distance + AMPLE * missing
    return torch.where(wanted > epsilon, wanted, epsilon)  # the query gives NaN for body -1
