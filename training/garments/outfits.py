"""Outfits of two and three garments, disjoint at the start.

D-LAYERS (Towards Multi-Layered 3D Garments Animation, supplement B) has jumpsuits, dresses, T-shirts with trousers or
skirts, and jackets with and without hoods over them. Each garment is cut by itself; then outer garments are moved off
those below them, by heights along their normals that are smooth over the sheet. Where an inner garment ends, the outer
one follows the body.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import igl
import numpy as np

from warpgarment.bodies.rest import RestBody
from warpgarment.geometry.cutting import averaging, remeshed
from warpgarment.objects.garment import Garment

from .layers import Sheet
from .make import make_garment
from .pattern import Pattern, sampled_pattern

TWO = (
    ("tshirt", "trousers"),
    ("trousers", "tshirt"),
    ("top", "trousers"),
    ("tshirt", "skirt"),
    ("top", "skirt"),
    ("jumpsuit", "dress"),
    ("jumpsuit", "jacket"),
    ("jumpsuit", "hooded_jacket"),
    ("dress", "jacket"),
    ("dress", "hooded_jacket"),
)
THREE = (
    ("tshirt", "trousers", "jacket"),
    ("trousers", "tshirt", "jacket"),
    ("tshirt", "trousers", "hooded_jacket"),
    ("top", "trousers", "hooded_jacket"),
    ("tshirt", "skirt", "jacket"),
    ("top", "skirt", "hooded_jacket"),
    ("jumpsuit", "dress", "jacket"),
)
OUTER = ("jacket", "hooded_jacket", "dress")
INNER_GAP, MIDDLE_GAP, OUTER_GAP = 0.006, 0.011, 0.022
_REACH = 0.2  # largest distance at which an outer garment may have been cut behind an inner one [m]
_POKE = 0.03  # largest distance by which an inner garment may poke through a face of an outer one [m]
_ROUNDS, _STEP, _DIRECTION_SMOOTHING = 24, 0.02, 10
_STRETCHED = 1.3  # if an edge grows by a larger factor, the garment is remeshed
_ENOUGH = 0.75  # share of the distance between garments that must hold everywhere; all of it holds at a few points
_FADE = 0.97  # factor per smoothing step, so that the field decays within some ten edges of the part it clears


class OutfitError(ValueError):
    """Garments of an outfit could not be moved clear of each other."""


@dataclass(frozen=True)
class OutfitPattern:
    """Garments worn over each other. Their order decides, for instance, whether a T-shirt lies over the trousers.

    Attributes:
        layers: Patterns of the garments, innermost first.
        gaps: Least distance of each garment from the body [m].
        between: Least distance between garments where they lie over each other [m].
    """

    layers: tuple[Pattern, ...]
    gaps: tuple[float, ...]
    between: float = 0.012

    @property
    def name(self) -> str:
        """The categories, innermost first, such as "tshirt+trousers+jacket"."""
        return "+".join(pattern.category for pattern in self.layers)

    def as_dict(self) -> dict:
        """Plain values for a manifest."""
        return asdict(self)


@dataclass(frozen=True)
class LayerReport:
    """Collisions between the garments of an outfit.

    Attributes:
        intersections: Number of pairs of triangles of different garments that cross.
        smallest_gap: Least distance between two garments [m]; 0 if they cross, infinite for a single garment.
        inside: Largest share of an outer garment's vertices that are behind an inner one.
        self_intersections: Number of pairs of triangles of one garment that cross and share no vertex.
        crossing: Number of pairs of triangles that cross for each pair of garments, given by their numbers, inner one
            first; a garment that crosses itself has its number twice.
    """

    intersections: int
    smallest_gap: float
    inside: float
    self_intersections: int
    crossing: dict[tuple[int, int], int]


def sampled_outfit(rng: np.random.Generator, faces: int, count: int | None = None) -> OutfitPattern:
    """An outfit drawn at random.

    Args:
        rng: Random number generator.
        faces: Number of faces of a T-shirt; that of other garments scales with their area.
        count: Number of garments, 2 or 3; None draws it, too.

    Raises:
        ValueError: The number of garments is another.
    """
    if count not in (None, 2, 3):
        raise ValueError(f"outfits have 2 or 3 garments, not {count}")
    count = count or int(rng.integers(2, 4))
    choices = TWO if count == 2 else THREE
    categories = choices[int(rng.integers(len(choices)))]
    return outfit_of(categories, rng, faces)


def outfit_of(categories: Sequence[str], rng: np.random.Generator, faces: int) -> OutfitPattern:
    """An outfit with measures drawn at random.

    Args:
        categories: Categories of the garments, innermost first.
        rng: Random number generator.
        faces: Number of faces of a T-shirt; that of other garments scales with their area.
    """
    layers, gaps = [], []
    for order, category in enumerate(categories):
        pattern = sampled_pattern(category, rng, faces)
        gap = INNER_GAP if order == 0 else MIDDLE_GAP
        if order and category in OUTER:
            gap = OUTER_GAP + 0.006 * (order - 1) + float(rng.uniform(0.0, 0.008))
        tucked = order == 0 and category in ("tshirt", "top") and categories[1] in ("trousers", "skirt")
        hem = float(rng.uniform(0.015, 0.03)) if tucked else pattern.hem  # a longer one would hang between the legs
        layers.append(replace(pattern, ease=gap + float(rng.uniform(0.003, 0.008)), hem=hem))
        gaps.append(gap)
    return OutfitPattern(tuple(layers), tuple(gaps))


def make_outfit(body: RestBody, outfit: OutfitPattern) -> tuple[tuple[Garment, float], ...]:
    """Cuts the garments of an outfit and moves them off each other.

    Args:
        body: The body in its rest pose.
        outfit: Patterns and distances of the garments.

    Returns:
        Each garment and its intended edge length [m], innermost first.

    Raises:
        OutfitError: Garments still cross; the message names them and the number of crossings.
    """
    made: list[tuple[Garment, float]] = []
    for pattern, gap in zip(outfit.layers, outfit.gaps, strict=True):
        garment, edge = make_garment(body, pattern, gap)
        made.append(_over(garment, edge, [g for g, _ in made], body, gap, outfit.between) if made else (garment, edge))
    crossing = layers_disjoint([garment for garment, _ in made]).crossing
    if crossing:
        names = [pattern.category for pattern in outfit.layers]
        pairs = [f"{names[k]} and {'itself' if n == k else names[n]} {count:,}" for (n, k), count in crossing.items()]
        raise OutfitError(
            f"triangles of outfit {outfit.name} cross at the start, pairs of {', '.join(pairs)}. "
            "Give outer garments larger gaps, use more faces, or draw another outfit."
        )
    return tuple(made)


def layers_disjoint(garments: Sequence[Garment]) -> LayerReport:
    """Measures collisions between the garments of an outfit, innermost first, at rest; crossings are exact."""
    sheets = [Sheet(garment.faces) for garment in garments]
    points = [garment.vertices for garment in garments]
    crossing, gap, inside = {}, np.inf, 0.0
    for n, k in itertools.combinations(range(len(garments)), 2):
        pairs = int(sheets[n].crossings(points[n], sheets[k], points[k]).sum())
        if pairs:
            crossing[n, k] = pairs
        gap = min(gap, 0.0 if pairs else sheets[n].gap_to(points[n], sheets[k], points[k]))
        inside = max(inside, float(sheets[n].locate(points[n], points[k]).behind().mean()))
    between = sum(crossing.values())
    for k, (sheet, vertices) in enumerate(zip(sheets, points, strict=True)):
        if own := int(sheet.self_crossings(vertices).sum()):
            crossing[k, k] = own
    return LayerReport(between, float(gap), inside, sum(crossing.values()) - between, crossing)


def _over(
    garment: Garment, edge: float, below: Sequence[Garment], body: RestBody, gap: float, between: float
) -> tuple[Garment, float]:
    """The garment moved off those below it, and remeshed if that stretched it; and the intended edge length [m]."""
    inner = [_Below(g) for g in below]
    done = _moved(garment, _cleared(garment.vertices.astype(np.float64), garment.faces, inner, body, gap, between))
    before, after = (np.linalg.norm(np.diff(g.vertices[garment.edges], axis=1), axis=2) for g in (garment, done))
    if (after / before).max() > _STRETCHED:
        points, faces, edge = remeshed(done.vertices.astype(np.float64), garment.faces, len(garment.faces))
        done = Garment(points, faces, pins=_carried_pins(done, points), name=garment.name)
    for attempt in range(4):
        points = _cleared(done.vertices.astype(np.float64), done.faces, inner, body, gap, between * 1.15**attempt)
        done = _moved(done, points)
        if all(layers_disjoint([inside, done]).smallest_gap > _ENOUGH * between for inside in below):
            break
    return done, edge


def _moved(garment: Garment, vertices: np.ndarray) -> Garment:
    return Garment(vertices.astype(np.float32), garment.faces, pins=garment.pins, name=garment.name)


def _carried_pins(garment: Garment, points: np.ndarray) -> np.ndarray:
    """Points on a garment's surface, as indices, that of the vertices of their face are nearest to a pin."""
    pinned = np.zeros(len(garment.vertices), bool)
    pinned[garment.pins] = True
    vertices, faces = garment.vertices.astype(np.float64), garment.faces.astype(np.int64)
    _, face, closest = igl.point_mesh_squared_distance(points, vertices, faces)
    nearest = np.linalg.norm(vertices[faces[face]] - closest[:, None], axis=2).argmin(1)
    return np.flatnonzero(pinned[faces[face, nearest]])


class _Below:
    """An inner garment and points all over it: vertices, and middles of edges and faces, with normals."""

    def __init__(self, garment: Garment):
        self.sheet = Sheet(garment.faces)
        self.vertices = v = garment.vertices.astype(np.float64)
        of_faces = garment.face_frames[:, :, 2]
        of_vertices = _vertex_normals(v, garment.faces)
        of_edges = of_vertices[garment.edges].sum(1)
        of_edges /= np.linalg.norm(of_edges, axis=1, keepdims=True)
        self.points = np.concatenate([v, v[garment.edges].mean(1), v[garment.faces].mean(1)])
        self.normals = np.concatenate([of_vertices, of_edges, of_faces])


def _cleared(
    vertices: np.ndarray, faces: np.ndarray, below: Sequence[_Below], body: RestBody, gap: float, between: float
) -> np.ndarray:
    """Vertices moved to at least `gap` from the body and `between` in front of the garments below.

    They move along smoothed normals of the original sheet, each by a height of its own. Heights that are too small are
    raised in rounds, between which all heights are smoothed and reduced.
    """
    sheet, mean = Sheet(faces), averaging(faces, len(vertices))
    direction = _vertex_normals(vertices, faces)
    for _ in range(_DIRECTION_SMOOTHING):
        direction = 0.5 * direction + 0.5 * (mean @ direction)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    height = np.zeros(len(vertices))
    for rounds in range(_ROUNDS):
        for _ in range(4 if rounds < _ROUNDS - 8 else 0):
            height = _FADE * (0.5 * height + 0.5 * (mean @ height))
        points = vertices + height[:, None] * direction
        rise = _off_body(points, direction, body, gap)
        for inner in below:
            rise = np.maximum(rise, _off_inner(points, direction, inner, between))
            rise = np.maximum(rise, _off_points(points, direction, sheet, inner, between))
        if rise.max() < 1e-4:
            break
        height = height + np.minimum(rise, _STEP)
    return vertices + height[:, None] * direction


def _off_body(points: np.ndarray, direction: np.ndarray, body: RestBody, gap: float) -> np.ndarray:
    """Height by which vertices must rise to be clear of the body [m]."""
    distance, _, closest, normal = igl.signed_distance(
        points, body.vertices, body.faces.astype(np.int64), sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    )
    return np.maximum(gap - distance, 0.0) / _steepness(distance, points, closest, normal, direction)


def _off_inner(points: np.ndarray, direction: np.ndarray, inner: _Below, between: float) -> np.ndarray:
    """Height by which vertices that are behind an inner garment, or too close to it, must rise [m]."""
    at = inner.sheet.locate(inner.vertices, points)
    wanted = at.interior & (np.abs(at.distance) < _REACH) & ((at.normal * direction).sum(1) > 0.2)
    rise = np.maximum(between - at.distance, 0.0)
    return np.where(wanted, rise / _steepness(at.distance, points, at.closest, at.normal, direction), 0.0)


def _off_points(points: np.ndarray, direction: np.ndarray, sheet: Sheet, inner: _Below, between: float) -> np.ndarray:
    """Height [m] by which the corners of a face must rise if an inner garment pokes through it or is too close."""
    at = sheet.locate(points, inner.points)
    wanted = at.interior & (np.abs(at.distance) < _POKE) & ((at.normal * inner.normals).sum(1) > 0.5)
    short = np.where(wanted, np.maximum(between + at.distance, 0.0), 0.0)
    share = at.weights / (at.weights**2).sum(1, keepdims=True)
    rise = np.zeros(len(points))
    np.maximum.at(rise, sheet.faces[at.face], share * short[:, None])
    return rise


def _steepness(
    distance: np.ndarray, points: np.ndarray, closest: np.ndarray, normal: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Rate of growth of the signed distance along a direction, at least a third."""
    away = np.where(np.abs(distance)[:, None] > 1e-5, (points - closest) * np.sign(distance)[:, None], normal)
    away = away / np.linalg.norm(away, axis=1, keepdims=True)
    return np.maximum((away * direction).sum(1), 1.0 / 3.0)


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.asarray(igl.per_vertex_normals(vertices, faces.astype(np.int64)))
