"""Where a garment must be outside the body: at its vertices, at two points of every edge and in the middle of faces.

Collision refinement moves vertices. Between vertices that are all outside, a round or a pointed body can still come
through an edge or a face, and an onlooker sees it. There, the corners are made to keep a larger distance.
"""

from __future__ import annotations

import torch

from warpgarment.kernels.body_meshes import BodyMeshes

AMPLE = 1.5  # corners are moved by this multiple of the depth between them, since a corner that is far does not follow


class SurfacePoints:
    """Points of a packed batch of garments, N in all: vertices, thirds of edges, middles of faces.

    Args:
        faces: Vertex indices, int32 [F,3].
        garment_of_vertex: Owners, int32 [V].
        body_of_vertex: Body of each vertex, int32 [V].
        count: Number of garments B.
    """

    def __init__(
        self, faces: torch.Tensor, garment_of_vertex: torch.Tensor, body_of_vertex: torch.Tensor, count: int
    ) -> None:
        self._faces = faces.long()
        self._edges = torch.unique(self._faces[:, [0, 1, 1, 2, 2, 0]].view(-1, 2).sort(dim=1).values, dim=0)
        owner = torch.cat([self._edges[:, 0], self._edges[:, 0], self._faces[:, 0]])
        self._garment = torch.cat([garment_of_vertex, garment_of_vertex[owner]]).long()
        self._body = torch.cat([body_of_vertex, body_of_vertex[owner]])
        self._sizes = [len(garment_of_vertex), len(self._edges), len(self._edges), len(self._faces)]
        self._count = count

    def at(self, vertices: torch.Tensor) -> torch.Tensor:
        """Positions of the points, [V,3] -> [N,3]."""
        start, end = vertices[self._edges].unbind(1)
        third = (end - start) / 3
        return torch.cat([vertices, start + third, end - third, vertices[self._faces].mean(dim=1)])

    def depth(self, vertices: torch.Tensor, bodies: BodyMeshes, asked: torch.Tensor | None = None) -> torch.Tensor:
        """How deep each point is inside its body [m], float32 [N], zero outside.

        Args:
            vertices: Positions [m], float32 [V,3].
            bodies: The bodies, in the same frame.
            asked: Garments whose points are looked at, bool [B]; those of the others get zero. None: all.
        """
        body = self._body if asked is None else torch.where(asked[self._garment], self._body, -1)
        distance = bodies.query(self.at(vertices.detach()), body, within=0.0).distance
        return torch.nan_to_num(-distance, nan=0.0).clamp(min=0.0)

    def deepest(self, depth: torch.Tensor) -> torch.Tensor:
        """The largest depth of each garment [m], [N] -> [B]."""
        return depth.new_zeros(self._count).scatter_reduce(0, self._garment, depth, "amax")

    def distance_to_keep(
        self, epsilon: torch.Tensor, depth: torch.Tensor, vertices: torch.Tensor, bodies: BodyMeshes
    ) -> torch.Tensor:
        """Distances from the body at which nothing of it comes through edges and faces.

        Args:
            epsilon: Distance that each vertex is to keep now [m], float32 [V].
            depth: Of the points at `vertices` [m], float32 [N].
            vertices: Positions [m], float32 [V,3].
            bodies: The bodies, in the same frame.

        Returns:
            Float32 [V]: `epsilon`, or if that is more the vertex's distance now and `AMPLE` times the depth around it,
            where edges and faces are deeper than their corners.
        """
        missing = self._between(depth)
        body = torch.where(missing > 0, self._body[: len(missing)], -1)
        wanted = bodies.query(vertices.detach(), body).distance + AMPLE * missing
        return torch.where(wanted > epsilon, wanted, epsilon)  # NaN where nothing was asked

    def _between(self, depth: torch.Tensor) -> torch.Tensor:
        """How much deeper edges and faces at a vertex are than their corners [m], [N] -> [V]."""
        corners, *others = depth.split(self._sizes)
        deeper = torch.zeros_like(corners)
        for ends, inner in zip((self._edges, self._edges, self._faces), others, strict=True):
            more = (inner - corners[ends].amax(dim=1)).clamp(min=0.0)
            deeper = deeper.scatter_reduce(0, ends.flatten(), more.repeat_interleave(ends.shape[1]), "amax")
        return deeper
