"""Which of the named parts of a file (objects, groups, nodes) are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from warpgarment.errors import MeshError

ALL = "*"  # reads everything as one mesh


class Parts(NamedTuple):
    """Parts of the polygons of a file.

    Attributes:
        names: Of the parts; "" has none.
        of_polygon: Part of each polygon, an index of `names`, [P].
        several: Whether a name is a list of words, each of which names the part, as the groups of OBJ are.
    """

    names: Sequence[str]
    of_polygon: np.ndarray
    several: bool = False

    def used(self) -> list[str]:
        """Names of parts that have polygons, without repetition."""
        there = np.zeros(len(self.names), dtype=bool)
        there[self.of_polygon] = True
        return list(dict.fromkeys(name for name, used in zip(self.names, there, strict=True) if used and name))

    def mask(self, mesh: str) -> np.ndarray | None:
        """Polygons of a part, by its name [P]; None where no part with polygons has it."""
        called = [mesh == name or (self.several and mesh in name.split()) for name in self.names]
        found = np.array(called, dtype=bool)[self.of_polygon]
        return found if found.any() else None


def named(path: object, mesh: str, *parts: Parts) -> np.ndarray:
    """Polygons of the part with this name [P], of the first kind of parts that has it.

    Raises:
        MeshError: There is none; lists the names there are.
    """
    for kind in parts:
        found = kind.mask(mesh)
        if found is not None:
            return found
    have = list(dict.fromkeys(name for kind in parts for name in kind.used()))
    raise MeshError(f"{path}: no mesh named {mesh!r}; {f'it holds {listed(have)}' if have else 'nothing has a name'}.")


def unnamed(path: object, mesh: str | None) -> None:
    """Raises MeshError where a name is given for a file of a kind that has none."""
    if mesh not in (None, ALL):
        raise MeshError(f"{path}: no mesh named {mesh!r}; files of this kind hold one mesh, without a name.")


def unconnected(parts: Parts, pieces: np.ndarray | None = None) -> bool:
    """Whether there are parts that are not connected with each other, directly or through others.

    Args:
        parts: The parts.
        pieces: The connected piece of each polygon [P]; None: parts are never connected. A garment with a part for each
            material is one.
    """
    if len(parts.used()) < 2 or pieces is None:
        return len(parts.used()) > 1
    size = len(parts.names) + int(pieces.max()) + 1
    pairs = (np.ones(len(pieces)), (parts.of_polygon, len(parts.names) + pieces))
    groups = connected_components(coo_matrix(pairs, shape=(size, size)), directed=False)[1]
    return len(np.unique(groups[parts.of_polygon])) > 1


def connected_pieces(vertex_count: int, counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The connected piece of each polygon [P]: polygons that share a vertex are of one."""
    owner, size = np.repeat(np.arange(len(counts)), counts), len(counts) + vertex_count
    links = coo_matrix((np.ones(len(owner)), (owner, len(counts) + corners)), shape=(size, size))
    return connected_components(links, directed=False)[1][: len(counts)]


def used_only(count: int, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that corners [C] name, of `count`, in their order; and the corners counted among these."""
    used = np.zeros(count, dtype=bool)
    used[corners] = True
    return np.flatnonzero(used), (np.cumsum(used) - 1)[corners]


def listed(names: Sequence[str]) -> str:
    """Some names, and how many more there are."""
    return ", ".join(names[:12]) + (f" and {len(names) - 12:,} more" if len(names) > 12 else "")
