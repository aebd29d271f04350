"""The figures of one rollout of an outfit, each the mean over its frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import igl
import numpy as np

from warpgarment.objects.body import BodyMotion
from warpgarment.training.data.sequence import Sequence

from .collisions import Surface, behind_planes, beneath, inside
from .crossings import crossing_pairs

TIGHT = 0.035
"""Mean distance of the inner garments from the body in frame 0 up to which they are tight [m]. Tops, trousers and
jumpsuits of the project's patterns are at 0.01 to 0.024, dresses and skirts beyond 0.05."""
WINDY = 1.0  # mean speed of the air from which there is wind [m/s]; less is not felt (Beaufort 0 and 1)


@dataclass(frozen=True)
class Outfit:
    """What the figures need to know of a sequence; K garments, innermost first.

    Attributes:
        parts: Range of vertices of each garment.
        faces: Vertex indices of all garments, int64 [F,3].
        owner: Garment of each face, [F].
        same: Vertices that lie in one place in the garment at rest have the same number, [V].
        surfaces: Surface of each garment, with its own vertex numbers.
        categories: Category of each garment.
        ease: Mean distance of the inner garments from the body in frame 0 [m]; of the only garment if there is one.
        wind: Mean speed of the air [m/s].
    """

    parts: tuple[slice, ...]
    faces: np.ndarray
    owner: np.ndarray
    same: np.ndarray
    surfaces: tuple[Surface, ...]
    categories: tuple[str, ...]
    ease: float
    wind: float

    @classmethod
    def of(cls, sequence: Sequence, body: BodyMotion) -> Outfit:
        """The outfit of a sequence."""
        layers, rest = sequence.layers, sequence.garment.vertices
        parts = tuple(layer.vertices for layer in layers)
        faces = np.asarray(sequence.garment.faces, np.int64)
        owner, same = np.zeros(len(faces), np.int64), np.zeros(len(rest), np.int64)
        for k, layer in enumerate(layers):
            owner[layer.faces] = k
            same[layer.vertices] = np.unique(rest[layer.vertices], axis=0, return_inverse=True)[1].reshape(-1)
            same[layer.vertices] += layer.vertices.start
        own = [Surface.of(faces[owner == k] - part.start, part.stop - part.start) for k, part in enumerate(parts)]
        first = np.asarray(sequence.vertices[0], np.float64)
        inner = first[: parts[-1].start] if len(parts) > 1 else first
        start = np.asarray(body.vertices[0], np.float64)
        squared = igl.point_mesh_squared_distance(inner, start, np.asarray(body.faces, np.int64))[0]
        air = sequence.wind
        speed = 0.0 if air is None else float(np.linalg.norm(np.asarray(air, np.float64), axis=-1).mean())
        categories = tuple(layer.category or "garment" for layer in layers)
        ease = float(np.sqrt(squared).mean())
        return cls(parts, faces, owner, same, tuple(own), categories, ease, speed)

    @property
    def cell(self) -> str:
        """Column of table 4: T or L for tight or loose inner garments, +W with wind."""
        return ("T" if self.ease <= TIGHT else "L") + ("+W" if self.wind >= WINDY else "")


OF_FRAMES = (
    "h_published", "h_surface", "l_published", "l_surface", "crossings_layers", "crossings_itself", "free",
)  # fmt: skip


def rollout_figures(
    outfit: Outfit, vertices: np.ndarray, truth: np.ndarray, body: np.ndarray, body_faces: np.ndarray
) -> dict[str, Any]:
    """The figures of a rollout.

    Args:
        outfit: The outfit.
        vertices: Predicted positions [m], shape [T,V,3].
        truth: Recorded positions [m], shape [T,V,3].
        body: Positions of the body [m], shape [T,U,3].
        body_faces: Vertex indices of the body, looking outwards, shape [G,3].

    Returns:
        `finite`; `finite_frames`, up to the first that is not; `error_mm`, mean distance of vertices of each garment;
        and the means over the frames of: `h_published`, `h_surface`, share of all vertices; `l_published`, share of the
        outermost garment's vertices, `l_surface`, share of the vertices of all garments but the innermost;
        `crossings_layers` and `crossings_itself`, pairs of triangles of different garments and of the same;
        `free`, share of the frames in which no two garments cross. None where there is no inner garment, and
        everything but the first two where a frame is not finite.
    """
    good = np.isfinite(vertices).all(axis=(1, 2))
    frames = len(vertices) if good.all() else int(np.argmin(good))
    result: dict[str, Any] = {"finite": bool(good.all()), "finite_frames": frames, "error_mm": None}
    if not good.all():
        return result | dict.fromkeys(OF_FRAMES)
    distance = 1000.0 * np.linalg.norm(vertices.astype(np.float64) - truth, axis=-1)
    result["error_mm"] = [float(distance[:, part].mean()) for part in outfit.parts]
    found = [frame_figures(outfit, v, b, body_faces) for v, b in zip(vertices, body, strict=True)]
    means = np.mean(found, axis=0)
    return result | {key: None if math.isnan(x) else float(x) for key, x in zip(OF_FRAMES, means, strict=True)}


def frame_figures(outfit: Outfit, vertices: np.ndarray, body: np.ndarray, body_faces: np.ndarray) -> list[float]:
    """The figures of `OF_FRAMES` in one frame, NaN where there is no inner garment; arguments as in a rollout."""
    points, parts = np.asarray(vertices, np.float64), outfit.parts
    h = [f(points, body, body_faces).mean() for f in (behind_planes, inside)]
    pairs = outfit.owner[crossing_pairs(points, outfit.faces, outfit.same)]
    between = int((pairs[:, 0] != pairs[:, 1]).sum())
    itself = float(len(pairs) - between)
    if len(parts) < 2:
        return [*h, math.nan, math.nan, math.nan, itself, math.nan]
    outermost = points[parts[-1]]
    inner = outfit.faces[outfit.owner < len(parts) - 1]
    published = behind_planes(outermost, points[: parts[-1].start], inner).mean()
    under = np.zeros(len(points), bool)
    for k, part in enumerate(parts[1:], start=1):
        for lower in range(k):
            under[part] |= beneath(points[part], points[parts[lower]], outfit.surfaces[lower])
    surface = under[parts[1].start :].mean()
    return [*h, published, surface, float(between), itself, float(between == 0)]
