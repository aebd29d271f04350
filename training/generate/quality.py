"""The gate every simulated sequence passes: penetration, stretch, speed, layers, and the frame that failed first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from warpgarment.objects.garment import Garment
from warpgarment.training.garments.layers import LayerFigures


@dataclass(frozen=True)
class Limits:
    """Limits of a good frame.

    Attributes:
        penetration: Depth of the deepest vertex inside the collider [m].
        stretch: 99th percentile of the relative change of edge lengths.
        largest_stretch: Largest relative change of an edge's length.
        slip: Largest distance that a vertex moves in a frame, less three times that of the fastest body vertex [m]; the
            distance that the wind blows in a frame is allowed in addition.
        layer_inside: Largest share of an outer garment's vertices that are inside an inner one.
        off: Largest distance of the mean of a garment's vertices from where it would be if it had moved with the body
            as a rigid whole since the first frame [m]. A garment that has come off is farther away; a wide skirt in a
            dance was up to 0.27 m away in 80 sequences.
    """

    penetration: float = 0.010
    stretch: float = 0.30
    largest_stretch: float = 1.0
    slip: float = 0.15
    layer_inside: float = 0.01
    off: float = 0.5


@dataclass
class QualityGate:
    """Measures frames one after another and gives the reason why a frame is not good.

    Args:
        garments: Garments, innermost first; frames hold their vertices end to end.
        collider_faces: Faces of the body with which cloth collides, shape [G, 3].
        limits: Limits of a good frame.
        every: Interval of frames at which penetration and layers are measured.
        air: Largest distance that the air moves in a frame [m], which is allowed in addition to `slip`.
    """

    garments: Sequence[Garment]
    collider_faces: np.ndarray
    limits: Limits = field(default_factory=Limits)
    every: int = 3
    air: float = 0.0

    def __post_init__(self) -> None:
        self._starts = np.cumsum([0, *(len(g.vertices) for g in self.garments)])
        self._edges = np.concatenate([g.edges + s for g, s in zip(self.garments, self._starts, strict=False)])
        self._rest_length = self._lengths(np.concatenate([g.vertices for g in self.garments]).astype(np.float64))
        self._layers = LayerFigures(self.garments) if len(self.garments) > 1 else None
        self._previous: tuple[np.ndarray, np.ndarray] | None = None
        self._frames: list[dict[str, float]] = []
        self._first: tuple[np.ndarray, np.ndarray] | None = None

    def check(self, frame: int, vertices: np.ndarray, body_vertices: np.ndarray) -> str | None:
        """Records a frame; returns the reason why it is not good, or None.

        Args:
            frame: Number of the frame.
            vertices: Vertices of the garments [m], shape [V, 3].
            body_vertices: Vertices of the body [m], shape [U, 3].
        """
        if not np.isfinite(vertices).all():
            return f"frame {frame}: {int((~np.isfinite(vertices)).any(1).sum()):,} vertices are not finite"
        points = vertices.astype(np.float64)
        stretch = np.abs(self._lengths(points) / self._rest_length - 1)
        figures = {"stretch_mean": stretch.mean(), "stretch_max": stretch.max()}
        figures["stretch_p99"] = np.quantile(stretch, 0.99)
        if self._previous is not None:
            moved = np.linalg.norm(points - self._previous[0], axis=1).max()
            body_moved = np.linalg.norm(body_vertices - self._previous[1], axis=1).max()
            figures |= {"step_max": moved, "slip": moved - 3 * body_moved - self.air}
        self._previous = (points, body_vertices)
        if frame % self.every == 0:
            distance = self._signed_distance(points, body_vertices)
            figures |= {"penetration": max(0.0, -float(distance.min())), "inside": float((distance < 0).mean())}
            figures["off"] = self._off(points, body_vertices.astype(np.float64))
            if self._layers:
                figures |= self._layers.measure(np.split(points, self._starts[1:-1]))
        self._frames.append({k: float(v) for k, v in figures.items()})
        limits = self.limits
        for name, limit, unit in (
            ("penetration", limits.penetration, 1e3),
            ("stretch_p99", limits.stretch, 1e2),
            ("stretch_max", limits.largest_stretch, 1e2),
            ("slip", limits.slip, 1e3),
            ("layer_inside", limits.layer_inside, 1e2),
            ("off", limits.off, 1e3),
        ):
            value = figures.get(name, 0.0)
            if value > limit:
                suffix = "%" if name.startswith(("stretch", "layer")) else " mm"
                return f"frame {frame}: {name} {value * unit:.1f}{suffix} is over {limit * unit:.0f}{suffix}"
        return None

    def _off(self, points: np.ndarray, body: np.ndarray) -> float:
        """Largest distance of a garment's mean from where it was on the body in the first measured frame [m]."""
        means = np.stack([part.mean(axis=0) for part in np.split(points, self._starts[1:-1])]) - body.mean(axis=0)
        around = body - body.mean(axis=0)
        if self._first is None:
            self._first = means, around
        before, stood = self._first
        u, _, vt = np.linalg.svd(stood.T @ around)
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt  # of rows, by Kabsch
        return float(np.linalg.norm(means - before @ turn, axis=1).max())

    def _lengths(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points[self._edges[:, 0]] - points[self._edges[:, 1]], axis=1)

    def _signed_distance(self, points: np.ndarray, body_vertices: np.ndarray) -> np.ndarray:
        import igl

        return igl.signed_distance(
            points,
            body_vertices.astype(np.float64),
            self.collider_faces.astype(np.int64),
            sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
        )[0]

    def figures(self, frames: int) -> dict[str, float]:
        """Figures over the first `frames` frames: means of means, maxima of maxima.

        Of outfits, besides the most pairs of triangles that cross in a measured frame (`layer_crossings`), their mean
        over these frames (`layer_crossings_mean`) and the share of these frames in which any do (`layer_crossed`).
        """
        kept = self._frames[:frames]
        names = sorted({name for f in kept for name in f})
        summary = {}
        for name in names:
            values = [f[name] for f in kept if name in f]
            combine = np.mean if name in ("stretch_mean", "inside") else np.max
            summary[name] = float(combine(values))
            if name == "layer_crossings":
                summary |= {"layer_crossings_mean": float(np.mean(values))}
                summary |= {"layer_crossed": float(np.mean(np.greater(values, 0)))}
        return summary
