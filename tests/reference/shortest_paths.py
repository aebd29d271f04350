"""Shortest paths by SciPy, in float64."""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra


def distances(graph: csr_matrix, sources: np.ndarray, limit: float = np.inf) -> np.ndarray:
    """Lengths of the shortest paths, float64 [S,N]; `inf` where no path exists within the limit."""
    return dijkstra(graph, indices=sources, limit=limit)
