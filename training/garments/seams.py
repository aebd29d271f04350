"""Random seam cuts: slits from a boundary inwards and seams opened in the middle of a garment.

*Neural Garment Dynamics via Manifold-Aware Transformers* (Li et al. 2024, figure 9) cuts one dress in twelve ways, ten
for training and two for tests, to show that geodesic attention follows unseen connectivity. A cut is described by a
line in angles and heights around the garment, so it applies to any mesh: it runs along the edges nearest to that line.
"""

from __future__ import annotations

import itertools
from dataclasses import asdict, dataclass

import igl
import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra

from warpgarment.objects.garment import Garment

_SAMPLES = 48  # number of points along an ideal line
_APART = np.radians(30.0)  # least angle between cuts [rad]
_STRAIGHTNESS = 2.0  # growth of an edge's cost per edge length of distance from the line

# places of cuts, as angles about the vertical axis [degrees]: 0 is the front, 90 the left side, 180 the back
_SIDES = ((60.0, 120.0), (240.0, 300.0))
_ALL_AROUND = ((0.0, 360.0),)
_ANGLES = {
    "trousers": _SIDES,
    "jumpsuit": _SIDES,
    "jacket": ((50.0, 310.0),),
    "hooded_jacket": ((50.0, 310.0),),
}
_TALLEST = {"jacket": 0.45, "hooded_jacket": 0.4, "tshirt": 0.45, "top": 0.45, "dress": 0.6}


@dataclass(frozen=True)
class Seam:
    """One cut: the part of a garment's surface along a straight line in angle and height.

    Attributes:
        angle: Angle of the lower end about the vertical axis [rad]; 0 is the front (+Z), pi/2 the left side (+X).
        low: Height of the lower end as a share of the garment's height; at 0 or less the cut starts at the boundary and
            is a slit.
        high: Height of the upper end as a share of the garment's height.
        turn: Angle from the lower to the upper end [rad].
    """

    angle: float
    low: float
    high: float
    turn: float = 0.0


@dataclass(frozen=True)
class Seams:
    """Cuts of one garment.

    Attributes:
        cuts: Cuts in the order in which they are made; any number.
    """

    cuts: tuple[Seam, ...]

    def __bool__(self) -> bool:
        return bool(self.cuts)

    def as_dict(self) -> dict:
        """The cuts as plain values, for a manifest."""
        return asdict(self)


def sampled_seams(rng: np.random.Generator, category: str, count: int | None = None) -> Seams:
    """Cuts drawn at random: two thirds are slits from the hem, upright or slanted, the others seams within the garment.

    Args:
        rng: Random number generator.
        category: Category of the garment, which decides on the places of cuts.
        count: Number of cuts; None draws 1 to 3. There are fewer if no space is left between earlier cuts.
    """
    count = int(rng.integers(1, 4)) if count is None else count
    cuts: list[Seam] = []
    for _ in range(count):
        for _attempt in range(20):
            cut = _sampled_cut(rng, category)
            if all(_angle_between(cut, other) > _APART for other in cuts):
                cuts.append(cut)
                break
    return Seams(tuple(cuts))


def _sampled_cut(rng: np.random.Generator, category: str) -> Seam:
    ranges, tallest = _ANGLES.get(category, _ALL_AROUND), _TALLEST.get(category, 0.6)
    first, last = np.radians(ranges[int(rng.integers(len(ranges)))])
    angle = float(rng.uniform(first, last))
    if rng.random() < 2 / 3:  # a slit
        return Seam(angle, 0.0, float(rng.uniform(0.25, tallest)), float(np.radians(rng.uniform(-12.0, 12.0))))
    if rng.random() < 0.5 and category not in ("trousers", "jumpsuit"):  # level
        height, turn = float(rng.uniform(0.2, tallest)), float(np.radians(rng.uniform(30.0, 70.0)))
        return Seam(angle, height, height, turn if angle + turn < last else -turn)
    low = float(rng.uniform(0.12, 0.5 * tallest))  # upright
    return Seam(angle, low, low + float(rng.uniform(0.2, 0.3)))


def _angle_between(a: Seam, b: Seam) -> float:
    """Least angle between the parts of the circle that two cuts cover [rad]; 0 if they overlap."""
    middles = a.angle + 0.5 * a.turn - b.angle - 0.5 * b.turn
    return max(abs(float(np.angle(np.exp(1j * middles)))) - 0.5 * (abs(a.turn) + abs(b.turn)), 0.0)


def cut_seams(garment: Garment, seams: Seams) -> Garment:
    """Cuts a garment along mesh edges. Its rest shape does not change; each vertex along a cut is doubled in place.

    The copies of a vertex are not connected, so the cloth can part there. Both copies of a pinned vertex are pins.
    :func:`parted` moves the copies off each other for the start of a simulation.

    Args:
        garment: Upright garment of one or more pieces.
        seams: Cuts to make.

    Returns:
        The garment, with its number of pieces unchanged. Every cut has at least two edges, so that it opens.

    Raises:
        ValueError: A cut lies where the garment has no surface.
    """
    vertices, faces = garment.vertices.astype(np.float64), garment.faces.astype(np.int64)
    origin = np.arange(len(vertices))
    for number, cut in enumerate(seams.cuts):
        path = _path(vertices, faces, cut)
        if len(path) < 3:
            raise ValueError(
                f"cut {number} of {len(seams.cuts)} finds no path of two edges on garment {garment.name!r} "
                f"({cut}). Move it, or give the garment more faces."
            )
        steps = {frozenset(step) for step in itertools.pairwise(path)}
        marked = np.array([[frozenset((f[k], f[(k + 1) % 3])) in steps for k in range(3)] for f in faces.tolist()])
        vertices, faces, copied = igl.cut_mesh(vertices, faces, marked)
        vertices, faces = np.asarray(vertices), np.asarray(faces, dtype=np.int64)
        origin = origin[np.asarray(copied).ravel()]
    pins = np.flatnonzero(np.isin(origin, garment.pins))
    return Garment(garment.vertices[origin], faces.astype(np.int32), pins=pins, name=garment.name)


def parted(garment: Garment, vertices: np.ndarray, distance: float) -> np.ndarray:
    """Moves the two sides of cuts apart, which self-contact needs at the start of a simulation.

    Args:
        garment: Garment with vertices at the same place in its rest shape, as :func:`cut_seams` returns it.
        vertices: Start positions [m], shape [V, 3].
        distance: Distance between the sides of a cut [m].

    Returns:
        Positions [m], float32 [V, 3]; pins and vertices away from the cuts are not moved.
    """
    _, place, uses = np.unique(garment.vertices, axis=0, return_inverse=True, return_counts=True)
    double = uses[place.ravel()] > 1
    double[garment.pins] = False
    centres = vertices[garment.faces].mean(1).astype(np.float64)
    total, count = np.zeros(vertices.shape), np.zeros(len(vertices))
    np.add.at(total, garment.faces.ravel(), np.repeat(centres, 3, axis=0))
    np.add.at(count, garment.faces.ravel(), 1.0)
    inwards = total / count[:, None] - vertices
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    return (vertices + np.where(double, 0.5 * distance, 0.0)[:, None] * inwards).astype(np.float32)


def _path(vertices: np.ndarray, faces: np.ndarray, cut: Seam) -> list[int]:
    """Vertices of the mesh path nearest to a cut's line; except for the start of a slit they are inside the sheet."""
    line = _line(vertices, faces, cut)
    if len(line) < 2:
        return []
    border = np.zeros(len(vertices), bool)
    border[np.unique(igl.boundary_facets(faces)[0])] = True
    edges = igl.edges(faces)
    near_border = border.copy()
    near_border[edges[border[edges].any(1)]] = True
    inside = np.flatnonzero(~near_border)  # a cut must not end beside another boundary, with only an edge between them
    if not len(inside):
        return []
    if cut.low <= 0:
        rim = np.flatnonzero(border)
        start = int(rim[np.linalg.norm(vertices[rim] - line[0], axis=1).argmin()])
    else:
        start = int(inside[np.linalg.norm(vertices[inside] - line[0], axis=1).argmin()])
    end = int(inside[np.linalg.norm(vertices[inside] - line[-1], axis=1).argmin()])
    usable = ~border
    usable[start] = True
    edges = edges[usable[edges].all(1)]
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    middles = vertices[edges].mean(1)
    off = np.linalg.norm(middles[:, None] - line[None], axis=2).min(1)
    cost = length * (1.0 + _STRAIGHTNESS * (off / length.mean()) ** 2)
    graph = sp.coo_array((cost, (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2).tocsr()
    _, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    path = [end]
    while path[-1] != start:
        if before[path[-1]] < 0:
            return []
        path.append(int(before[path[-1]]))
    path.reverse()
    while len(path) < 3:  # the edges are longer than the cut
        beside = edges[(edges == path[-1]).any(1)].sum(1) - path[-1]
        beside = beside[~np.isin(beside, path)]
        if not len(beside):
            return []
        path.append(int(beside[(vertices[beside] @ (line[-1] - line[0])).argmax()]))
    return path


def _line(vertices: np.ndarray, faces: np.ndarray, cut: Seam) -> np.ndarray:
    """Points of the surface along a cut [m], shape [N, 3]; rays from the axis that meet no outside give no point."""
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    axis = 0.5 * (vertices.min(0) + vertices.max(0))
    a = vertices[faces[:, 0]]
    e1, e2 = vertices[faces[:, 1]] - a, vertices[faces[:, 2]] - a
    normal = np.cross(e1, e2)
    points = []
    for t in np.linspace(0.0, 1.0, _SAMPLES):
        height = low + (high - low) * max(cut.low + (cut.high - cut.low) * t, 0.0)
        angle = cut.angle + cut.turn * t
        direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
        eye = np.array([axis[0], height, axis[2]])
        # Moeller and Trumbore: eye + s direction = a + u e1 + v e2
        h = np.cross(direction, e2)
        determinant = (e1 * h).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = ((eye - a) * h).sum(1) / determinant
            q = np.cross(eye - a, e1)
            v = (q @ direction) / determinant
            s = (e2 * q).sum(1) / determinant
        met = (u >= 0) & (v >= 0) & (u + v <= 1) & (s > 0) & (normal @ direction > 0)
        if met.any():
            points.append(eye + s[met].min() * direction)  # the nearest outside is the torso, not a sleeve beyond it
    return np.array(points)
