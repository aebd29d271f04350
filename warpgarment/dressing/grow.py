"""Thinner and thinner bodies inside a body, from which it grows into a garment, and goes back to its own pose.

Positions flow along the heat equation of the body's own surface, x' = Δ x, in implicit steps (M + dt L) x⁺ = M x. A
limb of radius r shrinks as exp(-t / r²): arms become lines first, then legs, then the trunk, and all of it stays where
it was. Played backwards, a line in the middle of each sleeve grows to an arm.

| symbol | code | what |
| --- | --- | --- |
| x | `points` | positions of the body [m], [U,3] |
| L, M | `_laplacian`, `_mass` | cotangent Laplacian, a third of the area of the faces at each vertex [m²] |
| t | `times` | time of each of the thin bodies [m²] |
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from warpgarment.errors import DressingError
from warpgarment.kernels.mesh.laplacian import cotangent_laplacian
from warpgarment.progress import counted

from .bend import Bend
from .beneath import Beneath
from .drape import Drape
from .limbs import Limbs
from .measure import crossing_pairs, depth_of

FIRST, LAST, RATIO = 2e-5, 6e-3, 1.15
"""First and last time of the flow [m²] for a body 1.75 m tall, and the largest ratio of a time to the one before."""
TALL = 1.75
A_STEP = 0.006
"""Most that the body moves near the garment in a step [m]."""
REACH = 0.015
"""Most that garments beneath move in a step [m]."""
MORE = 20
"""Most steps in which they catch up."""


def thin_bodies(points: np.ndarray, faces: np.ndarray, height: float) -> np.ndarray:
    """A body and ever thinner ones, float64 [K,U,3] in metres, the body itself first.

    Args:
        points: Positions of the body [m], [U,3].
        faces: Vertex indices, [G,3].
        height: Height of the body [m].
    """
    x = np.asarray(points, np.float64)
    corner = x[faces]
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    good = faces[area > 1e-12 * area.max()]
    mass = np.bincount(faces.ravel(), np.repeat(area / 3, 3), minlength=len(x))
    mass = np.maximum(mass, 1e-9 * mass.max())
    laplacian = cotangent_laplacian(x, good)
    unit = (height / TALL) ** 2
    times = [0.0]
    while times[-1] < LAST * unit:
        times.append(max(times[-1] * RATIO, times[-1] + FIRST * unit))
    found = [x]
    for step in np.diff(times):
        x = splu((diags(mass) + step * laplacian).tocsc()).solve(mass[:, None] * x)
        found.append(x)
    return np.stack(found)


class Growing:
    """The body in the garment's pose, from thin to itself, and its way to its own pose.

    Args:
        at: Positions of the body [m], [U,3].
        faces: Vertex indices, [G,3].
        limbs: Its limbs.
        bends: Those that follow sleeves and legs.
        beneath: What it wears already, or None.

    Attributes:
        thin: The body in the garment's pose and ever thinner, [K,U,3].
    """

    def __init__(
        self, at: np.ndarray, faces: np.ndarray, limbs: Limbs, bends: Sequence[Bend], beneath: Beneath | None = None
    ) -> None:
        self.own, self.faces, self._bends, self._tall = at, faces, bends, limbs.height
        self.thin = thin_bodies(self.posed(1.0), faces, limbs.height)
        self.beneath = beneath

    def posed(self, share: float) -> np.ndarray:
        """The body with its limbs turned by a share of their turns [m], [U,3]."""
        points = self.own
        for bend in self._bends:
            points = bend.at(share, points)
        return points

    def worn(self, level: int) -> np.ndarray | None:
        """Positions of the garments beneath on a thin body [m], [W,3]; None if there are none."""
        if self.beneath is None:
            return None
        return self.beneath.thin(self.posed(1.0), self.thin[level], level / (len(self.thin) - 1))

    def crossing(self, points: np.ndarray, faces: np.ndarray, level: int) -> int:
        """Number of pairs of faces of a garment [V,3] that cross a thin body or what it wears."""
        count = crossing_pairs(points, faces, self.thin[level], self.faces)
        worn = self.worn(level)
        if worn is not None and self.beneath is not None:
            count += crossing_pairs(points, faces, worn, self.beneath.faces)
        return count

    def start(self, rest: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int]:
        """Positions of a garment at the start [m], and the number of the thin body that it is clear of.

        Args:
            rest: Positions of the garment at its place [m], [V,3].
            faces: Vertex indices, [F,3].

        Raises:
            DressingError: There is none, even if the garment is moved a little.
        """
        last = len(self.thin) - 1
        step = 0.012 * self._tall
        moves = [np.zeros(3)] + [
            step * far * np.array(way, float)
            for far in (1.0, 2.0, 3.0)
            for way in ((0, 1, 0), (0, 0, 1), (0, 0, -1), (0, -1, 0), (0, 1, 1), (0, 1, -1), (0, -1, 1), (0, -1, -1))
        ]
        best, least = moves[0], None
        for move in moves:
            count = self.crossing(rest + move, faces, last)
            if least is None or count < least:
                best, least = move, count
            if count == 0:
                break
        if least:
            raise DressingError(
                f"a body as thin as a line still crosses the garment, at {least:,} pairs of faces: its sleeves or legs "
                "do not lead where the limbs are, or it is closed inside. Look at it beside the body; give turn=, "
                "unit= or up=, or put it around the body and give place=False."
            )
        points, level = rest + best, last
        while level > 0 and self.crossing(points, faces, level - 1) == 0:
            level -= 1
        return points, min(level + 2, last) if level else 0

    def grown(self, drape: Drape, level: int, near: np.ndarray, name: str, progress: bool) -> int:
        """Grows the body in the garment and brings it to its pose; returns the number of steps.

        Args:
            drape: The garment, with those beneath held.
            level: Number of the thin body with which it starts.
            near: Positions [m], [V,3]: the body moves little between steps where it is near to these.
            name: Of the garment, for the progress bar.
            progress: Whether there is one.
        """
        low, high = near.min(0) - 0.05, near.max(0) + 0.05
        touched = ((self.posed(1.0) > low) & (self.posed(1.0) < high)).all(1)
        steps = [(self.thin[k], self.worn(k)) for k in range(level - 1, -1, -1)]
        for share in self._back(touched):
            posed = self.posed(share)
            steps.append((posed, None if self.beneath is None else self.beneath.at(posed)))
        for body, worn in counted(steps, f"dressing {name}".strip(), unit="step", shown=progress):
            drape.step(body, gravity=0.1, moved=None if worn is None else _towards(worn, drape))
        if self.beneath is None:
            return len(steps)
        for done in range(MORE):
            if np.abs(self.beneath.points - drape.held).max() < 1e-3:
                return len(steps) + done
            drape.step(self.own, gravity=0.1, moved=_towards(self.beneath.points, drape))
        return len(steps) + MORE

    def _back(self, near: np.ndarray) -> list[float]:
        """Shares of the turns of limbs on the way from the garment's pose to the body's own, the last one 0.

        Args:
            near: Vertices that are near the garment, bool [U].
        """
        if not self._bends or not near.any():
            return []
        way = np.linalg.norm(self.posed(1.0) - self.own, axis=1)[near].max()
        count = int(np.ceil(1.6 * way / A_STEP))  # a turn is longer than the way, and begins slowly
        return [1.0 - k / count for k in range(1, count + 1)]


def _towards(goal: np.ndarray, drape: Drape) -> np.ndarray:
    """Where held vertices of a drape go in a step to a goal [m], [W,3]."""
    way = goal - drape.held
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return drape.held + way * np.minimum(1.0, REACH / np.maximum(length, 1e-12))


def cleared(drape: Drape, at: np.ndarray, edges: np.ndarray, faces: np.ndarray) -> int:
    """Keeps more distance where the body comes through edges and faces; returns the number of steps.

    Args:
        drape: The garments on the body.
        at: Positions of the body [m], [U,3].
        edges: Ends of the edges of the garments, packed, [E,2].
        faces: Vertex indices, packed, [F,3].
    """
    for done in range(6):
        depth = depth_of(drape.points, edges, faces, drape.body)
        if float(depth.garments[0]) <= 0.0:
            return 3 * done
        drape.keep += 1.5 * depth.missing
        for _ in range(3):
            drape.step(at)
    return 18
