"""Pictures and films of bodies and garments, drawn by Warp kernels, which need neither display nor graphics driver.

    image = draw.render([draw.Surface(body, body_faces), draw.Surface(dress, faces, draw.CORAL, lining=True)])
    draw.write_png("dress.png", image)

`render` needs nothing beyond the core dependencies; writing files needs the extra `view` (imageio and its ffmpeg).
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.objects.motion import GarmentMotion
from warpgarment.progress import parts

from .images import caption, titled, write_mp4, write_png
from .matched import Motion, in_step, matched

if TYPE_CHECKING:
    import warp as wp

    from warpgarment.objects.body import BodyMotion

__all__ = [
    "Camera",
    "Surface",
    "caption",
    "chase",
    "contact_sheet",
    "film",
    "linear",
    "render",
    "sheet",
    "titled",
    "write_mp4",
    "write_png",
]

SKIN, CORAL, TEAL, OCHRE, PLUM, SLATE = "#cfc4bb", "#e0614f", "#2a9aa6", "#e3a23a", "#8f5a9e", "#8493a6"
PALETTE = (CORAL, TEAL, OCHRE, PLUM)  # garments, in the order given

Color = str | tuple[float, float, float]


@dataclass(frozen=True)
class Surface:
    """One mesh to draw: `vertices` [m], [V, 3], and `faces`, [F, 3]; with `lining`, the backs of faces are darker."""

    vertices: np.ndarray
    faces: np.ndarray
    color: Color = SKIN
    lining: bool = False


@dataclass(frozen=True)
class Camera:
    """Looks at `target` from `distance` [m]. Angles in degrees; azimuth 0 sees the front of a body that faces +Z."""

    target: tuple[float, float, float]
    distance: float
    azimuth: float = 28.0
    elevation: float = 9.0
    field_of_view: float = 24.0  # vertical

    @property
    def direction(self) -> np.ndarray:
        """Unit vector from the target to the eye."""
        a, e = np.radians(self.azimuth), np.radians(self.elevation)
        return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])

    @classmethod
    def framing(
        cls, vertices: np.ndarray, *, size: tuple[int, int] = (640, 640), azimuth: float = 28.0, elevation: float = 9.0
    ) -> Camera:
        """A camera that sees all vertices.

        Args:
            vertices: Positions [m], [..., 3].
            size: Width and height of the picture in pixels.
            azimuth: Direction of the camera around the vertical axis [degrees].
            elevation: Height of the camera's direction above the horizon [degrees].
        """
        points = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
        low, high = points.min(0), points.max(0)
        camera = cls(tuple((low + high) / 2), 1.0, azimuth, elevation)
        view = camera.axes()
        offsets = points - np.asarray(camera.target)
        slope_y = np.tan(np.radians(camera.field_of_view) / 2)
        slope_x = slope_y * size[0] / size[1]
        nearer = offsets @ camera.direction
        needed = np.maximum(np.abs(offsets @ view[0]) / slope_x, np.abs(offsets @ view[1]) / slope_y) + nearer
        return replace(camera, distance=float(1.05 * max(needed.max(), 1e-3)))

    def axes(self) -> np.ndarray:
        """Unit vectors of the camera as rows: right, up, forward, shape [3, 3]."""
        forward = -self.direction
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])


def linear(color: Color) -> np.ndarray:
    """Linear-light RGB [3] of "#rrggbb" or of sRGB values between 0 and 1."""
    if isinstance(color, str):
        digits = color.removeprefix("#")
        color = tuple(int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4))  # type: ignore[assignment]
    srgb = np.asarray(color, dtype=np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def render(
    surfaces: Sequence[Surface],
    camera: Camera | None = None,
    *,
    size: tuple[int, int] = (640, 640),
    samples: int = 2,
    floor: float | None = None,
    device: str = "cpu",
) -> np.ndarray:
    """Draws surfaces in one picture.

    Args:
        surfaces: Surfaces to draw. Faces with a vertex that is not finite are left out.
        camera: Camera of the picture; None frames all surfaces.
        size: Width and height in pixels.
        samples: Number of samples per pixel in each direction.
        floor: Height of the floor [m]; None for no floor.
        device: Warp device on which the picture is drawn.

    Returns:
        sRGB picture, uint8 [height, width, 3].
    """
    from warpgarment.kernels.render import raster, shading

    if not surfaces:
        raise ValueError("render was given no surface; pass at least one")
    vertices = np.concatenate([np.asarray(s.vertices, dtype=np.float32).reshape(-1, 3) for s in surfaces])
    colors = np.concatenate([np.broadcast_to(linear(s.color), (len(s.vertices), 3)) for s in surfaces])
    offsets = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
    faces = np.concatenate(
        [
            np.column_stack([np.asarray(s.faces) + o, np.full(len(s.faces), s.lining)]).astype(np.int32)
            for s, o in zip(surfaces, offsets, strict=True)
        ]
    )
    finite = np.isfinite(vertices).all(1)
    faces = faces[finite[faces[:, :3]].all(1)]
    seen = vertices[np.unique(faces[:, :3])] if len(faces) else np.zeros((1, 3), np.float32)
    camera = camera or Camera.framing(seen, size=size)

    view = raster.View()
    view.right, view.up, view.forward = (_vec3(axis) for axis in camera.axes())
    view.eye = _vec3(np.asarray(camera.target) + camera.distance * camera.direction)
    view.width, view.height = size[0] * samples, size[1] * samples
    view.scale = 0.5 * view.height / float(np.tan(np.radians(camera.field_of_view) / 2))
    view.perspective = True
    stage, light = _lighting(camera, seen, floor)
    vertices = np.where(finite[:, None], vertices, 0.0).astype(np.float32)
    return shading.render(
        vertices, faces, np.ascontiguousarray(colors), view, light, stage, samples=samples, device=device
    )


def _lighting(camera: Camera, seen: np.ndarray, floor: float | None) -> tuple[Any, Any]:
    """A warm key light over the viewer's left shoulder, a cool fill from the right, and the key's shadow view."""
    from warpgarment.kernels.render import raster, shading

    right, _, forward = camera.axes()
    back = -np.array([forward[0], 0.0, forward[2]])
    back /= np.linalg.norm(back) + 1e-9
    key = -0.85 * right + 0.9 * np.array([0, 1.0, 0]) + 0.55 * back
    fill = 0.9 * right + 0.25 * np.array([0, 1.0, 0]) + 0.35 * back
    key, fill = key / np.linalg.norm(key), fill / np.linalg.norm(fill)

    stage = shading.Stage()
    stage.key, stage.fill = _vec3(key), _vec3(fill)
    stage.key_color, stage.fill_color = _vec3((0.86, 0.79, 0.70)), _vec3((0.09, 0.11, 0.15))
    stage.sky, stage.ground = _vec3((0.32, 0.35, 0.40)), _vec3((0.15, 0.13, 0.12))
    stage.top, stage.bottom = _vec3(linear("#eef1f5")), _vec3(linear("#dfe3e9"))
    stage.floor_color = _vec3(linear("#d3d8df"))
    stage.has_floor = floor is not None
    stage.floor_height = 0.0 if floor is None else float(floor)
    stage.focus = _vec3((seen.min(0) + seen.max(0)) / 2)
    extent = float(np.linalg.norm(seen.max(0) - seen.min(0)))
    stage.floor_fade = 1.7 * extent
    stage.occlusion_radius = 0.035 * extent

    light = raster.View()
    forward = -key
    side = np.cross(forward, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    light.right, light.up = _vec3(side), _vec3(np.cross(side, forward))
    light.forward = _vec3(forward)
    light.eye = _vec3(np.asarray(stage.focus) + extent * key)
    light.width = light.height = 896
    light.scale = light.width / (1.15 * extent + 1e-6)
    light.perspective = False
    return stage, light


def _vec3(values: Iterable[float]) -> wp.vec3:
    """Three numbers as a Warp vector."""
    import warp as wp

    return wp.vec3(*values)


def chase(motions: Sequence[Motion], *, size: tuple[int, int], azimuth: float = 28.0) -> Camera:
    """A camera that keeps all motions in the picture while it follows the first; `target` is relative to the first.

    Motions of other rates or starts are matched by time, as in `film`.

    Args:
        motions: Motions to show; the first one is followed.
        size: Width and height of the picture in pixels.
        azimuth: Direction of the camera around the vertical axis [degrees].
    """
    motions = _in_step(motions)
    frames = range(0, motions[0].frames, max(1, motions[0].frames // 12))
    middle = _middle(motions[0])
    around = np.concatenate([m.vertices[min(t, m.frames - 1)] - middle[t] for m in motions for t in frames])
    return Camera.framing(around[np.isfinite(around).all(1)], size=size, azimuth=azimuth)


def film(
    body: BodyMotion | None,
    garments: Sequence[GarmentMotion],
    *,
    size: tuple[int, int] = (360, 480),
    colors: Sequence[Color] = PALETTE,
    frames: Iterable[int] | None = None,
    samples: int = 2,
    camera: Camera | None = None,
    device: str = "cpu",
) -> Iterator[np.ndarray]:
    """Pictures of a motion, one after another; the camera follows the body, or the first garment if there is no body.

    Motions of other rates or starts are matched by time: the frames are those of the first garment that all have.

    Args:
        body: Body to draw; None for none.
        garments: Garments to draw.
        size: Width and height in pixels.
        colors: Colours of the garments, in their order.
        frames: Indices of the frames to draw; None for all.
        samples: Number of samples per pixel in each direction.
        camera: Camera whose target is relative to the motion it follows; None frames everything.
        device: Warp device on which the pictures are drawn.

    Yields:
        sRGB picture of each frame, uint8 [height, width, 3].
    """
    motions = _in_step([*([body] if body is not None else []), *garments])
    body, garments = _parted(body, motions)
    camera = camera or chase(motions, size=size)
    middle = _middle(motions[0])
    floor = float(np.percentile(motions[0].vertices[..., 1].min(1), 5)) if body is not None else None

    def picture(t: int) -> np.ndarray:
        surfaces = [] if body is None else [Surface(body.vertices[t], body.faces)]
        for garment, color in zip(garments, itertools.cycle(colors), strict=False):
            worn = garment.vertices[min(t, garment.frames - 1)]
            surfaces.append(Surface(worn, garment.faces, color, lining=True))
        x, y, z = map(float, middle[t] + np.asarray(camera.target))
        there = replace(camera, target=(x, y, z))
        return render(surfaces, there, size=size, floor=floor, samples=samples, device=device)

    wanted = list(range(motions[0].frames) if frames is None else frames)
    yield from map(picture, wanted[:1])  # before the others, since it may have to compile the kernels
    with ThreadPoolExecutor(
        os.cpu_count() if device == "cpu" else 1
    ) as pool:  # launches release the global interpreter lock
        for start in range(1, len(wanted), 16):
            yield from pool.map(picture, wanted[start : start + 16])


Row = tuple[str, "Sequence[GarmentMotion]", "Sequence[Color]"]
"""One row of a sheet: its title, its garments, and their colours."""


def sheet(
    path: str | Path,
    body: BodyMotion | None,
    rows: Sequence[Row],
    *,
    frames: int = 8,
    size: tuple[int, int] = (240, 340),
    camera: Camera | None = None,
    device: str = "cpu",
) -> np.ndarray:
    """Writes a PNG with one row of evenly spaced frames for each of `rows`, all drawn with the same camera.

    Motions of other rates or starts are matched by time, as in `film`; each picture says its time.

    Args:
        path: File to write.
        body: Body to draw in every row; None for none.
        rows: Rows from top to bottom.
        frames: Number of frames in a row.
        size: Width and height of each frame in pixels.
        camera: Camera of all frames, as in `film`; None frames everything.
        device: Warp device on which the pictures are drawn.

    Returns:
        sRGB picture, uint8 [H, W, 3].
    """
    motions = _in_step([*([body] if body is not None else []), *(g for _, garments, _ in rows for g in garments)])
    body, worn = _parted(body, motions)
    left = iter(worn)
    rows = [(text, [next(left) for _ in garments], colors) for text, garments, colors in rows]
    timed = motions[0]
    moments = np.unique(np.linspace(0, timed.frames - 1, frames).round().astype(int))
    camera = camera or chase(motions if body is not None else [timed, *motions], size=size)
    strips = []
    for text, garments, colors in rows:
        drawn = film(body, garments, size=size, colors=colors, frames=moments, camera=camera, device=device)
        panels = parts(drawn, "drawing", unit="picture", total=len(moments))
        strip = [caption(p, f"{timed.start + t / timed.fps:.1f} s") for p, t in zip(panels, moments, strict=True)]
        strips.append(titled(np.concatenate(strip, axis=1), text))
    picture = np.concatenate(strips, axis=0)
    write_png(path, picture)
    return picture


def contact_sheet(
    path: str | Path,
    body: BodyMotion,
    garments: Sequence[GarmentMotion],
    truth: Sequence[GarmentMotion | None] | None = None,
    *,
    frames: int = 8,
    size: tuple[int, int] = (240, 340),
    device: str = "cpu",
) -> np.ndarray:
    """Writes a sheet with one row per garment and, below it, one row of its ground truth if that is given.

    Args:
        path: File to write.
        body: Body to draw in every row.
        garments: Garments, one row each.
        truth: Ground truth of each garment, or None for a garment that has none.
        frames: Number of frames in a row.
        size: Width and height of each frame in pixels.
        device: Warp device on which the pictures are drawn.

    Returns:
        sRGB picture, uint8 [H, W, 3].
    """
    rows: list[Row] = []
    references = list(truth) if truth is not None else [None] * len(garments)
    for garment, reference, color in zip(garments, references, itertools.cycle(PALETTE), strict=False):
        name = f"{garment.name}, " if garment.name else ""
        rows.append((f"{name}network", [garment], [color]))
        if reference is not None:
            rows.append((f"{name}physics (ground truth)", [reference], [SLATE]))
    camera = chase([body, *(r if r is not None else g for g, r in zip(garments, references, strict=True))], size=size)
    return sheet(path, body, rows, frames=frames, size=size, camera=camera, device=device)


def _in_step(motions: Sequence[Motion]) -> list[Motion]:
    """The motions as they are, if their frames are at the same moments, else at the frames of the first garment."""
    if in_step(motions):
        return list(motions)
    names = [getattr(motion, "name", "the body") or "a garment" for motion in motions]
    return matched(motions, names, by=next((k for k, m in enumerate(motions) if isinstance(m, GarmentMotion)), 0))


def _parted(body: BodyMotion | None, motions: Sequence[Motion]) -> tuple[BodyMotion | None, list[GarmentMotion]]:
    """A list that begins with the body, if there is one, as body and garments."""
    first: Any = motions[0] if body is not None else None
    rest: Any = list(motions[1:] if body is not None else motions)
    return first, rest


def _middle(motion: Motion, width: int = 9) -> np.ndarray:
    """Centre of the bounding box [m], [T, 3], averaged over `width` frames to smooth out steps."""
    vertices = np.nan_to_num(motion.vertices)
    centre = (vertices.min(1) + vertices.max(1)) / 2
    padded = np.pad(centre, ((width // 2, width // 2), (0, 0)), mode="reflect", reflect_type="odd")
    return np.stack([np.convolve(column, np.full(width, 1 / width), mode="valid") for column in padded.T], axis=1)
