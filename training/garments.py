"""Parametric garments, cut from the body's surface in its rest pose and offset from it.

A garment is the part of the template where a signed field is positive (below the neckline, above the hem, up to a
point along the sleeve), moved outwards, smoothed, remeshed isotropically and kept clear of the body. Skirts continue
from the lower boundary loop as a flared tube.
"""

from __future__ import annotations

import itertools
from dataclasses import asdict, dataclass

import numpy as np

from warpgarment.garment import Garment

from .bodies import RestBody
from .mesh_cutting import boundary_loops, cut_below_zero, pushed_out, remeshed

CATEGORIES = ("tshirt", "top", "trousers", "skirt", "dress", "jumpsuit")
_SIZE = {"tshirt": 1.0, "top": 0.8, "trousers": 1.0, "skirt": 1.2, "dress": 1.5, "jumpsuit": 1.5}  # by area
_FAR = 9.0
_WAISTBAND = 0.03


@dataclass(frozen=True)
class Pattern:
    """What is sampled of a garment. Lengths in metres, shares in 0..1.

    Attributes:
        category: One of :data:`CATEGORIES`.
        sleeve: Share of the upper arm that sleeves cover.
        hem: How far a shirt reaches below the hips' widest part.
        leg: Share of the leg that trousers cover.
        skirt_length: Length of a skirt below the waist seam.
        flare: Growth of a skirt's radius over its length.
        ease: Distance from the body it is cut with.
        neck: How far the neckline is lowered.
        faces: Number of faces aimed at.
    """

    category: str
    sleeve: float = 0.6
    hem: float = 0.06
    leg: float = 0.9
    skirt_length: float = 0.5
    flare: float = 0.15
    ease: float = 0.014
    neck: float = 0.0
    faces: int = 1200

    def as_dict(self) -> dict[str, float | int | str]:
        """Plain values for a manifest."""
        return asdict(self)


def sampled_pattern(category: str, rng: np.random.Generator, faces: int) -> Pattern:
    """A pattern with its measures drawn at random."""
    if category not in CATEGORIES:
        raise ValueError(f"unknown garment category {category!r}; there are {', '.join(CATEGORIES)}")
    loose = category in ("trousers", "jumpsuit")
    return Pattern(
        category=category,
        sleeve=0.12 if category == "top" else float(rng.uniform(0.35, 0.85)),
        hem=float(rng.uniform(0.04, 0.14)),
        leg=float(rng.uniform(0.45, 0.92)),
        skirt_length=float(rng.uniform(0.35, 0.65)),
        flare=float(rng.uniform(0.08, 0.22)),
        ease=float(rng.uniform(0.028, 0.040) if loose else rng.uniform(0.012, 0.020)),
        neck=float(rng.uniform(0.0, 0.02)),
        faces=round(faces * _SIZE[category] * rng.uniform(0.85, 1.15)),
    )


def make_garment(body: RestBody, pattern: Pattern, gap: float = 0.011) -> tuple[Garment, float]:
    """Cuts a garment for a body.

    Args:
        body: The body in its rest pose.
        pattern: Measures of the garment.
        gap: Least distance from the body at the start [m].

    Returns:
        The garment, its waistband pinned where the category needs it, and the edge length aimed at [m].
    """
    vertices, faces = cut_below_zero(body.vertices, body.faces.astype(np.int64), _field(body, pattern))
    normals = _vertex_normals(vertices, faces)
    vertices = pushed_out(
        vertices + normals * pattern.ease, faces, body.vertices, body.faces, 0.5 * pattern.ease, rounds=4, smoothing=10
    )
    if pattern.category in ("skirt", "dress"):
        vertices, faces = _with_tube(vertices, faces, pattern.skirt_length, pattern.flare, bulge=0.06, rings=24)
    elif pattern.category in ("tshirt", "top"):
        vertices, faces = _with_tube(vertices, faces, pattern.hem, 0.2 * pattern.flare, bulge=0.01, rings=6)
    vertices, faces, edge = remeshed(vertices, faces, pattern.faces)
    vertices = pushed_out(vertices, faces, body.vertices, body.faces, gap, rounds=8, smoothing=3)
    name = pattern.category
    return Garment(vertices.astype(np.float32), faces.astype(np.int32), pins=_pins(vertices, name), name=name), edge


def _field(body: RestBody, pattern: Pattern) -> np.ndarray:
    """Positive where the garment is [m], shape [U]."""
    category, (x, y, z) = pattern.category, body.vertices.T
    left, right = body.weight_of("LeftArm") > 0.25, body.weight_of("RightArm") > 0.25
    on_arm = left | right
    waist = body.joint("LowerBack")[1] + 0.06
    hip = body.joint("LeftUpLeg")[1]
    leg_length = hip - body.joint("LeftFoot")[1]
    keep = np.full(len(x), _FAR)
    if category in ("tshirt", "top", "jumpsuit", "dress"):
        neck = body.joint("Neck")
        keep = np.minimum(keep, neck[1] + 0.045 - pattern.neck - y - 0.5 * (z - neck[2]))
        for mask, side in ((left, "Left"), (right, "Right")):
            shoulder, elbow = body.joint(f"{side}Arm"), body.joint(f"{side}ForeArm")
            length = np.linalg.norm(elbow - shoulder)
            along = (body.vertices - shoulder) @ ((elbow - shoulder) / length)
            keep = np.where(mask, np.minimum(keep, pattern.sleeve * length - along), keep)
    if category in ("tshirt", "top"):
        keep = np.minimum(keep, np.where(on_arm, _FAR, y - (hip + 0.02)))
    if category == "dress":
        keep = np.minimum(keep, np.where(on_arm, _FAR, y - waist))
    if category in ("trousers", "jumpsuit"):
        keep = np.minimum(keep, np.where(on_arm, _FAR, y - (hip - pattern.leg * leg_length)))
    if category in ("trousers", "skirt"):
        keep = np.minimum(keep, np.where(on_arm, -_FAR, waist - y))
    if category == "skirt":
        keep = np.minimum(keep, y - (waist - 0.10))
    return keep


def _with_tube(vertices: np.ndarray, faces: np.ndarray, length: float, flare: float, bulge: float, rings: int):
    """Extrudes the lowest boundary loop downwards as a tube that widens by `flare` [m] and, at once, by `bulge` [m]."""
    loop = min(boundary_loops(faces), key=lambda l: vertices[l, 1].mean())
    base = vertices[loop]
    centre = base.mean(0)
    radial = (base - centre) * np.array([1.0, 0.0, 1.0])
    radius = np.linalg.norm(radial, axis=1, keepdims=True)
    direction = radial / radius
    points, rows = [vertices], [loop]
    top = base[:, 1:2]
    for ring in range(1, rings + 1):
        t = ring / rings
        ringed = centre + direction * (radius + flare * t + bulge * np.sin(0.5 * np.pi * min(2.2 * t, 1.0)))
        ringed[:, 1:2] = top - length * t
        rows.append(len(vertices) + (ring - 1) * len(loop) + np.arange(len(loop)))
        points.append(ringed)
    following = np.roll(np.arange(len(loop)), -1)
    strips = [faces]
    for a, b in itertools.pairwise(rows):
        strips.append(np.stack([a[following], a, b], 1))
        strips.append(np.stack([a[following], b, b[following]], 1))
    joined = np.concatenate(strips)
    points = np.concatenate(points)
    return points, _consistently_oriented(points, joined, len(faces))


def _consistently_oriented(vertices: np.ndarray, faces: np.ndarray, first_new: int) -> np.ndarray:
    """Flips the new faces where they disagree with the old ones along the seam."""
    old = {tuple(e) for f in faces[:first_new] for e in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
    clash = any(tuple(e) in old for f in faces[first_new:] for e in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0])))
    if clash:
        faces = np.concatenate([faces[:first_new], faces[first_new:, ::-1]])
    return faces


def _pins(vertices: np.ndarray, category: str) -> np.ndarray | None:
    """The waistband of garments that nothing else holds up."""
    if category not in ("trousers", "skirt"):
        return None
    return np.flatnonzero(vertices[:, 1] > vertices[:, 1].max() - _WAISTBAND).astype(np.int32)


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    import igl

    return np.asarray(igl.per_vertex_normals(vertices, faces.astype(np.int64)))
