"""Factors of the constant matrices, one per component, computed once on the host: A = L D Lᵀ in elimination order.

The Poisson matrix and the base matrix of the collision refinement never change during a simulation, so their direct
solution costs two sweeps over L. SciPy's SuperLU in symmetric mode with a minimum degree ordering finds the order and
the factor. Two forms of it:

| form | stored | applied by |
| --- | --- | --- |
| substitution | L by columns | one lane after the other: for a CPU |
| explicit | W = L⁻¹ by columns and by rows | two sparse products, all rows at once: for a GPU |

Column j of W reaches the ancestors of j in the elimination tree and nothing else, so that with `depth` counted from
the root its entry in row r is at place depth_j - depth_r. (Liu 1990, "The role of elimination trees".) W has 7 to 15
times as many entries as L for 1,000 to 25,000 vertices, and still 20 times fewer than A⁻¹.

A factor is tried on a random vector before it is trusted. Components whose matrix is too badly conditioned for it, or
that don't fit in the budget, have none, and are left to cg.py.

| symbol | code | what |
| --- | --- | --- |
| L, W | `pointer, column, value` | strictly lower part by columns; columns are places in elimination order |
| Wᵀ | `row_pointer, row_column, row_value` | strictly lower part by rows; explicit form only |
| D⁻¹ | `pivot` | one per place |
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch
import warp as wp
from scipy.sparse.linalg import splu

from . import cg

BUDGET = 2**26
"""Entries of all factors of a solver together, 12 bytes each (768 MiB)."""
TRUSTED = 1e-6
"""Error of a trial solve, as a share of its random solution, up to which a factor is used."""


class Factor(NamedTuple):
    """Factors of a packed batch, on one device. Equal components share one."""

    base: torch.Tensor
    """int32 [C], where the places of a component begin in `order` and `pivot`; -1 for a component without a factor."""
    order: torch.Tensor
    """int32 [R], the vertex within its component that is eliminated at this place."""
    pivot: torch.Tensor
    """float64 [R]."""
    pointer: torch.Tensor
    column: torch.Tensor
    value: torch.Tensor
    row_pointer: torch.Tensor
    row_column: torch.Tensor
    row_value: torch.Tensor
    """CSR, [R,R], int32, int32 and float64; the last three are empty in the form for substitution."""
    counts: torch.Tensor
    """int64 [3] on the host: components with a factor, components without, 1 if explicit."""

    @classmethod
    def build(
        cls,
        matrix: scipy.sparse.csr_matrix,
        system: cg.System,
        *,
        explicit: bool,
        budget: int = BUDGET,
        skip: np.ndarray | None = None,
    ) -> Factor:
        """Factors the diagonal blocks of a symmetric matrix [V,V], positive definite each, while the budget lasts.

        Args:
            matrix: Float64. No entry joins two components.
            system: Which vertices belong to a component.
            explicit: The form of the factors.
            budget: Entries of all factors together.
            skip: Components that need no factor, bool [C].
        """
        device = system.value.device
        bases, parts = [], []
        known: dict[tuple, int] = {}
        places = used = 0
        for number, (key, block) in enumerate(component_blocks(matrix, system)):
            if skip is not None and skip[number]:
                bases.append(-1)
                continue
            if key not in known:
                known[key] = -1
                part = _factored(block, explicit, (budget - used), device)
                if part is not None:
                    known[key], places = places, places + block.shape[0]
                    used += sum(triangle.nnz for triangle in part[2:])
                    parts.append(part)
            bases.append(known[key])
        order, pivot = (np.concatenate([p[i] for p in parts] or [np.zeros(0)]) for i in range(2))
        lower = _stacked([p[2] for p in parts])
        rows = _stacked([p[3] for p in parts] if explicit else [])
        base = np.array(bases, np.int32)
        host = (base, order.astype(np.int32), pivot.astype(np.float64), *lower, *rows)
        counts = torch.tensor([int((base >= 0).sum()), int((base < 0).sum()), int(explicit)])
        return cls(*(torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in host), counts)

    def without(self, load: torch.Tensor, vertex_component: torch.Tensor) -> torch.Tensor:
        """A load [V,3] with zeros on the components that have a factor."""
        return load * (self.base < 0)[vertex_component.long(), None] if int(self.counts[0]) else load


def component_blocks(
    matrix: scipy.sparse.csr_matrix, system: cg.System
) -> Iterator[tuple[tuple, scipy.sparse.csc_matrix]]:
    """The diagonal block of each component of a symmetric matrix, and a key that equal blocks share."""
    rows, start = system.rows.cpu().numpy(), system.start.cpu().numpy()
    local = np.empty(len(rows), np.int32)
    local[rows] = np.arange(len(rows)) - np.repeat(start[:-1], np.diff(start))
    matrix = matrix.tocsr()[rows]
    for first, last in itertools.pairwise(start):
        pointer = matrix.indptr[first : last + 1]
        columns, data = local[matrix.indices[pointer[0] : pointer[-1]]], matrix.data[pointer[0] : pointer[-1]]
        pointer = pointer - pointer[0]
        key = (pointer.tobytes(), columns.tobytes(), data.tobytes())
        yield key, scipy.sparse.csc_matrix((data, columns, pointer), shape=(last - first, last - first))


def _factored(block: scipy.sparse.csc_matrix, explicit: bool, budget: int, device: torch.device) -> tuple | None:
    """Order, pivots, L or W by columns, and W by rows; None where it doesn't fit or can't be trusted."""
    count = block.shape[0]
    if block.nnz > budget:
        return None
    try:
        lu = splu(block, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # exactly singular
        return None
    pivots = lu.U.diagonal()
    if not (np.array_equal(lu.perm_r, lu.perm_c) and (pivots > 0).all()):
        return None
    trial = np.random.default_rng(0).normal(size=count)
    if not np.abs(lu.solve(block @ trial) - trial).max() <= TRUSTED * np.abs(trial).max():
        return None
    order = np.empty(count, np.int64)
    order[lu.perm_c] = np.arange(count)
    lower = scipy.sparse.tril(lu.L, -1, format="csc")
    lower.sort_indices()
    if not explicit:
        return (order, 1.0 / pivots, lower) if lower.nnz <= budget else None
    inverse = _inverted(block[order][:, order].tocsr(), lower, budget, device)
    return None if inverse is None else (order, 1.0 / pivots, inverse, inverse.tocsr())


def _inverted(
    matrix: scipy.sparse.csr_matrix, lower: scipy.sparse.csc_matrix, budget: int, device: torch.device
) -> scipy.sparse.csc_matrix | None:
    """W = L⁻¹ without its diagonal, by columns; None where its two copies don't fit in the budget."""
    count = matrix.shape[0]
    parent, depth = np.full(count, -1, np.int32), np.zeros(count, np.int32)
    arrays = [wp.array(a.astype(np.int32), device="cpu") for a in (matrix.indptr, matrix.indices, parent)]
    tree = [wp.array(a, device="cpu") for a in (parent, depth)]
    wp.launch(elimination_tree, dim=1, inputs=[*arrays, *tree], device="cpu")
    parent, depth = (a.numpy() for a in tree)
    pointer = np.concatenate([[0], np.cumsum(depth.astype(np.int64))])
    if 2 * pointer[-1] > budget:
        return None
    where = wp.device_from_torch(device)
    host = (lower.indptr, lower.indices, parent, depth, pointer)
    integers = [wp.array(a.astype(np.int32), device=where) for a in host]
    column = wp.empty(int(pointer[-1]), dtype=wp.int32, device=where)
    value = wp.zeros(int(pointer[-1]), dtype=wp.float64, device=where)
    data = wp.array(lower.data, dtype=wp.float64, device=where)
    wp.launch(invert_columns, dim=count, inputs=[*integers, data, column, value], device=where)
    return scipy.sparse.csc_matrix((value.numpy(), column.numpy(), pointer), shape=(count, count))


@wp.kernel(enable_backward=False)
def elimination_tree(
    # In:
    row_pointer: wp.array[wp.int32],
    column: wp.array[wp.int32],
    ancestor: wp.array[wp.int32],
    # Out:
    parent: wp.array[wp.int32],
    depth: wp.array[wp.int32],
):
    """The tree of a symmetric matrix, and how many ancestors each row has; one thread. `ancestor` begins as -1."""
    count = row_pointer.shape[0] - 1
    for k in range(count):
        for e in range(row_pointer[k], row_pointer[k + 1]):
            i = column[e]
            while i >= 0 and i < k:
                above = ancestor[i]
                ancestor[i] = k  # the path is shortened as it is walked
                if above < 0:
                    parent[i] = k
                i = above
    for m in range(count):
        k = count - 1 - m
        if parent[k] >= 0:
            depth[k] = depth[parent[k]] + 1


@wp.kernel(enable_backward=False)
def invert_columns(
    # In:
    pointer: wp.array[wp.int32],
    row: wp.array[wp.int32],
    parent: wp.array[wp.int32],
    depth: wp.array[wp.int32],
    inverse_pointer: wp.array[wp.int32],
    value: wp.array[wp.float64],
    # Out:
    inverse_row: wp.array[wp.int32],
    inverse_value: wp.array[wp.float64],
):
    """Column j of W below the diagonal: L w = e_j, from j up to the root. `inverse_value` begins as zero."""
    j = wp.tid()
    base = inverse_pointer[j] + depth[j] - 1
    a = j
    w = wp.float64(1.0)
    while a >= 0:
        for e in range(pointer[a], pointer[a + 1]):
            slot = base - depth[row[e]]
            inverse_value[slot] = inverse_value[slot] - value[e] * w
        a = parent[a]
        if a >= 0:
            slot = base - depth[a]
            inverse_row[slot] = a
            w = inverse_value[slot]


def _stacked(blocks: list) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compressed matrices one after the other: pointers run on, indices stay those of their block."""
    ends = np.cumsum([0] + [b.nnz for b in blocks])
    pointer = [b.indptr[1:].astype(np.int64) + end for b, end in zip(blocks, ends[:-1], strict=True)]
    indices, values = [b.indices for b in blocks], [b.data for b in blocks]
    return (
        np.concatenate([[0], *pointer]).astype(np.int32),
        np.concatenate(indices).astype(np.int32) if blocks else np.zeros(0, np.int32),
        np.concatenate(values).astype(np.float64) if blocks else np.zeros(0),
    )
