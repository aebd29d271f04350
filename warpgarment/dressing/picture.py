"""A picture of a dressed body."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpgarment.objects.body import BodyMotion
from warpgarment.view import draw

from .dress import Dressed

SIDES = ((20.0, "front"), (110.0, "side"), (200.0, "back"))
SIZE = (360, 520)
COLORS = (draw.CORAL, draw.OCHRE, draw.PLUM, draw.SLATE)


def draw_dressed(path: str | Path, dressed: Dressed | Sequence[Dressed], body: BodyMotion) -> np.ndarray:
    """Writes a PNG of garments on the body's first frame from three sides; pins are drawn in another colour.

    Args:
        path: File to write.
        dressed: The garment, or several.
        body: The body.

    Returns:
        sRGB picture, uint8 [H,W,3].
    """
    at, pieces = body.vertices[0], [dressed] if isinstance(dressed, Dressed) else list(dressed)
    surfaces = [draw.Surface(at, body.faces)]
    for number, piece in enumerate(pieces):
        garment, color = piece.garment, COLORS[number % len(COLORS)]
        tied = np.isin(garment.faces, garment.pins).any(axis=1)
        surfaces.append(draw.Surface(piece.vertices, garment.faces[~tied], color, True))
        if tied.any():
            surfaces.append(draw.Surface(piece.vertices, garment.faces[tied], draw.TEAL, True))
    seen = np.concatenate([at, *(piece.vertices for piece in pieces)])
    pictures = [
        draw.caption(draw.render(surfaces, draw.Camera.framing(seen, size=SIZE, azimuth=azimuth), size=SIZE), name)
        for azimuth, name in SIDES
    ]
    picture = np.concatenate(pictures, axis=1)
    draw.write_png(path, picture)
    return picture
