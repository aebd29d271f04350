"""Openings of a garment (the loops of its border), and what they are: neck, cuffs, waist, hem, legs.

Two openings are a pair if they are equally long and lie opposite to each other in the middle plane of the others and
of the whole garment. What is left lies in that plane: with one pair, a neck and a hem are left of a shirt, a waist of
trousers; with two pairs, a neck of an overall. Without a pair there is a top and a bottom. All of this is free of
units, axes and places.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from warpgarment.errors import DressingError
from warpgarment.geometry.checks import directed_edges

SMALLEST = 0.08
"""Length of an opening as a share of the longest below which it is a slit, a hole, or a buttonhole."""
ALIKE = 0.6
"""Largest fault of two openings that are a pair, see `_fault`."""


class Opening(NamedTuple):
    """A loop of the border."""

    vertices: np.ndarray
    """Its vertices in their order, [N]."""
    length: float
    """In units of the mesh."""
    centre: np.ndarray
    """Mean of its points, weighted by length, [3]."""

    def points(self, positions: np.ndarray) -> np.ndarray:
        """Positions of its vertices, [N,3]."""
        return positions[self.vertices]


class Roles(NamedTuple):
    """What the openings of a garment are.

    Attributes:
        kind: "shirt" (anything with a neck and sleeves or armholes), "jacket" (the same, open in front), "trousers",
            "overall", or "tube" (skirts, tops without straps).
        top: Neck or waist.
        bottom: Hem; None for trousers and overalls.
        arms: Cuffs or armholes, two or none.
        legs: Hems of the legs, two or none.
        up: From the bottom of the garment to its top, unit vector [3].
        across: From one side to the other, unit vector [3]; None where nothing tells.
    """

    kind: str
    top: Opening
    bottom: Opening | None
    arms: tuple[Opening, ...]
    legs: tuple[Opening, ...]
    up: np.ndarray
    across: np.ndarray | None

    @property
    def named(self) -> dict[str, Opening]:
        """Openings by the names of a report."""
        top = "waist" if self.kind in ("trousers", "tube") else "neck"
        found = {top if self.kind != "tube" else "top": self.top}
        for name, pair in (("cuff", self.arms), ("leg", self.legs)):
            found |= {f"{name} {k + 1}": one for k, one in enumerate(pair)}
        return found | ({"hem": self.bottom} if self.bottom is not None else {})


def openings_of(vertices: np.ndarray, faces: np.ndarray) -> list[Opening]:
    """Loops of the border, the longest first; those that are short beside it are left out."""
    edges = directed_edges(faces)
    count = int(faces.max()) + 1
    keys, back = edges[:, 0].astype(np.int64) * count + edges[:, 1], edges[:, 1].astype(np.int64) * count + edges[:, 0]
    border = edges[~np.isin(keys, back)]
    following: dict[int, list[int]] = {}
    for i, j in border.tolist():
        following.setdefault(i, []).append(j)
    found = []
    while following:
        start = next(iter(following))
        loop, at = [], start
        while at in following:
            loop.append(at)
            onward = following[at]
            nearest = onward.pop()
            if not onward:
                del following[at]
            at = nearest
        points = vertices[loop].astype(np.float64)
        lengths = np.linalg.norm(np.roll(points, -1, 0) - points, axis=1)
        middles = 0.5 * (points + np.roll(points, -1, 0))
        total = float(lengths.sum())
        found.append(Opening(np.array(loop), total, (lengths[:, None] * middles).sum(0) / max(total, 1e-30)))
    found.sort(key=lambda opening: -opening.length)
    return [one for one in found if one.length >= SMALLEST * found[0].length]


def roles_of(vertices: np.ndarray, faces: np.ndarray) -> Roles:
    """What the openings of a garment are.

    Raises:
        DressingError: It has no opening, or one, so that a body cannot go in at one place and out at another.
    """
    points = np.asarray(vertices, np.float64)
    found = openings_of(points, faces)
    if len(found) < 2:
        number = "no opening" if not found else "one opening"
        raise DressingError(
            f"the garment has {number}: a body goes in at one and comes out at others. Hats, bags and closed meshes "
            "cannot be dressed; cut the openings, or remove the faces that close them."
        )
    pairs, rest = _pairs(points, found)
    if not pairs:
        top, bottom = sorted(rest[:2], key=lambda one: one.length)
        axis = _unit(top.centre - bottom.centre)
        upright = axis * (np.sign(axis[np.abs(axis).argmax()]) or 1.0)
        if upright @ axis < 0:  # a tube that is wider at its top: nothing tells that it is upside down
            top, bottom = bottom, top
        return Roles("tube", top, bottom, (), (), upright, None)
    first = pairs[0]
    across = _unit(first[0].centre - first[1].centre)
    middle = 0.5 * (first[0].centre + first[1].centre)
    if not rest:
        raise DressingError(
            f"the garment has {len(found)} openings and none of them lies in its middle: which is the neck, or the "
            "waist, cannot be told. Open it, or leave it where it is worn with place=False."
        )
    if len(pairs) == 2:
        top = min(rest, key=lambda one: one.length)
        arms, legs = sorted(pairs, key=lambda p: np.linalg.norm(0.5 * (p[0].centre + p[1].centre) - top.centre))
        up = _across_to(top.centre - 0.5 * (legs[0].centre + legs[1].centre), across)
        return Roles("overall", top, None, arms, legs, up, across)
    if len(rest) >= 2:
        top, bottom = sorted(rest[:2], key=lambda one: one.length)
        return Roles("shirt", top, bottom, first, (), _across_to(top.centre - bottom.centre, across), across)
    top = rest[0]
    up = _across_to(top.centre - middle, across)
    below = (middle @ up - (points @ up).min()) / np.ptp(points @ up)
    if below > 0.35 and np.ptp(top.points(points) @ up) < 0.3 * np.ptp(points @ up):  # feet or a hem without openings
        return Roles("shirt", top, None, first, (), up, across)
    if np.ptp(top.points(points) @ up) < 0.5 * np.ptp(points @ up):
        return Roles("trousers", top, None, (), first, up, across)
    spread = np.linalg.svd(top.points(points) - top.centre)[2][2]  # normal of the plane of neck, fronts and hem
    up = _across_to(np.cross(across, spread), across)
    up = up * (np.sign(up[np.abs(up).argmax()]) or 1.0)
    return Roles("jacket", top, None, first, (), up, across)


def line_from(vertices: np.ndarray, faces: np.ndarray, opening: Opening, longest: float, wider: float) -> np.ndarray:
    """Centres of rings of a sleeve or a leg from its opening inwards, [K,3].

    Args:
        vertices: Positions, [V,3].
        faces: Vertex indices, [F,3].
        opening: The opening at its end.
        longest: Length at which to stop.
        wider: How much wider than the opening a ring is that belongs to the trunk.
    """
    i, j = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    lengths = np.linalg.norm(vertices[i] - vertices[j], axis=1)
    graph = coo_matrix((lengths, (i, j)), shape=(len(vertices),) * 2).tocsr().maximum(0)
    graph = graph.maximum(graph.T)
    reach = dijkstra(graph, directed=False, indices=opening.vertices, min_only=True)
    band = max(float(np.median(lengths)) * 1.5, longest / 40)
    radius = float(np.linalg.norm(opening.points(vertices) - opening.centre, axis=1).mean())
    centres = [opening.centre]
    for k in range(1, int(longest / band)):
        ring = vertices[(reach >= k * band) & (reach < (k + 1) * band)]
        if len(ring) < 3:
            break
        centre = ring.mean(0)
        if np.linalg.norm(ring - centre, axis=1).mean() > wider * radius:
            break
        centres.append(centre)
    return np.array(centres)


def _pairs(points: np.ndarray, found: list[Opening]) -> tuple[list[tuple[Opening, Opening]], list[Opening]]:
    """Pairs of openings, two at most, and what is left."""
    rest = list(found)
    pairs: list[tuple[Opening, Opening]] = []
    while len(rest) >= 3 and len(pairs) < 2:
        faults = {(a, b): _fault(points, rest, a, b) for a, b in itertools.combinations(range(len(rest)), 2)}
        (a, b), least = min(faults.items(), key=lambda item: item[1])
        if least > ALIKE:
            break
        pairs.append((rest[a], rest[b]))
        rest = [one for k, one in enumerate(rest) if k not in (a, b)]
    return pairs, rest


def _fault(points: np.ndarray, found: list[Opening], a: int, b: int) -> float:
    """How little two openings are a pair: difference of lengths, and distance of the rest from their middle plane."""
    first, second = found[a], found[b]
    way = second.centre - first.centre
    size = np.linalg.norm(way)
    if size < 1e-9 * np.ptp(points, axis=0).max():
        return np.inf
    across, middle = way / size, 0.5 * (first.centre + second.centre)
    others = [abs((one.centre - middle) @ across) / size for k, one in enumerate(found) if k not in (a, b)]
    if len(others) > 1:  # others that are a pair lie on both sides
        others = [abs(sum((one.centre - middle) @ across for k, one in enumerate(found) if k not in (a, b)))
                  / size / len(others)] if len(others) == 3 else others  # fmt: skip
    along = (points - middle) @ across
    whole = abs(along.max() + along.min()) / np.ptp(along)
    return abs(np.log(first.length / second.length)) + 2.0 * float(np.mean(others)) + whole


def _across_to(vector: np.ndarray, across: np.ndarray) -> np.ndarray:
    """The unit vector of what a vector has perpendicular to another."""
    return _unit(vector - (vector @ across) * across)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-30)
