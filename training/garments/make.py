"""Parametric garments, cut from a surface around the body in its rest pose.

A garment is the part of that surface (`shell`) where a signed field is positive (`regions`): below the neckline, above
the hem, up to a point along the sleeve. Skirts and hems continue from the lower boundary as tubes (`tubes`), jackets
are opened in front, and the whole is remeshed isotropically and kept clear of the body.
"""

from __future__ import annotations

import numpy as np

from warpgarment.bodies.rest import RestBody
from warpgarment.geometry.cutting import (
    cut_below_zero,
    largest_piece,
    pushed_out,
    remeshed,
    smoothed_boundary,
    split_at_zero,
    without_specks,
)
from warpgarment.objects.garment import Garment

from .faults import faults
from .pattern import CATEGORIES, JACKETS, NECKLINES, PINNED_NECKLINES, WITH_BODICE, WITH_TUBE, Pattern, waist
from .regions import bottom, covered, ease_field, keep_field
from .shell import shell
from .tubes import with_tube

_BAND = 0.03  # height of the band that is pinned [m]
_FLOOR = 0.06  # least height of a skirt's end above the floor [m]


def make_garment(body: RestBody, pattern: Pattern, gap: float = 0.011) -> tuple[Garment, float]:
    """Cuts a garment for a body.

    Args:
        body: The body in its rest pose.
        pattern: Measures of the garment.
        gap: Least distance from the body at the start [m].

    Returns:
        The garment, pinned where it would fall off otherwise, and the intended edge length [m].

    Raises:
        ValueError: The category or neckline is unknown, or the pattern cannot be cut cleanly for this body; the message
            names the reason.
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
    if errors := faults(garment, body, pattern, gap):
        raise ValueError(f"{name} does not suit this body: {'; '.join(errors)}. Draw another pattern.")
    return garment, edge


def _surface(body: RestBody, pattern: Pattern) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m] and faces of the garment as a fine triangle mesh, before remeshing."""
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
    """Removes a strip of the front from hem to neck; the strip may be narrower than the faces."""
    half = 0.5 * pattern.opening
    for edge in (-half, half):
        vertices, faces, _ = split_at_zero(vertices, faces, vertices[:, 0] - edge)
    centres = vertices[faces].mean(1)
    in_front = (centres[:, 2] > body.joint("Neck")[2] + 0.01) & (centres[:, 1] < body.joint("Head")[1])
    return largest_piece(vertices, faces[~(in_front & (np.abs(centres[:, 0]) < half))])


def _pins(vertices: np.ndarray, pattern: Pattern) -> np.ndarray | None:
    """Vertices at the upper end of a garment that would fall off: waistband, straps, strapless edge, hood's crown."""
    strapped = pattern.category in WITH_BODICE and pattern.neckline in PINNED_NECKLINES
    if not strapped and pattern.category not in ("trousers", "skirt", "hooded_jacket"):
        return None
    return np.flatnonzero(vertices[:, 1] > vertices[:, 1].max() - _BAND).astype(np.int32)
