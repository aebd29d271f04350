"""Limbs of a standing body, from its mesh alone: tips, centre lines, where arms and legs begin, and girths.

The tip of the head is the highest vertex. Feet are the two vertices that are farthest from it, and from each other,
over the surface. On each side, the hand is the farthest of the vertices above the legs that are farther from the head
than all their neighbours. Rings around a limb are the vertices in a band of distances from its tip; a limb ends where
its rings become wider than those of an arm or a leg can be, beside the height of the body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import ConvexHull, QhullError, cKDTree

RINGS = 90
"""Bands in the height of a body."""
WIDEST = {"arm": 0.045, "leg": 0.056, "head": 0.052}
"""Mean radius of rings as a share of the height beyond which a limb has ended."""
SHORTEST = {"arm": 0.1, "leg": 0.25}
"""Length of a limb as a share of the height below which it is none."""


class Limb(NamedTuple):
    """An arm, a leg, or the head."""

    tip: int
    """Vertex at its end."""
    line: np.ndarray
    """Centres of its rings from the tip to the joint [m], [K,3]."""
    radius: np.ndarray
    """Mean radius of each ring [m], [K]."""
    reach: np.ndarray
    """Distance of each vertex from the tip over the surface [m], [V]."""
    end: float
    """That distance at the joint [m]."""

    @property
    def joint(self) -> np.ndarray:
        """Where it begins [m], [3]: shoulder, hip, or the base of the neck."""
        return self.line[-1]


class Limbs(NamedTuple):
    """What was found of a body. Left is its own left."""

    height: float
    """Height of the body [m]."""
    forward: np.ndarray
    """Horizontal unit vector to where it looks, [3]."""
    head: Limb
    arms: tuple[Limb, ...]
    """Left and right arm; empty if they were not found."""
    legs: tuple[Limb, ...]
    """Left and right leg; empty if they were not found."""

    @property
    def left(self) -> np.ndarray:
        """Horizontal unit vector to the left of the body, [3]."""
        return np.cross([0.0, 1.0, 0.0], self.forward)


def limbs_of(vertices: np.ndarray, faces: np.ndarray) -> Limbs:
    """Finds the limbs of a body.

    Args:
        vertices: Positions [m], Y up, [V,3].
        faces: Vertex indices, [F,3].
    """
    points = np.asarray(vertices, np.float64)
    graph = _graph(points, faces)
    used = np.unique(faces)
    height = float(np.ptp(points[used, 1]))
    top = int(used[points[used, 1].argmax()])
    reaches, tips = [_reach(graph, top)], [top]
    for _ in range(2):
        nearest = np.min(reaches, axis=0)[used]
        tips.append(int(used[np.where(np.isfinite(nearest), nearest, -1.0).argmax()]))
        reaches.append(_reach(graph, tips[-1]))
    head = _limb(points, used, top, reaches[0], height, "head")
    legs = [_limb(points, used, tips[k], reaches[k], height, "leg") for k in (1, 2)]
    low = points[used, 1].min() + 0.2 * height
    legs = [one for one in legs if one.end > SHORTEST["leg"] * height and points[one.tip, 1] < low]
    hands = _hands(points, graph, reaches[0], np.cross([0.0, 1.0, 0.0], _forward(points, legs, [])), height)
    arms = [_limb(points, used, tip, _reach(graph, tip), height, "arm") for tip in hands]
    arms = [one for one in arms if one.end > SHORTEST["arm"] * height]
    forward = _forward(points, legs, arms)
    left = np.cross([0.0, 1.0, 0.0], forward)

    def sided(found: list[Limb]) -> tuple[Limb, ...]:
        ordered = sorted(found, key=lambda limb: -float(limb.line[len(limb.line) // 2] @ left))
        return tuple(ordered) if len(ordered) == 2 else ()

    return Limbs(height, forward, head, sided(arms), sided(legs))


def edges_of(faces: np.ndarray) -> np.ndarray:
    """Edges of faces [F,3], each once, [E,2]."""
    return np.unique(np.sort(np.stack([faces, np.roll(faces, -1, 1)], 2).reshape(-1, 2), 1), axis=0)


def girth(vertices: np.ndarray, edges: np.ndarray, point: np.ndarray, normal: np.ndarray, reach: float) -> float:
    """Length of a tape around a body at a plane [m]: the convex hull of the cut near a point; 0 where there is none.

    Args:
        vertices: Positions [m], [V,3].
        edges: Ends of the edges, [E,2].
        point: A point of the plane, inside the limb [m], [3].
        normal: Normal of the plane, [3].
        reach: How far from the point the limb reaches at most [m].
    """
    normal = normal / np.linalg.norm(normal)
    height = (vertices - point) @ normal
    a, b = edges.T
    cut = (height[a] < 0) != (height[b] < 0)
    a, b = a[cut], b[cut]
    share = height[a] / (height[a] - height[b])
    found = vertices[a] + share[:, None] * (vertices[b] - vertices[a]) - point
    found = found[np.linalg.norm(found, axis=1) < reach]
    if len(found) < 3:
        return 0.0
    first = np.cross(normal, [0.3, 0.5, 0.8])
    first /= np.linalg.norm(first)
    try:
        return float(ConvexHull(np.stack([found @ first, found @ np.cross(normal, first)], 1)).area)  # of 2D: perimeter
    except QhullError:
        return 0.0


def girths(vertices: np.ndarray, faces: np.ndarray, limbs: Limbs, around: np.ndarray) -> dict[str, float]:
    """Length of a tape around the body where each opening may lie [m]; `around` as of `trunk`."""
    tall, up, edges = limbs.height, np.array([0.0, 1.0, 0.0]), edges_of(faces)
    found = {}
    neck = limbs.head.line[max(len(limbs.head.line) - 3, 0)]
    found["neck"] = girth(vertices, edges, neck, up, 0.1 * tall)
    for name, pair in (("cuff", limbs.arms), ("leg", limbs.legs)):
        if pair:
            at = [limb.line[int(0.6 * (len(limb.line) - 1))] for limb in pair]
            ways = [limb.line[-1] - limb.line[int(0.3 * (len(limb.line) - 1))] for limb in pair]
            each = [girth(vertices, edges, p, w, 0.07 * tall) for p, w in zip(at, ways, strict=True)]
            found[name] = float(np.mean(each))
    if len(around):
        found["waist"] = found["top"] = float(around[len(around) // 6 : -len(around) // 4 or None].min())
        found["hem"] = float(around[: max(len(around) // 2, 1)].max())
    return {name: size for name, size in found.items() if size > 0}


def trunk(vertices: np.ndarray, faces: np.ndarray, limbs: Limbs) -> tuple[np.ndarray, np.ndarray]:
    """Heights from the crotch to the armpits [m] and the girth of the trunk at each [m], [N] and [N]."""
    kept = np.ones(len(vertices), bool)
    for arm in limbs.arms:
        kept &= ~(arm.reach < arm.end)
    mine = edges_of(faces[kept[faces].all(1)])
    low, high = trunk_ends(vertices, limbs)
    heights = np.linspace(low, high, 33)
    middle = vertices[kept].mean(0)
    up = np.array([0.0, 1.0, 0.0])
    around = [girth(vertices, mine, np.array([middle[0], y, middle[2]]), up, 0.17 * limbs.height) for y in heights]
    return heights, np.array(around)


def trunk_ends(vertices: np.ndarray, limbs: Limbs) -> tuple[float, float]:
    """Heights of the crotch and of the armpits of a body [m]; `vertices` are its positions [m], [U,3]."""
    low = vertices[:, 1].min()
    crotch = np.mean([leg.joint[1] for leg in limbs.legs]) if limbs.legs else low + 0.48 * limbs.height
    armpit = np.mean([arm.joint[1] for arm in limbs.arms]) - 0.05 * limbs.height if limbs.arms else None
    return float(crotch), float(low + 0.72 * limbs.height if armpit is None else armpit)


def _graph(points: np.ndarray, faces: np.ndarray) -> csr_matrix:
    """Lengths of the edges [m]; pieces are joined where they are nearest."""
    i, j = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    count = len(points)

    def made(i: np.ndarray, j: np.ndarray) -> csr_matrix:
        length = np.maximum(np.linalg.norm(points[i] - points[j], axis=1), 1e-9)
        low, high = np.minimum(i, j), np.maximum(i, j)
        _, first = np.unique(low.astype(np.int64) * count + high, return_index=True)
        return coo_matrix((length[first], (low[first], high[first])), shape=(count, count)).tocsr()

    number, piece = connected_components(made(i, j), directed=False)
    sizes = np.bincount(piece[np.unique(faces)], minlength=number)
    order = [p for p in np.argsort(-sizes, kind="stable") if sizes[p]]
    joined = np.isin(piece, order[:1])
    for p in order[1:]:
        mine = np.flatnonzero(piece == p)
        there = np.flatnonzero(joined)
        distance, nearest = cKDTree(points[there]).query(points[mine])
        best = np.argsort(distance)[:3]
        i, j = np.concatenate([i, mine[best]]), np.concatenate([j, there[nearest[best]]])
        joined[mine] = True
    return made(i, j)


def _hands(points: np.ndarray, graph: csr_matrix, reach: np.ndarray, left: np.ndarray, height: float) -> list[int]:
    """Vertices at the ends of the arms, one for each side that has one."""
    i, j = graph.nonzero()
    finite = np.where(np.isfinite(reach), reach, -np.inf)
    most = finite.copy()
    np.maximum.at(most, i, finite[j])
    np.maximum.at(most, j, finite[i])
    middle, low = points.mean(0), points[:, 1].min()
    aside = (points - middle) @ left
    share = (points[:, 1] - low) / height
    ends = (finite >= most) & (finite > 0.2 * height) & (share > 0.35) & (share < 1.2) & (np.abs(aside) > 0.09 * height)
    found = []
    for side in (1.0, -1.0):
        mine = np.flatnonzero(ends & (side * aside > 0))
        found += [int(mine[finite[mine].argmax()])] if len(mine) else []
    return found


def _reach(graph: csr_matrix, start: int) -> np.ndarray:
    return dijkstra(graph, directed=False, indices=start)


def _limb(points: np.ndarray, used: np.ndarray, tip: int, reach: np.ndarray, height: float, kind: str) -> Limb:
    band = height / RINGS
    ring = np.full(len(points), -1)
    finite = used[np.isfinite(reach[used])]
    ring[finite] = (reach[finite] / band).astype(int)
    lines: list[np.ndarray] = []
    radii: list[float] = []
    narrowest = np.inf
    for k in range(RINGS):
        mine = points[ring == k]
        if len(mine) < 3:
            if lines:
                lines.append(lines[-1])
                radii.append(radii[-1])
            continue
        centre = mine.mean(0)
        radius = float(np.linalg.norm(mine - centre, axis=1).mean())
        if kind == "head" and (k + 0.5) * band > 0.11 * height:  # past the widest part: neck, then shoulders
            narrowest = min(narrowest, radius)
            if radius > 1.35 * narrowest:
                break
        if radius > WIDEST[kind] * height and (kind != "head" or (k + 0.5) * band > 0.2 * height):
            break
        lines.append(centre)
        radii.append(radius)
    if not lines:
        lines, radii = [points[tip]], [0.0]
    return Limb(tip, np.array(lines), np.array(radii), reach, (len(lines)) * band)


def _forward(points: np.ndarray, legs: list[Limb], arms: list[Limb]) -> np.ndarray:
    """Where toes point, or +Z."""
    toes = np.zeros(3)
    for leg in legs:
        ankle = leg.line[min(len(leg.line) - 1, RINGS // 7)]
        way = points[leg.tip] - ankle
        toes += [way[0], 0.0, way[2]]
    if len(arms) == 2:  # across the shoulders, with the sign of the toes
        across = arms[0].joint - arms[1].joint
        facing = np.cross(across, [0.0, 1.0, 0.0])
        if np.linalg.norm(facing) > 0:
            facing /= np.linalg.norm(facing)
            toes = facing * (np.sign(facing @ toes) or 1.0) if np.linalg.norm(toes) else facing * np.sign(facing[2])
    length = np.linalg.norm(toes)
    return toes / length if length > 0 else np.array([0.0, 0.0, 1.0])
