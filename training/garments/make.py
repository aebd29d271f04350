"""Parametric garments, cut from a surface around the body in its rest pose.

A garment is the part of that surface (`garment_shell`) where a signed field is positive (`garment_regions`): below the
neckline, above the hem, up to a point along the sleeve. Skirts and hems continue from the lower boundary as tubes
(`garment_tubes`), jackets are opened in front, and the whole is remeshed isotropically and kept clear of the body.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from warpgarment.objects.garment import Garment
from warpgarment.training.bodies.anny import RestBody
from warpgarment.training.meshes.cutting import (
    cut_below_zero,
    largest_piece,
    pushed_out,
    remeshed,
    smoothed_boundary,
    split_at_zero,
    without_specks,
)

from .faults import faults
from .regions import JACKETS, PINNED_NECKLINES, WITH_BODICE, WITH_TUBE, bottom, covered, ease_field, keep_field, waist
from .shell import shell
from .tubes import with_tube

CATEGORIES = ("tshirt", "top", "trousers", "skirt", "dress", "jumpsuit", "jacket", "hooded_jacket")
NECKLINES = ("round", "v", "wide", *PINNED_NECKLINES)
_NECKLINES = {
    "tshirt": ("round", "v", "wide"),
    "top": NECKLINES,
    "dress": NECKLINES,
    "jumpsuit": ("round", "v", "straps"),
    "jacket": ("round", "v"),
}
# faces relative to a T-shirt, by area
_SIZE = {"tshirt": 1.0, "top": 0.8, "trousers": 1.0, "skirt": 1.0, "dress": 1.4, "jumpsuit": 1.5, "jacket": 1.3}
_BAND = 0.03  # height of what is pinned [m]
_FLOOR = 0.06  # skirts end at least this much above the floor [m]


@dataclass(frozen=True)
class Pattern:
    """What is sampled of a garment. Lengths in metres, shares without unit.

    Attributes:
        category: One of :data:`CATEGORIES`.
        sleeve: Where sleeves end: 0 at the shoulder, 1 at the elbow, 2 at the wrist. See :func:`needs_forearms`. There
            are none with straps or strapless.
        hem: How far a shirt or jacket reaches below the hips, 2 cm above their joints; negative: it ends above them.
        leg: Share of the leg that trousers cover.
        skirt_length: Length of a skirt below the waist seam; one that would reach the floor ends above it.
        flare: Growth of a skirt's radius over its length, beyond what the body below it takes; of the hem of shirts and
            jackets, per metre.
        ease: Distance from the body it is cut with.
        neck: How far the neckline is lowered in front; of straps and strapless garments, the upper edge.
        faces: Number of faces aimed at.
        neckline: One of :data:`NECKLINES`; jackets have the first three only. Straps, and the upper edge of strapless
            garments, are pins.
        neck_width: How far the neckline is widened on each side; straps move outwards by half of it.
        strap: Width of each strap.
        sleeve_flare: Growth of the sleeves' distance from the arm, from shoulder to elbow.
        leg_flare: Growth of the trouser legs' distance from the leg, from hip to ankle.
        waist: How far waistline or waistband lie above their usual place.
        opening: Width of a jacket's opening in front.
        hood: Distance between head and hood, beyond the ease. The hood's crown is pinned.
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
    neckline: str = "round"
    neck_width: float = 0.01
    strap: float = 0.05
    sleeve_flare: float = 0.0
    leg_flare: float = 0.0
    waist: float = 0.0
    opening: float = 0.03
    hood: float = 0.02

    def as_dict(self) -> dict[str, float | int | str]:
        """Plain values for a manifest."""
        return asdict(self)


def sampled_pattern(category: str, rng: np.random.Generator, faces: int, long_sleeves: bool = False) -> Pattern:
    """A pattern with its measures drawn at random.

    Args:
        category: One of :data:`CATEGORIES`.
        rng: Where randomness comes from.
        faces: Faces of a T-shirt; other categories scale with their area.
        long_sleeves: Whether sleeves may reach the wrists, and those of jackets do. The body's forearms must then be
            part of the collider, or the sleeves bunch at the elbows (:func:`needs_forearms`). By default they end
            above the elbows.
    """
    if category not in CATEGORIES:
        raise ValueError(f"unknown garment category {category!r}; there are {', '.join(CATEGORIES)}")
    like = "jacket" if category in JACKETS else category
    eases = {"trousers": (0.016, 0.034), "jumpsuit": (0.018, 0.034), "jacket": (0.030, 0.045)}
    short = category == "top" or (category in ("dress", "jumpsuit") and rng.random() < 0.4)
    if like == "jacket":
        sleeves = (1.4, 1.85) if long_sleeves else (0.65, 0.88)
    else:
        sleeves = (0.0, 0.15) if short else (0.3, 1.85 if long_sleeves else 0.88)
    hems = {"top": (-0.12, 0.12), "jacket": (-0.05, 0.20)}
    offered = _NECKLINES.get(like, ("round",))
    pattern = Pattern(
        category=category,
        sleeve=float(rng.uniform(*sleeves)),
        hem=float(rng.uniform(*hems.get(like, (0.0, 0.16)))),
        leg=float(rng.uniform(0.3, 0.95)),
        skirt_length=float(rng.uniform(0.3, 0.95)),
        flare=float(rng.uniform(0.02, 0.35)),
        ease=float(rng.uniform(*eases.get(like, (0.012, 0.024)))),
        neck=float(rng.uniform(0.0, 0.06)),
        neckline=offered[int(rng.integers(len(offered)))],
        neck_width=float(rng.uniform(0.0, 0.03)),
        strap=float(rng.uniform(0.04, 0.07)),
        sleeve_flare=float(rng.uniform(0.0, 0.02)),
        leg_flare=float(rng.uniform(0.0, 0.05)),
        waist=float(rng.uniform(-0.02, 0.03)),
        opening=float(rng.uniform(0.02, 0.06)),
        hood=float(rng.uniform(0.015, 0.035)),
    )
    length = {"trousers": 0.4 + 0.7 * pattern.leg, "skirt": 0.5 + 1.4 * pattern.skirt_length}
    length |= {"jumpsuit": 0.6 + 0.4 * pattern.leg, "dress": 0.6 + 0.8 * pattern.skirt_length}
    size = _SIZE[like] * length.get(category, 1.0) * (1.2 if category == "hooded_jacket" else 1.0)
    return replace(pattern, faces=round(faces * size * rng.uniform(0.85, 1.15)))


def needs_forearms(pattern: Pattern) -> bool:
    """Whether a garment has sleeves over the forearms, so that cloth must collide with them."""
    return pattern.category in WITH_BODICE and pattern.sleeve > 1.0 and pattern.neckline not in PINNED_NECKLINES


def make_garment(body: RestBody, pattern: Pattern, gap: float = 0.011) -> tuple[Garment, float]:
    """Cuts a garment for a body.

    Args:
        body: The body in its rest pose.
        pattern: Measures of the garment.
        gap: Least distance from the body at the start [m].

    Returns:
        The garment, pinned where it would fall off otherwise, and the edge length aimed at [m].

    Raises:
        ValueError: Unknown category or neckline, or a pattern that cannot be cut cleanly for this body; it says why.
    """
    for what, known in (("category", CATEGORIES), ("neckline", NECKLINES)):
        if getattr(pattern, what) not in known:
            raise ValueError(f"unknown garment {what} {getattr(pattern, what)!r}; there are {', '.join(known)}")
    if pattern.category in JACKETS and pattern.neckline in PINNED_NECKLINES:
        raise ValueError(f"a {pattern.category} has no {pattern.neckline!r} neckline")
    vertices, faces = _surface(body, pattern)
    vertices, faces, edge = remeshed(vertices, faces, pattern.faces)
    vertices = pushed_out(vertices, faces, body.vertices, body.faces, gap)
    name = pattern.category
    garment = Garment(vertices.astype(np.float32), faces.astype(np.int32), pins=_pins(vertices, pattern), name=name)
    if found := faults(garment, body, pattern, gap):
        raise ValueError(f"{name} does not suit this body: {'; '.join(found)}. Draw another pattern.")
    return garment, edge


def _surface(body: RestBody, pattern: Pattern) -> tuple[np.ndarray, np.ndarray]:
    """The garment as a fine triangle mesh of no particular quality."""
    arms = body.weight_of("LeftArm", "RightArm")
    around = shell(body, ease_field(body, pattern), covered(body, pattern))
    keep = without_specks(around.faces, keep_field(body, pattern, around), least=12)
    vertices, faces = cut_below_zero(around.vertices, around.faces, keep)
    vertices = smoothed_boundary(vertices, faces, rounds=6)
    length = max(pattern.hem, 0.0)
    if pattern.category in ("skirt", "dress"):
        length = pattern.skirt_length - (waist(body, pattern) - bottom(body, pattern))
        length = min(length, vertices[:, 1].min() - _FLOOR)
    if pattern.category in WITH_TUBE and length > 0.01:
        flare = pattern.flare if pattern.category in ("skirt", "dress") else pattern.flare * length
        points = body.vertices[arms < 0.1]
        vertices, faces = with_tube(vertices, faces, points, length=length, flare=flare, ease=pattern.ease)
    if pattern.category in JACKETS:
        vertices, faces = _opened(vertices, faces, body, pattern)
    return vertices, faces


def _opened(vertices: np.ndarray, faces: np.ndarray, body: RestBody, pattern: Pattern) -> tuple[np.ndarray, np.ndarray]:
    """Takes a strip out of the front, from hem to neck. The strip may be narrower than the faces."""
    half = 0.5 * pattern.opening
    for edge in (-half, half):
        vertices, faces, _ = split_at_zero(vertices, faces, vertices[:, 0] - edge)
    centres = vertices[faces].mean(1)
    in_front = (centres[:, 2] > body.joint("Neck")[2] + 0.01) & (centres[:, 1] < body.joint("Head")[1])
    return largest_piece(vertices, faces[~(in_front & (np.abs(centres[:, 0]) < half))])


def _pins(vertices: np.ndarray, pattern: Pattern) -> np.ndarray | None:
    """The upper end of what nothing else holds up: waistband, straps, strapless edge, the crown of a hood."""
    strapped = pattern.category in WITH_BODICE and pattern.neckline in PINNED_NECKLINES
    if not strapped and pattern.category not in ("trousers", "skirt", "hooded_jacket"):
        return None
    return np.flatnonzero(vertices[:, 1] > vertices[:, 1].max() - _BAND).astype(np.int32)
