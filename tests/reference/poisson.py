"""Float64 twin of kernels/poisson/solver.py: libigl's gradient operator and a sparse direct solve."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu


def operators(rest: np.ndarray, faces: np.ndarray) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """Gᵀ A G, [V,V], and Gᵀ A, [V,3F], of the rest mesh; the rows of G are ordered by axis, then face."""
    rest, faces = rest.astype(np.float64), faces.astype(np.int64)
    gradient = igl.grad(rest, faces).tocsr()
    areas = np.tile(igl.doublearea(rest, faces) / 2.0, 3)
    weighted = (gradient.T @ sp.diags(areas)).tocsr()
    return (weighted @ gradient).tocsr(), weighted


def piece_of(vertex_count: int, faces: np.ndarray) -> np.ndarray:
    """Connected component of every vertex, numbered in the order of their lowest vertices."""
    pairs = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    graph = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(vertex_count, vertex_count))
    labels = connected_components(graph, directed=False)[1]
    names = {label: rank for rank, label in enumerate(dict.fromkeys(labels.tolist()))}
    return np.array([names[label] for label in labels.tolist()])


def solve(
    rest: np.ndarray,
    faces: np.ndarray,
    phi: np.ndarray,
    mean: np.ndarray,
    pins: np.ndarray | None = None,
    pin_weight: float = 0.0,
    pin_targets: np.ndarray | None = None,
) -> np.ndarray:
    """Minimiser of Σ s |Φ(V) - Φ|² plus the pins' energy [m], float64 [V,3]; every vertex must have a face."""
    laplacian, weighted = operators(rest, faces)
    right = weighted @ phi.astype(np.float64).transpose(2, 0, 1).reshape(-1, 3)
    result = np.zeros((len(rest), 3))
    stiffness = np.zeros(len(rest))
    if pins is not None:
        diagonal, piece = laplacian.diagonal(), piece_of(len(rest), faces)
        stiffness[pins] = [pin_weight * diagonal[piece == piece[pin]].mean() for pin in pins]
        right[pins] += stiffness[pins, None] * pin_targets.astype(np.float64)
    matrix = (laplacian + sp.diags(stiffness)).tocsc()
    piece = piece_of(len(rest), faces)
    for c in range(piece.max() + 1):
        here = np.flatnonzero(piece == c)
        if stiffness[here].any():
            result[here] = splu(matrix[here][:, here]).solve(right[here])
            continue
        free = here[1:]  # the first vertex stays at zero, then all are moved to the mean
        result[free] = splu(matrix[free][:, free]).solve(right[free])
        own = faces[piece[faces[:, 0]] == c]
        result[here] += mean[c].astype(np.float64) - result[own].mean((0, 1))
    return result
