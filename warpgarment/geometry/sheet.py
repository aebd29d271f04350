"""A triangle mesh that is edited one edge at a time, which remeshing needs besides whole-array operations."""

from __future__ import annotations

import numpy as np


class EditableSheet:
    """A triangle mesh whose edges can be collapsed and whose boundary edges can be split, one at a time."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self.points = np.array(vertices, dtype=np.float64)
        self._faces: list[list[int]] = faces.tolist()  # a removed face is an empty list
        self._around: list[set[int]] = [set() for _ in range(len(vertices))]
        for f, face in enumerate(self._faces):
            for v in face:
                self._around[v].add(f)

    def neighbours(self, vertex: int) -> set[int]:
        """Vertices that share a face with a vertex."""
        return {v for f in self._around[vertex] for v in self._faces[f]} - {vertex}

    def sharing(self, a: int, b: int) -> int:
        """Number of faces at an edge."""
        return len(self._around[a] & self._around[b])

    def on_boundary(self, vertex: int) -> bool:
        """Whether the faces around a vertex leave a gap."""
        return len(self.neighbours(vertex)) != len(self._around[vertex])

    def length(self, a: int, b: int) -> float:
        """Distance between two vertices [m]."""
        return float(np.linalg.norm(self.points[a] - self.points[b]))

    def collapse(self, kept: int, gone: int) -> bool:
        """Joins vertex `gone` to vertex `kept` unless the surface would stop being a manifold (the link condition).

        Returns:
            Whether the vertices were joined.
        """
        shared = self._around[kept] & self._around[gone]
        if not shared or len(self.neighbours(kept) & self.neighbours(gone)) != len(shared):
            return False
        for f in shared:
            for v in self._faces[f]:
                self._around[v].discard(f)
            self._faces[f] = []
        for f in self._around[gone]:
            self._faces[f] = [kept if v == gone else v for v in self._faces[f]]
            self._around[kept].add(f)
        self._around[gone] = set()
        return True

    def split(self, a: int, b: int, point: np.ndarray) -> int:
        """Inserts a vertex at `point` [m] on a boundary edge and returns its index."""
        (f,) = self._around[a] & self._around[b]
        new = len(self.points)
        self.points = np.concatenate([self.points, point[None]])
        old = self._faces[f]
        self._faces[f] = [new if v == b else v for v in old]
        self._faces.append([new if v == a else v for v in old])
        added = len(self._faces) - 1
        (apex,) = set(old) - {a, b}
        self._around.append({f, added})
        self._around[b].discard(f)
        self._around[b].add(added)
        self._around[apex].add(added)
        return new

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """The remaining vertices [m], [V, 3], in their old order, and faces, [F, 3]."""
        faces = np.array([f for f in self._faces if f], dtype=np.int64)
        used, renumbered = np.unique(faces, return_inverse=True)
        return self.points[used], renumbered.reshape(-1, 3)
