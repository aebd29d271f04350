"""The constant part of sparse systems that are solved with one thread block per connected component."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch
import warp as wp


@wp.func
def block_sum(value: wp.float64) -> wp.float64:
    """Sum over the lanes of a block, handed to all; also a barrier: what was written before is visible after."""
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
    diagonal: torch.Tensor

    @classmethod
    def build(
        cls, matrix: scipy.sparse.csr_matrix, vertex_component: np.ndarray, count: int, device: torch.device
    ) -> System:
        """Moves a host matrix [V,V] to the device. No entry may join two components."""
        matrix = matrix.tocsr()
        rows = np.argsort(vertex_component, kind="stable").astype(np.int32)
        start = np.searchsorted(vertex_component[rows], np.arange(count + 1)).astype(np.int32)
        host = (start, rows, matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32), matrix.data)
        return cls(*(torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in (*host, matrix.diagonal())))


def block_dim(device: torch.device, vertices: int, count: int) -> int:
    """Lanes of a block: the CPU has one; a GPU takes more for large components than for small ones."""
    if device.type == "cpu":
        return 256 if wp.config.enable_cpu_blocks else 1
    mean = vertices / max(count, 1)
    return 128 if mean < 256 else 256 if mean < 4096 else 512
