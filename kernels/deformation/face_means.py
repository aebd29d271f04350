"""Mean face centroids of garments or of their connected components: z of the paper, in one launch.

Manifold-aware transformers, section 4.2 (c_i - z) and 4.3 (q is the change of z from frame to frame).

    z_s = 1/|F_s| Σ_{i in F_s} (v_i0 + v_i1 + v_i2) / 3

Summed in float64, since sums of 10^5 coordinates lose digits in float32, and always in the same order.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgarment.kernels import compiling
from warpgarment.kernels.launch import as_argument, as_warp, expect, launch_tiled, torch_stream
from warpgarment.kernels.operator import allocate

wp.set_module_options(compiling.options())

LANES = 256
"""Threads that share a segment on a GPU."""


@wp.kernel(enable_backward=False)
def face_means_kernel(
    # Model:
    faces: wp.array[wp.vec3i],
    offsets: wp.array[wp.int32],
    # In:
    vertices: wp.array[wp.vec3],
    # Out:
    means: wp.array[wp.vec3],
):
    segment, lane = wp.tid()
    first = offsets[segment]
    last = offsets[segment + 1]
    total = wp.vec3d()
    for k in range(first + lane, last, wp.block_dim()):
        face = faces[k]
        total += wp.vec3d(vertices[face[0]]) + wp.vec3d(vertices[face[1]]) + wp.vec3d(vertices[face[2]])
    corners = wp.float64(wp.max(3 * (last - first), 1))
    x = wp.tile_extract(wp.tile_sum(wp.tile(total[0])), 0)
    y = wp.tile_extract(wp.tile_sum(wp.tile(total[1])), 0)
    z = wp.tile_extract(wp.tile_sum(wp.tile(total[2])), 0)
    if lane == 0:
        means[segment] = wp.vec3(wp.vec3d(x, y, z) / corners)


class FaceMeans:
    """Means over segments of the faces of packed meshes.

    Args:
        faces: Packed vertex indices, int32 [F, 3].
        segment: Segment of each face, int32 [F], within [0, count).
        count: Number of segments.
        vertex_count: Number of vertices V.
        segment_of_vertex: Segment of all faces of a vertex, int32 [V], for gradients; None: there are none.

    Raises:
        TypeError, ValueError: Wrong dtypes, shapes or devices; faces or segments out of range.
    """

    def __init__(
        self,
        faces: torch.Tensor,
        segment: torch.Tensor,
        count: int,
        vertex_count: int,
        segment_of_vertex: torch.Tensor | None = None,
    ) -> None:
        expect("faces", faces, (None, 3), torch.int32)
        expect("segment", segment, (len(faces),), torch.int32, faces.device)
        for name, values, limit in (("faces", faces, vertex_count), ("segment", segment, count)):
            if len(faces) and not (int(values.min()) >= 0 and int(values.max()) < limit):
                raise ValueError(f"{name} must lie within [0, {limit}), got {int(values.min())} to {int(values.max())}")
        order = torch.argsort(segment, stable=True)
        ends = torch.bincount(segment.long(), minlength=count).cumsum(0)
        self.device = faces.device
        self._faces = as_warp(faces[order], wp.vec3i)
        self._offsets = as_warp(torch.cat([ends.new_zeros(1), ends]).int(), wp.int32)
        self.count, self.vertex_count = count, vertex_count
        self._corners, self._segment, self._of_vertex = faces, segment, segment_of_vertex

    def __call__(self, vertices: torch.Tensor) -> torch.Tensor:
        """Means of the face centroids of each segment.

        Args:
            vertices: Positions [m], float32 [V, 3].

        Returns:
            Means [m], float32 [count, 3]; zero for a segment without faces. Differentiable in the positions, if the
            segments of vertices are known.
        """
        if self._of_vertex is not None and vertices.requires_grad and torch.is_grad_enabled():
            means: torch.Tensor = _Means.apply(vertices, self)
            return means
        return self._launched(vertices)

    @cached_property
    def share(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The share of each vertex in the mean of its segment, float32 [V, 1], and that segment, int64 [V]."""
        assert self._of_vertex is not None  # as gradients are asked for
        uses = torch.bincount(self._corners.reshape(-1).long(), minlength=self.vertex_count)
        faces = torch.bincount(self._segment.long(), minlength=self.count)
        owner = self._of_vertex.long()
        return (uses / (3.0 * faces.clamp(min=1))[owner]).float()[:, None], owner

    def _launched(self, vertices: torch.Tensor) -> torch.Tensor:
        vertices = vertices.detach()
        expect("vertices", vertices, (self.vertex_count, 3), device=self.device)
        means = allocate((self.count, 3), torch.float32, self.device)
        if self.count:
            with torch_stream(self.device) as warp_device:
                given = [self._faces, self._offsets, as_argument(vertices, wp.vec3), as_argument(means, wp.vec3)]
                launch_tiled(face_means_kernel, self.count, given, warp_device, block_dim=LANES)
        return means


class _Means(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, vertices: torch.Tensor, means: FaceMeans) -> torch.Tensor:
        ctx.means = means
        return means._launched(vertices)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        share, owner = ctx.means.share
        return share * gradient[owner], None
