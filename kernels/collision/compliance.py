"""Compliance matrices of a batch, for a collision refinement with one unknown per contact.

Supplement section 2 solves (B ⊗ I₃ + N Nᵀ) D = N c, where N has one column with n_i for each contact. B is constant for
a garment. With its inverse Z, the compliance, there is one unknown per contact instead of three per vertex,

    (I + S) y = c,    S_ij = n_i·n_j Z_ij,    D = Z N y

(push-through identity), where y_i = c_i - n_i·D_i is the force of contact i. Conjugate gradients need tens of steps for
this system and hundreds for that of D. A diagonal preconditioner does not help, since S_ii hardly varies. All
eigenvalues of I + S are at least 1, so the residual bounds the error, in y and in D:

    |δD|_B² = δyᵀ S δy ≤ δyᵀ (I + S) δy ≤ |c - (I + S) y|²

Z is dense, so it is used for components of moderate size: by forces_inverse_gpu.py on a GPU, and by
forces_inverse_cpu.py on a CPU.

| symbol | code | what |
| --- | --- | --- |
| Z | `compliance` | float32, one block per component, one after the other; equal components share a block |
| n_i | `normal` | [V,3]; zero where there is no contact |
| c_i | `gap` | [V], distance [m] by which a vertex is too close, along the normal |
| y_i | `force` | [V], zero where there is no contact |
| S | `coupling` | float32 scratch, of the size of Z |
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch

from warpgarment.kernels import kept
from warpgarment.kernels.linear.factor import component_blocks
from warpgarment.kernels.linear.system import System

LARGEST = 2048
"""Largest number of vertices of a component with a compliance matrix (16 MB)."""
BUDGET = 2**28
"""Largest number of entries of all compliance matrices of a batch (1 GiB, and the same for scratch in a solve)."""


class Compliance(NamedTuple):
    """Compliance matrices of a packed batch, on one device."""

    base: torch.Tensor
    """int64 [C], first entry of the block of each component in `values`; -1 for a component without a block."""
    room: torch.Tensor
    """int64 [C], first entry of the scratch of each component; components never share scratch."""
    wide: torch.Tensor
    """int32 [C], first panel of each component, where its vertices are divided into padded panels of sixteen."""
    scratch: int
    """Number of entries of the scratch of all components."""
    inverted: int
    """Number of components with a block."""
    panels: int
    """Number of panels of all components."""
    local: torch.Tensor
    """int32 [V], index of a vertex within its component."""
    values: torch.Tensor
    """float32, the blocks, row by row; rows are padded with zeros to a multiple of sixteen."""

    @classmethod
    def build(cls, matrix: scipy.sparse.csr_matrix, system: System, largest: int, budget: int) -> Compliance:
        """Inverts diagonal blocks of B, [V,V], with at most `largest` vertices, as far as `budget` entries allow."""
        device = system.value.device
        rows, start = system.rows.cpu().numpy(), system.start.cpu().numpy()
        local = np.empty(len(rows), np.int32)
        sizes = np.diff(start)
        local[rows] = np.arange(len(rows)) - np.repeat(start[:-1], sizes)
        base, room = np.full(len(sizes), -1, np.int64), np.zeros(len(sizes), np.int64)
        blocks: list[torch.Tensor] = []
        known: dict[tuple, int] = {}
        used = needed = 0
        for c, (key, block) in enumerate(component_blocks(matrix, system)):
            size, pitch = block.shape[0], _pitch(block.shape[0])
            if size > largest or needed + size * pitch > budget:
                continue
            if key not in known:
                make = partial(_inverted, block, int(pitch - size), device)
                blocks.append(kept.of("compliance", (*key, str(device)), make))
                known[key], used = used, used + size * pitch
            base[c], room[c], needed = known[key], needed, needed + size * pitch
        values = torch.cat(blocks) if blocks else torch.empty(0, dtype=torch.float32, device=device)
        panels = np.concatenate([[0], np.cumsum(_pitch(sizes) // 16)])
        device_side = (torch.from_numpy(a).to(device) for a in (base, room, panels[:-1].astype(np.int32)))
        counts = int(needed), int((base >= 0).sum()), int(panels[-1])
        return cls._make((*device_side, *counts, torch.from_numpy(local).to(device), values))


def _inverted(block: scipy.sparse.csc_matrix, padding: int, device: torch.device) -> torch.Tensor:
    """The inverse of a block, float32, row by row with padding at the end of each."""
    inverse = torch.from_numpy(block.toarray(order="F")).to(device)  # by columns: LAPACK works in place
    torch.linalg.cholesky(inverse, out=inverse)
    torch.cholesky_inverse(inverse, out=inverse)
    if device.type != "cpu":  # LAPACK finds a triangle, which torch copies; on GPUs it is a solve
        inverse = 0.5 * (inverse + inverse.T)
    size = len(inverse)
    result = torch.zeros((size, size + padding), dtype=torch.float32, device=device)
    result[:, :size] = inverse
    return result.ravel()


def _pitch(size: int | np.ndarray) -> int | np.ndarray:
    """Number of entries of a padded row, a multiple of sixteen."""
    return (size + 15) // 16 * 16
