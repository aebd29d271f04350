"""`warpgarment view`: a motion in a window or a browser, or drawn to a file where there is no display."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from warpgarment.errors import MissingExtra, UsageError
from warpgarment.io.files import whole_output
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.clock import in_words
from warpgarment.objects.motion import GarmentMotion
from warpgarment.progress import counted
from warpgarment.view import draw
from warpgarment.view.matched import Motion, matched

from . import spoken
from .outputs import check_output

SMALLEST, MOST_PIXELS = 16, 16_000_000  # sides and area of a picture: drawing takes about 100 bytes a pixel


@dataclass
class View:
    """Options of `view`."""

    motion: tyro.conf.Positional[tuple[Path, ...]]
    """Garment motions: .npz, .usd, .abc, .glb, .pc2 or .mdd with its .obj beside it, or folders of .obj."""
    mesh: str | None = None
    """Name of the mesh to read where the motions' files hold several."""
    fps: float | None = None
    """Rate of the motions, where their files do not say (.pc2, folders of .obj) or say something else."""
    body: Path | None = None
    """Body motion to draw with them."""
    body_mesh: str | None = None
    """Name of the mesh where the body's file holds several."""
    body_fps: float | None = None
    """Rate of the body's motion, likewise."""
    body_shape: str | None = None
    """The body that a .bvh or AMASS motion moves, as --shape of convert."""
    start: float | None = None
    """Time of the motions' first frame in seconds, where their files do not say or say something else."""
    body_start: float | None = None
    """Time of the body's first frame in seconds, likewise. Motions of any rates are shown at the same moments: those
    frames of the first motion that lie in the time of all."""
    browser: bool = False
    """Show the motions on a page that a web browser opens, instead of a window. Files with several meshes are shown
    whole, and the one called body is the body."""
    beside: tuple[Path, ...] = ()
    """Motions of a second result, which the page shows beside the first one, and the distance to it in colours."""
    rest: tuple[Path, ...] = ()
    """The garments at rest, for colours of stretch on the page; by default their first frames."""
    host: str = "127.0.0.1"
    """Address of the page; 0.0.0.0 lets everybody on the network look."""
    port: int | None = None
    """Port of the page; by default 8080 or the next one that is free."""
    out: Path | None = None
    """Draw to this file instead of a window: .mp4 the film, .png a sheet of moments."""
    frames: int = 8
    """Moments on a sheet."""
    size: tuple[int, int] = (480, 640)
    """Width and height of a film, of a panel of a sheet half that, in pixels."""
    azimuth: float = 28.0
    """Where the camera stands: degrees from the body's front (+Z) towards +X."""


def run(options: View) -> None:
    """Draws to a file, opens a window, or serves a page."""
    if not options.motion:
        raise UsageError("view was given no motion. Name at least one file.")
    if options.browser and options.out is not None:
        raise UsageError("--browser and --out: give one of them.")
    if options.browser:
        from .browser import show

        return show(options)
    if options.beside or options.rest:
        raise UsageError("--beside and --rest belong to the page in the browser: give them with --browser.")
    if options.out is not None:
        check_output(options.out, (".png", ".mp4"))
    _check_picture(options)
    with spoken(mesh="--mesh", fps="--fps"):
        loaded = [
            BodyMotion.load(path, mesh=whole_output(path, options.mesh), fps=options.fps, collider=False)
            for path in options.motion
        ]
    garments = [_garment(m, p.stem, options.start) for m, p in zip(loaded, options.motion, strict=True)]
    body = None
    if options.body is not None:
        told: dict[str, Any] = {
            "mesh": options.body_mesh,
            "fps": options.body_fps,
            "shape": options.body_shape,
        }
        with spoken(mesh="--body-mesh", fps="--body-fps", shape="--body-shape"):
            body = BodyMotion.load(options.body, collider=False, **told)
        if options.body_start is not None:
            body.start = options.body_start
    body, garments = _together(body, garments, options)
    if options.out is None:
        _window(body, garments)
        return
    scene: list[draw.Motion] = [*([body] if body is not None else []), *garments]
    if options.out.suffix.lower() == ".mp4":
        camera = draw.chase(scene, size=options.size, azimuth=options.azimuth)
        pictures = draw.film(body, garments, size=options.size, camera=camera)
        drawn = counted(pictures, "drawing", unit="frame", total=garments[0].frames)
        draw.write_mp4(options.out, drawn, garments[0].fps)
    else:
        panel = (options.size[0] // 2, options.size[1] // 2)
        camera = draw.chase(scene, size=panel, azimuth=options.azimuth)
        rows = [(", ".join(m.name for m in garments), garments, draw.PALETTE)]
        draw.sheet(options.out, body, rows, frames=options.frames, size=panel, camera=camera)
    print(f"wrote {options.out}")


def _garment(motion: BodyMotion, name: str, start: float | None) -> GarmentMotion:
    """What was read, as a garment, which may hold NaN."""
    begins = motion.start if start is None else start
    return GarmentMotion(motion.vertices, motion.faces, motion.fps, name=name, start=begins, last=motion.last)


def _together(
    body: BodyMotion | None, garments: list[GarmentMotion], options: View
) -> tuple[BodyMotion | None, list[GarmentMotion]]:
    """The motions at the first garment's frames that all have; says so where that leaves some out."""
    paths = [*options.motion, *([options.body] if options.body is not None else [])]
    motions: list[Motion] = [*garments, *([body] if body is not None else [])]
    try:
        shown: list[Any] = list(matched(motions, [str(path) for path in paths]))
    except UsageError as error:
        raise UsageError(f"{error} Are --fps, --start, --body-fps and --body-start right?") from None
    if shown[0].frames < garments[0].frames:
        print(f"shown is what all have: {in_words(shown[0].clock)}, of {in_words(garments[0].clock)}")
    return (shown.pop() if body is not None else None), shown


def _check_picture(options: View) -> None:
    """Refuses pictures of no size, or so large that drawing them fills the memory."""
    width, height = options.size
    if min(options.size) < SMALLEST or width * height > MOST_PIXELS:
        raise UsageError(
            f"--size {width} {height}: both must be at least {SMALLEST}, and there may be {MOST_PIXELS:,} pixels."
        )
    if options.frames < 1 or options.frames * width * height > 16 * MOST_PIXELS:
        most = 16 * MOST_PIXELS // (width * height)
        raise UsageError(f"--frames {options.frames}: at least 1, and with this --size at most {most:,}.")
    if not math.isfinite(options.azimuth):
        raise UsageError(f"--azimuth {options.azimuth}: an angle in degrees is needed.")


def _window(body: BodyMotion | None, garments: list[GarmentMotion]) -> None:
    """Plays in a loop until the window is closed."""
    try:
        import pyvista
    except ModuleNotFoundError as error:
        raise MissingExtra("window", "A window (without --out)") from error
    plotter = pyvista.Plotter(title="warpgarment")
    colored: list[tuple[draw.Motion, str]] = [
        *([(body, draw.SKIN)] if body is not None else []),
        *zip(garments, draw.PALETTE * 16, strict=False),
    ]
    shown: list[tuple[pyvista.PolyData, draw.Motion]] = []
    for motion, color in colored:
        mesh = pyvista.PolyData.from_regular_faces(motion.vertices[0].copy(), motion.faces)
        plotter.add_mesh(mesh, color=color, smooth_shading=True)
        shown.append((mesh, motion))
    clock = [0]

    def advance(_: int) -> None:
        clock[0] += 1
        for mesh, motion in shown:
            position = motion.vertices[clock[0] % motion.frames]
            mesh.points[:] = position  # type: ignore[index]  # PyVista's annotation leaves slices out
            mesh.compute_normals(inplace=True, split_vertices=False)
        plotter.render()

    period = round(1000 / garments[0].fps)
    # PyVista's decorator hides from type checkers that this is a method
    plotter.add_timer_event(max_steps=10**9, duration=period, callback=advance)  # type: ignore[call-arg]
    plotter.show()
