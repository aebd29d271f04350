"""Pins of a garment: vertices that stay tied to the body, found by names, colours, or where the waist is."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from warpgarment.errors import DressingError
from warpgarment.io.surface.record import Surface
from warpgarment.objects.garment import Garment

from .openings import Roles

NAMES = re.compile(r"(?<![a-z])(waist_?-?band|elastic|straps?|belt|pins?|pinned)(?![a-z])", re.IGNORECASE)
"""Names of groups, materials and objects that are pinned without being told."""
COLOUR = re.compile(r"#[0-9a-fA-F]{6}")
NEAR_COLOUR = 0.04
"""Largest difference of a colour's parts, of 1."""


def find_pins(garment: Garment, roles: Roles, wanted: str | None) -> tuple[np.ndarray, str]:
    """Pins of a garment.

    Args:
        garment: The garment, with what its file says of groups and materials.
        roles: What the openings of `garment.simulated.garment` are.
        wanted: "none"; "waist": the loop at the waist; "#rrggbb": vertices of materials of that colour; any other text:
            part of the name of a group, a material or an object. None: those that the garment has, else those whose
            names say so (waistband, elastic, strap, belt, pin).

    Returns:
        Vertices, sorted, int32 [P], and where they are from, in words.

    Raises:
        DressingError: What was asked for is not there.
    """
    empty = np.zeros(0, np.int32)
    if wanted == "none":
        return empty, "none"
    if wanted == "waist":
        if roles.kind not in ("trousers", "tube"):
            raise DressingError(
                f"the garment is taken for a {roles.kind}, whose upper opening is no waist. Pin it by the name of a "
                "group, a material or an object, or give vertices as the garment's pins."
            )
        simulated = garment.simulated
        marked = np.zeros(len(simulated.garment.vertices), np.float32)
        marked[roles.top.vertices] = 1.0
        on = simulated.restored(np.repeat(marked[:, None], 3, axis=1))[:, 0]
        on[simulated.riders] = 0.0
        return np.flatnonzero(on > 0.5).astype(np.int32), "the loop at the waist"
    if wanted is None and len(garment.pins):
        return garment.pins, "the garment"
    found: dict[str, np.ndarray] = {}
    surface = garment.surface
    if surface is not None:
        for name, polygons in _parts(surface, wanted):
            found[name] = np.unique(surface.corners[np.isin(surface.polygon_of_corner, polygons)])
    if found:
        return np.unique(np.concatenate(list(found.values()))).astype(np.int32), ", ".join(found)
    if wanted is not None:
        names = ", ".join(dict.fromkeys(_names(surface))) if surface is not None else ""
        there = f"it has {names}" if names else "its file names none"
        what = "material of the colour" if COLOUR.fullmatch(wanted) else "group, material or object named"
        raise DressingError(f"the garment has no {what} {wanted!r}: {there}.")
    return empty, "none"


def _parts(surface: Surface, wanted: str | None) -> Iterator[tuple[str, np.ndarray]]:
    """Names of parts that are meant, and their polygons."""
    for kind, labels in (("group", surface.groups), ("object", surface.objects)):
        for k in labels.used:
            if _meant(labels.names[k], wanted) and not labels.whole:
                yield f"{kind} {labels.names[k]}", np.flatnonzero(labels.of_polygon == k)
    for k, material in enumerate(surface.materials):
        polygons = np.flatnonzero(surface.material == k)
        if len(polygons) in (0, len(surface.counts)):
            continue
        if wanted is not None and COLOUR.fullmatch(wanted):
            if material.color is not None and _alike(material.color, wanted):
                yield f"material {material.name} of colour {wanted}", polygons
        elif _meant(material.name, wanted):
            yield f"material {material.name}", polygons


def _meant(name: str, wanted: str | None) -> bool:
    return bool(NAMES.search(name)) if wanted is None else wanted.lower() in name.lower()


def _alike(color: tuple[float, float, float], wanted: str) -> bool:
    """Whether a colour is the wanted one, as it is or as sRGB of linear values."""
    asked = np.array([int(wanted[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    given = np.clip(np.asarray(color, float), 0.0, 1.0)
    shown = np.where(given <= 0.0031308, 12.92 * given, 1.055 * given ** (1 / 2.4) - 0.055)
    return any(float(np.abs(c - asked).max()) < NEAR_COLOUR for c in (given, shown))


def _names(surface: Surface) -> Iterator[str]:
    for labels in (surface.groups, surface.objects):
        yield from (labels.names[k] for k in labels.used)
    yield from (material.name for material in surface.materials)
