"""Factors of the constant matrices, one per component, computed once on the host: A = L D Lᵀ in elimination order.

The Poisson matrix and the base matrix of the collision refinement never change during a simulation, so their direct
solution costs two sweeps over L. SciPy's SuperLU in symmetric mode with a minimum degree ordering finds the order and
the factor. Two forms of it:

| form | stored | applied by |
| --- | --- | --- |
| substitution | L by panels of four columns | one lane after the other: for a CPU |
| explicit | W = L⁻¹ by columns and by rows | two sparse products, all rows at once: for a GPU |

Column j of W has entries in the rows of the ancestors of j in the elimination tree and in no other, so that with
`depth` counted from the root its entry in row r is at place depth_j - depth_r. (Liu 1990, "The role of elimination
trees".) W has 7 to 15 times as many entries as L for 1,000 to 25,000 vertices, and still 20 times fewer than A⁻¹.

A panel holds every row in which at least one of its four columns has an entry, and each row of x is read once for all
four columns. This halves the number of rows to visit, and one visit costs no more than an entry of a single column.

A factor is tried on a random vector before it is trusted. A component whose matrix is too badly conditioned, or whose
factor does not fit in the budget, has no factor and is solved by conjugate_gradients.py.

| symbol | code | what |
| --- | --- | --- |
| L | `pointer, column, value` | by panels: four numbers for each row (a place) below the panel |
| | `triangle` | [4,4], the strictly lower part of L within a panel |
| W | `pointer, column, value` | explicit form: strictly lower part by columns; indices are places |
| Wᵀ | `row_pointer, row_column, row_value` | strictly lower part by rows |
| D⁻¹ | `pivot` | one per place |
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.sparse
import torch
import warp as wp
from scipy.sparse.linalg import splu

from warpgarment.kernels import compiling, kept

from .system import System

wp.set_module_options(compiling.options())

BUDGET = 2**26
"""Limit of the entries in all factors of a solver together; an entry takes 8 bytes and its index 4 (768 MiB in all)."""
PANEL = 4
FILLED = 100
"""Entries of a factor for each of the matrix: less in any factor of a surface."""
TRUSTED = 1e-6
"""Error of a trial solve, as a share of its random solution, up to which a factor is used."""


class Factor(NamedTuple):
    """Factors of a packed batch, on one device. Equal components share one."""

    base: torch.Tensor
    """int32 [C], where the places of a component begin in `order` and `pivot`; -1 for a component without a factor."""
    first: torch.Tensor
    """int32 [C], where the work vector of a component begins; in the form for substitution padded to full panels."""
    order: torch.Tensor
    """int32 [R], the vertex within its component that is eliminated at this place; -1 where a panel is padded."""
    pivot: torch.Tensor
    """float64 [R], the diagonal of D⁻¹."""
    triangle: torch.Tensor
    """float64 [R/4,4,4], strictly lower part of L within each panel; empty in the explicit form."""
    pointer: torch.Tensor
    column: torch.Tensor
    value: torch.Tensor
    row_pointer: torch.Tensor
    row_column: torch.Tensor
    row_value: torch.Tensor
    """Compressed matrices, int32, int32 and float64, as in the table above; the three of the rows are empty in the form
    for substitution."""
    factored: int
    """Number of components with a factor."""
    unfactored: int
    """Number of components without a factor."""
    explicit: bool
    """Whether the factors have the explicit form."""
    places: int
    """Number of places of all components together."""

    @classmethod
    def build(
        cls,
        matrix: scipy.sparse.csr_matrix,
        system: System,
        *,
        explicit: bool,
        budget: int = BUDGET,
        skip: np.ndarray | None = None,
    ) -> Factor:
        """Factors the diagonal blocks of a symmetric matrix as long as the budget lasts.

        Args:
            matrix: Symmetric matrix, float64 [V,V], whose diagonal blocks are positive definite. No entry joins two
                components.
            system: System that assigns the vertices to components.
            explicit: Whether the factors have the explicit form.
            budget: Limit of the entries of all factors together.
            skip: Whether a component needs no factor, bool [C].
        """
        device = system.value.device
        bases, lengths, parts = [], [], []
        known: dict[tuple, int] = {}
        places = used = 0
        for number, (key, block) in enumerate(component_blocks(matrix, system)):
            count = block.shape[0]
            lengths.append(count if explicit else -(-count // PANEL) * PANEL)
            if skip is not None and skip[number]:
                bases.append(-1)
                continue
            if key not in known:
                known[key] = -1
                make = partial(_factored, block, explicit, budget - used, device)
                fits = FILLED * block.nnz < budget - used
                part = kept.of("factor", (*key, explicit, str(device)), make) if fits else make()
                if part is not None:
                    known[key], places = places, places + lengths[-1]
                    used += sum(values.size for _, _, values in part[3:])
                    parts.append(part)
            bases.append(known[key])
        base, ends = np.array(bases, np.int32), np.cumsum([0, *lengths])
        empty = (np.zeros(0), np.zeros(0), np.zeros((0, PANEL, PANEL)))
        order, pivot, triangle = (np.concatenate([p[i] for p in parts] or [empty[i]]) for i in range(3))
        triangles = [_stacked([p[i] for p in parts if len(p) > i]) for i in (3, 4)]
        host = (base, ends[:-1].astype(np.int32), order.astype(np.int32), pivot.astype(np.float64), triangle)
        counts = int((base >= 0).sum()), int((base < 0).sum()), explicit, int(ends[-1])
        arrays = (*host, *triangles[0], *triangles[1])
        return cls._make((*(torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in arrays), *counts))

    def without(self, load: torch.Tensor, vertex_component: torch.Tensor) -> torch.Tensor:
        """A load [V,3] with zeros on the components that have a factor."""
        return load * (self.base < 0)[vertex_component.long(), None] if self.factored else load


def component_blocks(
    matrix: scipy.sparse.csr_matrix, system: System
) -> Iterator[tuple[tuple, scipy.sparse.csc_matrix]]:
    """Yields for each component of a symmetric matrix a key, which equal blocks share, and its diagonal block."""
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
    """Order, pivots, L or W by columns, and W by rows; None if the factor does not fit or cannot be trusted."""
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
    if explicit:
        inverse = _inverted(block[order][:, order].tocsr(), lower, budget, device)
        if inverse is None:
            return None
        by_columns, by_rows = ((m.indptr, m.indices, m.data) for m in (inverse, inverse.tocsr()))
        return order, 1.0 / pivots, np.zeros((0, PANEL, PANEL)), by_columns, by_rows
    triangle, panels = _in_panels(lower)
    if panels[2].size > budget:
        return None
    padding = -count % PANEL
    return np.pad(order, (0, padding), constant_values=-1), np.pad(1.0 / pivots, (0, padding)), triangle, panels


def _in_panels(lower: scipy.sparse.csc_matrix) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """A strictly lower matrix [n,n] by panels: triangles [n/4,4,4]; pointers, rows, and values [*,4] below them."""
    count = -(-lower.shape[0] // PANEL)
    column = np.repeat(np.arange(lower.shape[1]), np.diff(lower.indptr))
    row, panel, within = lower.indices.astype(np.int64), column // PANEL, column % PANEL
    inside = row // PANEL == panel
    triangle = np.zeros((count, PANEL, PANEL))
    triangle[panel[inside], row[inside] % PANEL, within[inside]] = lower.data[inside]
    below = ~inside
    key, slot = np.unique(panel[below] * (PANEL * count) + row[below], return_inverse=True)
    values = np.zeros((len(key), PANEL))
    values[slot, within[below]] = lower.data[below]
    pointer = np.searchsorted(key // (PANEL * count), np.arange(count + 1))
    return triangle, (pointer, key % (PANEL * count), values)


def _inverted(
    matrix: scipy.sparse.csr_matrix, lower: scipy.sparse.csc_matrix, budget: int, device: torch.device
) -> scipy.sparse.csc_matrix | None:
    """W = L⁻¹ without its diagonal, by columns; None if its two copies do not fit in the budget."""
    count = matrix.shape[0]
    parent, depth = np.full(count, -1, np.int32), np.zeros(count, np.int32)
    arrays: list[wp.array] = [
        wp.array(a.astype(np.int32), device="cpu") for a in (matrix.indptr, matrix.indices, parent)
    ]
    tree: list[wp.array] = [wp.array(a, device="cpu") for a in (parent, depth)]
    wp.launch(elimination_tree, dim=1, inputs=[*arrays, *tree], device="cpu")
    parent, depth = (a.numpy() for a in tree)
    pointer = np.concatenate([[0], np.cumsum(depth.astype(np.int64))])
    if 2 * pointer[-1] > budget:
        return None
    where = wp.device_from_torch(device)
    host = (lower.indptr, lower.indices, parent, depth, pointer)
    integers: list[wp.array] = [wp.array(a.astype(np.int32), device=where) for a in host]
    column = wp.empty(int(pointer[-1]), dtype=wp.int32, device=where)
    value = wp.zeros(int(pointer[-1]), dtype=wp.float64, device=where)
    data: wp.array[wp.float64] = wp.array(lower.data, dtype=wp.float64, device=where)
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
    """The elimination tree of a symmetric matrix, and the number of ancestors of each row; one thread.

    `ancestor` must be filled with -1 before the launch.
    """
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
    """Column j of W below the diagonal: L w = e_j, from j up to the root. `inverse_value` must be zero before."""
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


def _stacked(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compressed matrices one after the other: pointers run on, indices stay those of their matrix."""
    ends = np.cumsum([0] + [len(indices) for _, indices, _ in parts])
    pointer = [p[1:].astype(np.int64) + end for (p, _, _), end in zip(parts, ends[:-1], strict=True)]
    return (
        np.concatenate([[0], *pointer]).astype(np.int32),
        np.concatenate([p[1] for p in parts] or [np.zeros(0)]).astype(np.int32),
        np.concatenate([p[2] for p in parts] or [np.zeros(0)]).astype(np.float64),
    )
