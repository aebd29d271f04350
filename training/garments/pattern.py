"""The parameters of a garment, and the parts of each category."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from warpgarment.bodies.rest import RestBody

CATEGORIES = ("tshirt", "top", "trousers", "skirt", "dress", "jumpsuit", "jacket", "hooded_jacket")
WITH_BODICE = ("tshirt", "top", "dress", "jumpsuit", "jacket", "hooded_jacket")
WITH_LEGS = ("trousers", "jumpsuit")
WITH_TUBE = ("tshirt", "top", "skirt", "dress", "jacket", "hooded_jacket")
JACKETS = ("jacket", "hooded_jacket")
PINNED_NECKLINES = ("straps", "strapless")
NECKLINES = ("round", "v", "wide", *PINNED_NECKLINES)
_NECKLINES = {
    "tshirt": ("round", "v", "wide"),
    "top": NECKLINES,
    "dress": NECKLINES,
    "jumpsuit": ("round", "v", "straps"),
    "jacket": ("round", "v"),
}
# number of faces relative to a T-shirt, by area
_SIZE = {"tshirt": 1.0, "top": 0.8, "trousers": 1.0, "skirt": 1.0, "dress": 1.4, "jumpsuit": 1.5, "jacket": 1.3}


@dataclass(frozen=True)
class Pattern:
    """The sampled parameters of a garment.

    Attributes:
        category: Category, one of :data:`CATEGORIES`.
        sleeve: Place where sleeves end: 0 at the shoulder, 1 at the elbow, 2 at the wrist. See :func:`needs_forearms`.
            Garments with straps and strapless ones have no sleeves.
        hem: Distance of a shirt's or jacket's hem below the hips, which lie 2 cm above their joints [m]; negative for a
            hem above the hips.
        leg: Share of the leg that trousers cover.
        skirt_length: Length of a skirt below the waist seam [m]; a skirt that would reach the floor ends above it.
        flare: Growth of a skirt's radius over its length, in addition to the growth that the body requires [m]; for
            shirts and jackets, growth at the hem per metre of length.
        ease: Distance from the body at which the garment is cut [m].
        neck: Distance by which the neckline is lowered in front [m]; for garments with straps and strapless ones, by
            which the upper edge is lowered.
        faces: Approximate number of faces.
        neckline: Neckline, one of :data:`NECKLINES`; jackets have the first three only. Straps, and the upper edge of
            strapless garments, are pins.
        neck_width: Distance by which the neckline is widened on each side [m]; straps move outwards by half of it.
        strap: Width of each strap [m].
        sleeve_flare: Growth of the sleeves' distance from the arm, from shoulder to elbow [m].
        leg_flare: Growth of the trouser legs' distance from the leg, from hip to ankle [m].
        waist: Height of the waistline or waistband above its usual place [m].
        opening: Width of a jacket's opening in front [m].
        hood: Distance between head and hood in addition to the ease [m]. The hood's crown is pinned.
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
        """The attributes by name, for a manifest."""
        return asdict(self)


def sampled_pattern(category: str, rng: np.random.Generator, faces: int, long_sleeves: bool = False) -> Pattern:
    """A pattern with measures drawn at random.

    Args:
        category: Category, one of :data:`CATEGORIES`.
        rng: Random number generator.
        faces: Number of faces of a T-shirt; that of other categories scales with their area.
        long_sleeves: Whether sleeves may reach the wrists, as those of jackets then do. The body's forearms must then
            be part of the collider, otherwise the sleeves bunch at the elbows (:func:`needs_forearms`). If False,
            sleeves end above the elbows.
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


def waist(body: RestBody, pattern: Pattern) -> float:
    """Height of the waistline [m]."""
    return float(body.joint("LowerBack")[1] + 0.06 + pattern.waist)
