"""Distances over a garment's surface between the centroids of its faces.

A shortest path on a triangle mesh is a chain of straight segments that bend only at vertices: at the border, and where
the angles around a vertex sum to more than 2π (Mitchell, Mount and Papadimitriou 1987). So:

1. From every face centroid and every such vertex, unfold the strips of faces around it into the plane, keeping for
   each strip the window of directions that stay inside: `kernels/mesh/windows.py`. The centroids and vertices visible
   through the window are at exact distances.
2. Chain these segments to shortest paths: `kernels/mesh/shortest_paths.py`.

`face_geodesics` does this for all pairs, `local_geodesics` for pairs within a radius, without a matrix of F x F.

With strips of unlimited length this is exact. Strips end at `REACH` times the source's own size, so a long straight
segment becomes a chain of visible centroids that lie almost on it: distances are never too short, and slightly too
long. How much depends on the triangles; beside exact distances they are

- on garments of even triangles, straps and cords with rings, up to 1 % too long, 0.05 % on average;
- where triangles are slender, so that sources look in fewer directions (`ENOUGH` in `windows.py`), up to 5 % for sides
  of 1:10 to 1:50, 0.3 % on average, and up to 20 % for 1:100;
- for one pair of a million up to 30 %: behind a vertex whose angles exceed 2π by less than `SADDLE`.

Sheets of 1:20 and thin tubes take up to three times as long as even triangles of the same number, of 1:50 up to five.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from warpgarment.errors import MeshError
from warpgarment.kernels.mesh.shortest_paths import Paths, neighbourhoods, unit_of
from warpgarment.kernels.mesh.windows import Surface, segments

from .checks import check_edges, checked_faces, checked_positions, complain, no_area, repeated_vertices

# A window ends at the larger of two distances, `REACH` times the longest edge of its source and `CROSSED_REACH` times
# the longest edge of any face it crossed (so that small faces see past large ones).
REACH = 2.5
CROSSED_REACH = 1.5
SADDLE = 1e-3  # angle beyond 2 pi from which a vertex can bend a shortest path [rad]
BLOCK = 512  # number of sources of one search of local distances
FEW = 8  # for fewer sources, preparing a graph for the faster search takes longer than it saves
VERSION = 4  # raise it whenever the result changes: it is part of the name under which results are kept
MEMORY_BUDGET = 8 * 2**30  # largest matrix of float32 distances [bytes]: about 46,000 faces


def face_geodesics(rest_vertices: Any, faces: Any) -> np.ndarray:
    """Distances over the surface between all face centroids.

    Args:
        rest_vertices: Positions [m], shape [V,3]; NumPy or torch.
        faces: Vertex indices of an oriented manifold mesh, shape [F,3].

    Returns:
        Distances [m], float32, shape [F,F]; zero diagonal, symmetric, `inf` across components. Never shorter than the
        exact polyhedral distance, up to rounding (`kernels/mesh/shortest_paths.py`: some nanometres on a garment), and
        within 5 % of it except as said above.

    Raises:
        MeshError: Bad shapes or indices, positions that are not finite, non-manifold edges, faces without area, or a
            matrix beyond `MEMORY_BUDGET`.
    """
    vertices, faces = checked_mesh(rest_vertices, faces)
    need = 4 * len(faces) ** 2
    if need > MEMORY_BUDGET:
        raise MeshError(
            f"Distances between {len(faces):,} faces need {need / 2**30:.0f} GiB, more than "
            f"{MEMORY_BUDGET / 2**30:.0f}. Coarsen the garment, or raise warpgarment.geometry.geodesics.MEMORY_BUDGET."
        )
    every = np.arange(len(faces))
    return Paths(surface_graph(vertices, faces), every).distances(every)


def local_geodesics(rest_vertices: Any, faces: Any, radius: float) -> csr_matrix:
    """Distances over the surface between face centroids no further apart than a radius, one row per face.

    A path no longer than the radius stays in the ball of that radius around its start. Therefore sources are grouped
    into blocks of neighbours, and each search is restricted to the part of the graph around its block: time and memory
    grow with the number of pairs found.

    Args:
        rest_vertices: Positions [m], shape [V,3]; NumPy or torch.
        faces: Vertex indices of an oriented manifold mesh, shape [F,3].
        radius: Longest distance kept [m], positive; `inf` keeps all of the same component.

    Returns:
        Distances [m], float32, shape [F,F], symmetric, columns sorted. The diagonal is stored, as zeros; pairs further
        apart are not stored. Stored values are those of `face_geodesics`.

    Raises:
        MeshError: As in `face_geodesics`, or the pairs exceed `MEMORY_BUDGET`.
        ValueError: The radius is not positive.
    """
    if not radius > 0.0:
        raise ValueError(f"radius must be positive, got {radius}")
    vertices, faces = checked_mesh(rest_vertices, faces)
    count = len(faces)
    pairs: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    stored = 0
    for block, inside, part in searches(vertices, faces, np.arange(count), radius):
        row, column = np.nonzero((part <= radius) & (part < np.inf) & (block[:, None] < inside))
        pairs.append((block[row], inside[column], part[row, column]))
        stored += 2 * len(row)
        if 8 * stored > MEMORY_BUDGET:
            raise MeshError(
                f"Distances up to {radius:g} m between {count:,} faces need more than {MEMORY_BUDGET / 2**30:.0f} GiB. "
                "Coarsen the garment, lower the radius, or raise warpgarment.geometry.geodesics.MEMORY_BUDGET."
            )
    source, target, length = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    upper_half = csr_matrix((length, (source, target)), shape=(count, count))
    diagonal = csr_matrix((np.zeros(count, np.float32), np.arange(count), np.arange(count + 1)), shape=(count, count))
    return _stacked(upper_half, diagonal)


def searches(
    vertices: np.ndarray, faces: np.ndarray, sources: np.ndarray, radius: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Distances from some faces to all faces within a radius, one block of neighbouring sources after another.

    Args:
        vertices: Positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
        sources: Faces from which paths start, shape [S].
        radius: Largest distance of interest [m].

    Yields:
        Sources of a block, shape [s]; the faces in the box around it, ascending, shape [n]; distances [m], float32,
        shape [s,n], which are `inf` (or just above the radius) for faces further away.
    """
    mesh = _Unfolding(vertices.astype(np.float64), faces.astype(np.int64))
    graph, count = _segments(mesh), len(faces)
    unit = unit_of(graph)
    nodes = np.concatenate([vertices[faces].mean(axis=1), vertices[mesh.node_of_vertex >= 0]]).astype(np.float64)
    del mesh
    for chosen in neighbourhoods(nodes[sources], BLOCK):
        block = sources[chosen]
        low, high = nodes[block].min(axis=0) - 1.001 * radius, nodes[block].max(axis=0) + 1.001 * radius
        inside = np.nonzero(((nodes >= low) & (nodes <= high)).all(axis=1))[0]
        of_faces = np.searchsorted(inside, count)
        part = Paths(graph[inside][:, inside], np.arange(of_faces), unit).distances(
            np.searchsorted(inside, block), radius * (1 + 1e-6)
        )  # float32 before the comparison, so that ties are decided as in the dense matrix
        yield block, inside[:of_faces], part


def _stacked(upper: csr_matrix, diagonal: csr_matrix) -> csr_matrix:
    """The symmetric matrix of an upper half and a diagonal; a sum of matrices would drop the stored zeros."""
    count = upper.shape[0]
    parts = [upper.T.tocsr(), diagonal, upper]
    row = np.concatenate([np.repeat(np.arange(count, dtype=np.int32), np.diff(part.indptr)) for part in parts])
    indices = np.concatenate([part.indices for part in parts])
    data = np.concatenate([part.data for part in parts])
    result = csr_matrix((data, (row, indices)), shape=(count, count))
    result.sort_indices()
    return result


def checked_mesh(rest_vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m], float32 [V,3], and faces, int32 [F,3], of a mesh on which paths are defined; raises MeshError."""
    vertices = checked_positions(rest_vertices, name="rest_vertices")
    faces = checked_faces(faces, len(vertices))
    complain(repeated_vertices(faces) | no_area(vertices, faces), "faces", "have no area", "Run garment.cleaned().")
    check_edges(faces)
    return vertices, faces


def distances_from(graph: csr_matrix, sources: np.ndarray, face_count: int) -> np.ndarray:
    """Distances from some faces to all faces.

    Args:
        graph: Graph of `surface_graph`, [F+K,F+K].
        sources: Faces from which paths start, shape [S].
        face_count: Number of faces F.

    Returns:
        Distances [m], float32, shape [S,F]. For fewer than `FEW` sources they are sums of float64, and may differ by
        some nanometres from those for more sources, whose lengths are rounded to units.
    """
    if len(sources) < FEW:
        return dijkstra(graph, indices=sources)[:, :face_count].astype(np.float32)
    return Paths(graph, np.arange(face_count)).distances(sources)


def surface_graph(vertices: np.ndarray, faces: np.ndarray) -> csr_matrix:
    """Straight segments over the surface: nodes are the F face centroids, then the K vertices where paths may bend.

    Args:
        vertices: Positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3], every edge with one or two faces.

    Returns:
        Symmetric matrix of lengths [m], float64, shape [F+K,F+K].
    """
    return _segments(_Unfolding(vertices.astype(np.float64), faces.astype(np.int64)))


def _segments(mesh: _Unfolding) -> csr_matrix:
    keys, lengths = [], []
    for source, target, length in mesh.seen():
        keys.append(np.minimum(source, target).astype(np.int64) * mesh.node_count + np.maximum(source, target))
        lengths.append(length)
        del source, target  # two thirds of what the next ones take
    key, length = np.concatenate(keys), np.concatenate(lengths)
    del keys, lengths
    order = np.argsort(key)
    key, length = key[order], length[order]
    del order
    first = np.nonzero(np.concatenate([[True], key[1:] != key[:-1]]))[0]
    length, (low, high) = np.minimum.reduceat(length, first), np.divmod(key[first], mesh.node_count)
    del key, first
    keep = low != high
    low, high, length = low[keep].astype(np.int32), high[keep].astype(np.int32), length[keep]
    return csr_matrix(
        (np.concatenate([length, length]), (np.concatenate([high, low]), np.concatenate([low, high]))),
        shape=(mesh.node_count,) * 2,
    )


Seen = tuple[np.ndarray, np.ndarray, np.ndarray]  # source, node, length [m] of each straight segment
Windows = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Seen]  # source, half-edge, right [N,2], left [N,2]


class _Unfolding:
    """Half-edge 3f + k runs from corner k of face f to corner k+1; windows are parallel arrays, one entry each."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self.faces, count = faces, len(faces)
        corners = vertices[faces]
        edges = np.roll(corners, -1, axis=1) - corners
        self.length = np.maximum(np.linalg.norm(edges, axis=2).reshape(-1), 1e-30)
        to_apex = np.roll(corners, -2, axis=1) - corners
        along = np.einsum("fkc,fkc->fk", edges, to_apex).reshape(-1) / self.length
        self.apex = np.stack(
            [along, np.linalg.norm(np.cross(edges, to_apex), axis=2).reshape(-1) / self.length], axis=1
        )
        half = np.arange(3 * count)
        self.tail, self.next = faces.reshape(-1), half - half % 3 + (half + 1) % 3
        self.head = self.tail[self.next]
        self.twin = self._twins(len(vertices))
        angle = np.arctan2(self.apex[:, 1], along)
        total = np.bincount(self.tail, weights=angle, minlength=len(vertices))
        border = np.zeros(len(vertices), dtype=bool)
        border[self.tail[self.twin < 0]] = border[self.head[self.twin < 0]] = True
        bends = border | (total > 2 * np.pi + SADDLE)
        self.node_of_vertex = np.full(len(vertices), -1)
        self.node_of_vertex[bends] = count + np.arange(np.count_nonzero(bends))
        self.node_count = count + np.count_nonzero(bends)
        longest = self.length.reshape(-1, 3).max(axis=1)
        vertex_reach = np.zeros(len(vertices))
        np.maximum.at(vertex_reach, faces.reshape(-1), np.repeat(longest, 3))
        self.reach = REACH * np.concatenate([longest, vertex_reach[bends]])
        self.crossed_reach = CROSSED_REACH * longest

    def _twins(self, vertex_count: int) -> np.ndarray:
        forward, backward = self.tail * vertex_count + self.head, self.head * vertex_count + self.tail
        order = np.argsort(forward)
        place = np.minimum(np.searchsorted(forward[order], backward), len(order) - 1)
        return np.where(forward[order][place] == backward, order[place], -1)

    def seen(self) -> Iterator[Seen]:
        """All straight segments; most come from both of their ends, some twice from one."""
        yield self.spread(self.from_centroids())
        yield self.spread(self.from_vertices())
        yield self.over_midpoints()

    def over_midpoints(self) -> Seen:
        """Segments between neighbours by way of the middle of their edge, which link even faces without area."""
        half = np.nonzero(self.twin >= 0)[0]
        to_middle = np.linalg.norm(
            np.stack([self.length / 2, np.zeros(len(self.length))], axis=1) - self._centroids(), axis=1
        )
        return half // 3, self.twin[half] // 3, to_middle[half] + to_middle[self.twin[half]]

    def _centroids(self) -> np.ndarray:
        """Centroid of each half-edge's face, its tail at the origin and its head on the first axis, shape [3F,2]."""
        return (np.stack([self.length, np.zeros(len(self.length))], axis=1) + self.apex) / 3

    def from_centroids(self) -> Windows:
        """Windows over the three edges of every face, seen from its centroid, and its own bending corners."""
        half = np.arange(len(self.tail))
        start = np.zeros((len(half), 2))
        end = np.stack([self.length, np.zeros(len(half))], axis=1)
        centroid = self._centroids()
        source = half // 3
        node = self.node_of_vertex[self.tail]
        own = node >= 0
        seen = (source[own], node[own], np.linalg.norm(centroid[own], axis=1))
        return source, half, start - centroid, end - centroid, seen

    def from_vertices(self) -> Windows:
        """Windows over the edge opposite to every corner at a bending vertex, with that face's centroid and corners."""
        corner = np.nonzero(self.node_of_vertex[self.tail] >= 0)[0]
        source, half = self.node_of_vertex[self.tail[corner]], self.next[corner]
        right = np.stack([self.length[corner], np.zeros(len(corner))], axis=1)
        left = self.apex[corner]
        neighbour = self.node_of_vertex[np.stack([self.head[corner], self.head[half]])]
        own = neighbour >= 0
        both = np.broadcast_to(source, own.shape)
        reach = np.linalg.norm(np.stack([right, left]), axis=2)
        seen = (
            np.concatenate([source, both[own]]),
            np.concatenate([corner // 3, neighbour[own]]),
            np.concatenate([np.linalg.norm(right + left, axis=1) / 3, reach[own]]),
        )
        return source, half, right, left, seen

    def spread(self, windows: Windows) -> Seen:
        """Sources, targets and lengths [m] of all visible straight segments."""
        source, half, right, left, seen = windows
        surface = Surface(self.twin, self.apex, self.tail, self.node_of_vertex[self.tail], self.crossed_reach)
        found = segments(surface, source, half, right, left, self.reach)
        first, second, third = (np.concatenate(part) for part in zip(seen, found, strict=True))
        return first, second, third
