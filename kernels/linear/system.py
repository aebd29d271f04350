"""The constant part of sparse systems that are solved with one thread block per connected component."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch
import warp as wp


@wp.func
def block_sum(value: wp.float64) -> wp.float64:
    """Sum over the lanes of a block, returned to each lane. It is also a barrier: earlier writes are visible after."""
    return wp.tile_extract(wp.tile_sum(wp.tile(value)), 0)


class System(NamedTuple):
    """The constant part of the systems of a packed batch, on one device."""

    start: torch.Tensor
    """int32 [C+1], where the vertices of a component begin in `rows`."""
    rows: torch.Tensor
    """int32 [V], vertices sorted by component."""
    row_pointer: torch.Tensor
    column: torch.Tensor
    value: torch.Tensor
    """The matrix [V,V] in CSR form: int32 [V+1], int32 [N] and float64 [N] for N entries."""
    diagonal: torch.Tensor
    """float64 [V], diagonal of the matrix."""

    @classmethod
    def build(
        cls, matrix: scipy.sparse.csr_matrix, vertex_component: np.ndarray, count: int, device: torch.device
    ) -> System:
        """Moves a host matrix to the device.

        Args:
            matrix: Float64 [V,V]. No entry may join two components.
            vertex_component: Component of each vertex, [V], within [0, count).
            count: Number of components C.
            device: Device of the tensors.
        """
        matrix = matrix.tocsr()
        rows = np.argsort(vertex_component, kind="stable").astype(np.int32)
        start = np.searchsorted(vertex_component[rows], np.arange(count + 1)).astype(np.int32)
        host = (start, rows, matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data)
        return cls(*(torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in (*host, matrix.diagonal())))


def block_dim(device: torch.device, vertices: int, count: int) -> int:
    """Number of lanes of a block: one on the CPU; on a GPU more for large components than for small ones.

    Args:
        device: Device of the launch.
        vertices: Number of vertices of all components.
        count: Number of components.
    """
    if device.type == "cpu":
        return 256 if wp.config.enable_cpu_blocks else 1
    mean = vertices / max(count, 1)
    return 128 if mean < 256 else 256 if mean < 4096 else 512
