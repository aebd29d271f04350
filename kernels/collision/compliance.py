"""Contact forces on a garment whose compliance matrix is known: the small side of the collision refinement.

Supplement section 2 asks for (B ⊗ I₃ + N Nᵀ) D = N c, with one column of N, holding n_i, per contact. B is constant per
garment; with its inverse Z, the compliance, the unknowns shrink from three per vertex to one per contact,

    (I + S) y = c,    S_ij = n_i·n_j Z_ij,    D = Z N y

(push-through identity), where y_i = c_i - n_i·D_i is the force of contact i. Conjugate gradients solve it in tens of
steps where the system for D takes hundreds; a diagonal preconditioner does not pay, for S_ii hardly varies. All
eigenvalues of I + S are at least 1, so that the residual bounds the error, in y and in D:

    |δD|_B² = δyᵀ S δy ≤ δyᵀ (I + S) δy ≤ |c - (I + S) y|²

Z is dense, so this is for components of moderate size: forces_inverse_gpu.py on a GPU, forces_inverse_cpu.py on a CPU.

| symbol | code | what |
| --- | --- | --- |
| Z | `compliance` | float32, one block per component, one after the other; equal components share a block |
| n_i | `normal` | [V,3]; zero where there is no contact |
| c_i | `gap` | [V], what is missing along the normal |
| y_i | `force` | [V], zero where there is no contact |
| S | `coupling` | float32 scratch, with as much room as Z |
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch

from warpgarment.kernels.linear.factor import component_blocks
from warpgarment.kernels.linear.system import System

LARGEST = 2048
"""Vertices of the largest component that gets a compliance matrix (16 MB)."""
BUDGET = 2**28
"""Entries of all compliance matrices of a batch together (1 GiB, and as much for scratch while solving)."""


class Compliance(NamedTuple):
    """Compliance matrices of a packed batch, on one device."""

    base: torch.Tensor
    """int64 [C], where the block of a component begins; -1 for a component without one."""
    room: torch.Tensor
    """int64 [C], where the scratch of a component begins; components never share it."""
    wide: torch.Tensor
    """int32 [C], where a component begins among vertices in panels of sixteen, the last of each padded."""
    scratch: int
    """Entries of the scratch of all components."""
    inverted: int
    """Components with a block."""
    panels: int
    """Panels of vertices."""
    local: torch.Tensor
    """int32 [V], index of a vertex within its component."""
    values: torch.Tensor
    """float32, the blocks, row by row; rows are padded with zeros to a multiple of sixteen."""

    @classmethod
    def build(cls, matrix: scipy.sparse.csr_matrix, system: System, largest: int, budget: int) -> Compliance:
        """Inverts the diagonal blocks of B, [V,V], that are small enough, until the budget is used up."""
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
                lower = torch.linalg.cholesky(torch.from_numpy(block.toarray()).to(device))
                inverse = torch.cholesky_inverse(lower)
                symmetric = (0.5 * (inverse + inverse.T)).to(torch.float32)
                blocks.append(torch.nn.functional.pad(symmetric, (0, pitch - size)).ravel())
                known[key], used = used, used + size * pitch
            base[c], room[c], needed = known[key], needed, needed + size * pitch
        values = torch.cat(blocks) if blocks else torch.empty(0, dtype=torch.float32, device=device)
        panels = np.concatenate([[0], np.cumsum(_pitch(sizes) // 16)])
        device_side = (torch.from_numpy(a).to(device) for a in (base, room, panels[:-1].astype(np.int32)))
        counts = int(needed), int((base >= 0).sum()), int(panels[-1])
        return cls._make((*device_side, *counts, torch.from_numpy(local).to(device), values))


def _pitch(size: int | np.ndarray) -> int | np.ndarray:
    """Entries of a row: a multiple of sixteen."""
    return (size + 15) // 16 * 16
