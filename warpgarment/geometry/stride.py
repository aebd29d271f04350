"""Whether a skirt is wide enough for the steps of a body.

A level cut of a garment is one or more closed lines. Where a line goes around two or more parts of the body (both
legs), it has to be as long as a tape around these parts, in every frame. The tape is the perimeter of their convex
hull, seen from above: no closed line around them is shorter. Cloth that is shorter has to be stretched, to ride up, or
to be gone through; in a simulation by a network it is stretched to twice its length and more, and gone through.

| symbol | code | what |
| --- | --- | --- |
| L | `Narrow.length` | length of the line at rest [m] |
| H(t) | `Narrow.needed` | length of the tape in each frame [m] |
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

LEVELS = 12
"""Heights at which a garment is cut."""
THICK = 0.02
"""Half the height of the slab of the body that is looked at [m]."""
MUCH = 1.15
"""How much longer than the line at rest the tape may be: that is what a garment may be stretched."""


class Narrow(NamedTuple):
    """A place at which a garment is too narrow for a motion.

    Attributes:
        height: Of the cut in the first frame [m].
        length: Length of the line at rest [m].
        needed: Length of the tape around what it goes around in each frame [m], [T].
    """

    height: float
    length: float
    needed: np.ndarray

    @property
    def frames(self) -> np.ndarray:
        """Frames in which the tape is much longer than the line."""
        return np.flatnonzero(self.needed > MUCH * self.length)

    def __str__(self) -> str:
        worst = int(self.needed.argmax())
        more = 100 * (self.needed[worst] / self.length - 1)
        return (
            f"too narrow for these steps: at a height of {self.height:.2f} m it is {self.length:.2f} m around, and the "
            f"body needs {self.needed[worst]:.2f} m there in frame {worst} ({more:.0f} % more), and more than "
            f"{100 * MUCH - 100:.0f} % more in {len(self.frames):,} of {len(self.needed):,} frames. The legs will go "
            "through it: widen, shorten or slit it, or take smaller steps."
        )


def too_narrow(
    rest: np.ndarray, first: np.ndarray, faces: np.ndarray, body: np.ndarray, body_faces: np.ndarray
) -> Narrow | None:
    """The place at which a garment is narrowest beside the steps of a body; None where it is wide enough.

    Args:
        rest: Rest positions of the garment [m], [V,3].
        first: Its positions in the first frame [m], [V,3].
        faces: Vertex indices, [F,3].
        body: Positions of the body [m], [T,U,3].
        body_faces: Vertex indices of the body, [G,3].
    """
    first, rest = np.asarray(first, np.float64), np.asarray(rest, np.float64)
    low, high = first[:, 1].min(), first[:, 1].max()
    edges = np.concatenate([body_faces[:, [0, 1]], body_faces[:, [1, 2]], body_faces[:, [2, 0]]])
    found: list[Narrow] = []
    for height in np.linspace(low, high, LEVELS + 2)[1:-1]:
        slab = np.abs(body[0, :, 1] - height) < THICK
        for outline, length in _lines(rest, first, faces, float(height)):
            inside = slab.copy()
            inside[slab] = _within(body[0, slab][:, [0, 2]].astype(np.float64), outline)
            if _parts(inside, edges) >= 2:
                needed = np.array([_tape(points[inside][:, [0, 2]]) for points in body])
                found.append(Narrow(float(height), length, needed))
    worst = max(found, key=lambda one: float(one.needed.max() / one.length), default=None)
    return worst if worst is not None and len(worst.frames) else None


def _lines(rest: np.ndarray, first: np.ndarray, faces: np.ndarray, height: float) -> list[tuple[np.ndarray, float]]:
    """Closed lines of a level cut: their points from above [m], [N,2], in order, and their lengths at rest [m]."""
    above = first[:, 1][faces] > height
    cut = faces[above.any(axis=1) & ~above.all(axis=1)]
    ends: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for face in cut.tolist():
        crossed = []
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            if (first[a, 1] > height) != (first[b, 1] > height):
                crossed.append((min(a, b), max(a, b)))
        for here, there in (crossed, crossed[::-1]):
            ends.setdefault(here, []).append(there)
    lines = []
    while ends:
        start, line = next(iter(ends)), []
        at: tuple[int, int] | None = start
        while at is not None and at in ends:
            line.append(at)
            onward = ends.pop(at)
            at = next((edge for edge in onward if edge in ends), start if start in onward and len(line) > 2 else None)
        if at != start or len(line) < 3:
            continue  # it ends at a border
        a, b = np.array(line).T
        share = ((height - first[a, 1]) / (first[b, 1] - first[a, 1]))[:, None]
        here, then = (p[a] + share * (p[b] - p[a]) for p in (first, rest))
        length = np.linalg.norm(np.roll(then, -1, axis=0) - then, axis=1).sum()
        lines.append((here[:, [0, 2]], float(length)))
    return lines


def _within(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Whether points [N,2] are inside a closed line [M,2], bool [N]: a ray from each crosses it oddly often."""
    x, y = points[:, :1], points[:, 1:]
    (ax, ay), (bx, by) = outline.T, np.roll(outline, -1, axis=0).T
    across = (ay > y) != (by > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = ax + (y - ay) / (by - ay) * (bx - ax)
    return np.asarray((across & (at > x)).sum(axis=1) % 2 == 1)


def _parts(kept: np.ndarray, edges: np.ndarray) -> int:
    """Number of pieces of a body that some of its vertices are on."""
    if not kept.any():
        return 0
    number = np.cumsum(kept) - 1
    mine = edges[kept[edges].all(axis=1)]
    count = int(kept.sum())
    graph = coo_matrix((np.ones(len(mine)), (number[mine[:, 0]], number[mine[:, 1]])), shape=(count, count))
    sizes = np.bincount(connected_components(graph, directed=False)[1])
    return int((sizes >= 3).sum())


def _tape(points: np.ndarray) -> float:
    try:
        return float(ConvexHull(points).area)  # of 2D: the perimeter
    except QhullError:
        return 0.0
