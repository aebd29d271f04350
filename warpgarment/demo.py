"""The demo: bundled garments on a bundled walking body, simulated by the bundled network, beside their ground truth.

An outfit of two garments in the wind follows, for which there is no ground truth. `assets()` returns these data for
first experiments: a body in motion, two garments and physics to compare with, the outfit and its wind.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgarment.io.disk.outputs import check_writable
from warpgarment.io.npz import read_npz
from warpgarment.io.usd import write_usd
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.motion import GarmentMotion
from warpgarment.objects.outfit import Outfit
from warpgarment.objects.wind import Wind
from warpgarment.progress import counted
from warpgarment.view.report import rollout_table

from . import metrics
from .errors import MeshError
from .view import draw

if TYPE_CHECKING:
    from warpgarment.sim.simulator import Simulator

ASSETS = Path(__file__).parent / "assets" / "demo"
GARMENTS = ("dress", "tshirt")
WINDY = "layers"  # the network that moves the outfit, if it ships
COLORS = (draw.OCHRE, draw.PLUM)  # of the outfit's garments
TITLE = "outfit, network"


@dataclass(frozen=True)
class DemoGarment:
    """A bundled garment.

    Attributes:
        garment: Garment at rest, with its pins.
        truth: Motion of the garment on the demo's body as simulated by the physics teacher, T frames; it is not among
            the training data.
    """

    garment: Garment
    truth: GarmentMotion

    @property
    def first_vertices(self) -> np.ndarray:
        """The garment draped on the first frame of the body [m], shape [V, 3]."""
        return self.truth.vertices[0]


@dataclass(frozen=True)
class DemoOutfit:
    """The bundled outfit: garments, materials and wind of a sequence that is not among the training data.

    Attributes:
        outfit: The garments at rest, innermost first, and their materials.
        first_vertices: Each garment on the first frame of the body [m], shape [V, 3].
        wind: The wind, for the whole of the body's motion.
    """

    outfit: Outfit
    first_vertices: tuple[np.ndarray, ...]
    wind: Wind


@dataclass(frozen=True)
class DemoAssets:
    """Bundled data of the demo.

    Attributes:
        body: The whole walking body, for pictures.
        collider: The body without parts such as hands, with which garments collide.
        garments: Garments by name.
        outfit: An outfit of two garments; None if the folder has none.
    """

    body: BodyMotion
    collider: BodyMotion
    garments: Mapping[str, DemoGarment]
    outfit: DemoOutfit | None = None


def assets(folder: str | Path | None = None) -> DemoAssets:
    """Reads the bundled assets, or those of another folder with body.npz, one .npz per garment, and maybe outfit.npz.

    Args:
        folder: Folder to read; None for the bundled one.

    Raises:
        FileNotFoundError: A file is missing.
        MeshError: A file holds something else.
    """
    folder = Path(folder) if folder is not None else ASSETS
    body = BodyMotion.load(folder / "body.npz", collider=False)
    collides = read_npz(folder / "body.npz", wanted=lambda name: name == "collider_faces").get("collider_faces")
    collider = body if collides is None else body.submesh(collides)
    garments = {}
    for name in GARMENTS:
        path = folder / f"{name}.npz"
        arrays = read_npz(path, ("rest_vertices", "faces", "pins", "truth"))
        garment = Garment(arrays["rest_vertices"], arrays["faces"], pins=arrays["pins"], name=name)
        truth = GarmentMotion(arrays["truth"].astype(np.float32), garment.faces, body.fps, name=name, start=body.start)
        if truth.frames > body.frames:
            raise MeshError(f"{path}: {truth.frames} frames of ground truth, the body has {body.frames}")
        garments[name] = DemoGarment(garment, truth)
    outfit = _outfit(folder / "outfit.npz", body.fps) if (folder / "outfit.npz").exists() else None
    return DemoAssets(body, collider, garments, outfit)


def _outfit(path: Path, fps: float) -> DemoOutfit:
    """An outfit as `training/generate/demo_outfit.py` writes it, with wind at a rate."""
    arrays = read_npz(path, ("names", "wind"))
    garments, materials, first = [], [], []
    for k, name in enumerate(arrays["names"].tolist()):
        rest, faces, pins, start, material = (
            arrays[f"{part}_{k}"] for part in ("rest_vertices", "faces", "pins", "first_vertices", "material")
        )
        garments.append(Garment(rest, faces, pins=pins, name=name))
        materials.append(Material(*material.tolist()))
        first.append(start)
    return DemoOutfit(Outfit(garments, materials), tuple(first), Wind.of_velocities(arrays["wind"], fps=fps))


def run(
    out: str | Path = "out/demo",
    *,
    device: str | None = None,
    weights: str = "default",
    frames: int | None = None,
    moments: int = 8,
    film: bool = True,
    folder: str | Path | None = None,
    progress: bool = False,
) -> dict[str, GarmentMotion]:
    """Rolls the garments out, writes the results to a folder and prints a table of them.

    Args:
        out: Folder for dress.usd, dress.pc2 with dress.obj, the corresponding files of the T-shirt, outfit.usd,
            rollout.png, outfit.png and demo.mp4.
        device: "cpu" or "cuda"; None takes CUDA if it is available.
        weights: Name or path of a checkpoint, as for `Simulator.from_pretrained`.
        frames: Number of frames to simulate; None for all.
        moments: Number of columns of rollout.png.
        film: Whether demo.mp4 is drawn.
        folder: Folder of other assets; None for the bundled ones.
        progress: Whether progress bars are shown.

    Returns:
        Motions of the garments by name, then those of the outfit's, as "outfit" and their name.
    """
    from warpgarment.sim.simulator import Simulator

    began = time.perf_counter()
    out = Path(out)
    check_writable(out, folder=True)
    bundle = assets(folder)
    simulator = Simulator.from_pretrained(weights, device=device)
    simulator.timings.synchronise = True
    print(f"demo on {simulator.device}, network {weights!r}")
    splits = 2 if simulator.device.type == "cpu" else 1  # attention over all faces at once costs a CPU twice as much
    motions, timings, errors = {}, {}, {}
    for name, item in bundle.garments.items():
        first = item.first_vertices
        simulator.rollout(
            item.garment, bundle.collider, first_vertices=first, frames=3, face_splits=splits
        )  # compiles the kernels that are not compiled yet
        simulator.timings.clear()
        count = min(frames or item.truth.frames, item.truth.frames)
        motions[name] = motion = simulator.rollout(
            item.garment,
            bundle.collider,
            first_vertices=first,
            frames=count,
            out_fps="body",
            face_splits=splits,
            progress=progress,
        )
        timings[name] = dict(simulator.timings)
        finite = int(np.isfinite(motion.vertices).all((1, 2)).sum())
        errors[name] = float(metrics.mean_vertex_error(motion.vertices[:finite], item.truth.vertices[:finite]))
    worn: dict[str, GarmentMotion] = {}
    if bundle.outfit is not None:
        worn, spent = _windy(bundle, bundle.outfit, simulator, weights, frames, splits, progress)
    for name, motion in motions.items():
        body = _until(bundle.body, motion.frames)
        meshes = [(name, motion.vertices, motion.faces), ("body", body.vertices, body.faces)]
        write_usd(out / f"{name}.usd", meshes, body.fps, start=body.clock.number)
        motion.save(out / f"{name}.pc2")
    body = _until(bundle.body, min(motion.frames for motion in motions.values()))
    truth = [bundle.garments[name].truth for name in motions]
    brush = str(simulator.device)
    draw.contact_sheet(out / "rollout.png", body, list(motions.values()), truth, frames=moments, device=brush)
    layers = list(worn.values())
    if layers:
        shown = _until(bundle.body, min(motion.frames for motion in layers))
        meshes = [(motion.name, motion.vertices[: shown.frames], motion.faces) for motion in layers]
        write_usd(
            out / "outfit.usd", [*meshes, ("body", shown.vertices, shown.faces)], shown.fps, start=shown.clock.number
        )
        draw.sheet(out / "outfit.png", shown, [(TITLE, layers, COLORS)], frames=moments, device=brush)
    if film:
        # On a CPU only every second frame is drawn: drawing all of them would take longer than the simulation.
        step = 2 if simulator.device.type == "cpu" else 1
        panels = [*zip(motions.values(), truth, strict=True)]
        filmed = range(0, body.frames, step)
        drawn = _film(body, panels, layers, filmed, brush)
        pictures = counted(drawn, "drawing", unit="frame", total=len(filmed), shown=progress)
        draw.write_mp4(out / "demo.mp4", pictures, body.fps / step)
    print(rollout_table(motions, timings, errors))
    if worn:
        print(f"\n{rollout_table(worn, {'both': spent})}")
    motions |= worn
    print(f"\nwrote {', '.join(sorted(p.name for p in out.iterdir()))} to {out} in {time.perf_counter() - began:.0f} s")
    return motions


def _windy(
    bundle: DemoAssets,
    worn: DemoOutfit,
    simulator: Simulator,
    weights: str,
    frames: int | None,
    splits: int,
    progress: bool,
) -> tuple[dict[str, GarmentMotion], dict[str, float]]:
    """Rolls the outfit out, in its materials and wind if there is a network that reads them, and says so.

    Returns:
        Motions by name, and the time of each stage [s].
    """
    from warpgarment.nn.checkpoint import shipped
    from warpgarment.sim.simulator import Simulator

    if weights == "default" and WINDY in shipped():
        weights, simulator = WINDY, Simulator.from_pretrained(WINDY, device=simulator.device)
        simulator.timings.synchronise = True
    reads = simulator.network.reads
    outfit = worn.outfit if "materials" in reads else Outfit(worn.outfit.garments)
    known: dict[str, Any] = {"first_vertices": list(worn.first_vertices), "out_fps": "body", "face_splits": splits}
    if "wind" in reads:
        known["wind"] = worn.wind
    unread = " and ".join(name for name in ("materials", "wind") if name not in reads)
    names = " under ".join(garment.name for garment in outfit)
    print(f"outfit of {names}, network {weights!r}" + (f", which does not read {unread}" if unread else ""))
    count = min(frames or bundle.collider.frames, bundle.collider.frames)
    simulator.rollout(outfit, bundle.collider, **known | {"frames": min(3, count)})  # compiles kernels
    simulator.timings.clear()
    found = simulator.rollout(outfit, bundle.collider, frames=count, progress=progress, **known)
    return {f"outfit {motion.name}": motion for motion in found}, dict(simulator.timings)


def _until(body: BodyMotion, frames: int) -> BodyMotion:
    return BodyMotion(body.vertices[:frames], body.faces, body.fps, start=body.start)


def _film(
    body: BodyMotion,
    pairs: Sequence[tuple[GarmentMotion, GarmentMotion]],
    layers: Sequence[GarmentMotion],
    frames: range,
    device: str,
) -> Iterator[np.ndarray]:
    """Pictures of each garment as simulated by the network and by physics, and of the outfit, side by side.

    Args:
        body: The body.
        pairs: Each garment's motion by the network, and by physics.
        layers: Motions of the outfit's garments by the network; none for no outfit.
        frames: Frames to draw.
        device: Warp device that draws.

    Yields:
        sRGB pictures, uint8 [H, W, 3].
    """
    size = (240, 400)
    camera = draw.chase([body, *(reference for _, reference in pairs), *layers], size=size)
    shown: list[tuple[str, Sequence[GarmentMotion], Sequence[str]]] = []
    for (motion, reference), color in zip(pairs, draw.PALETTE, strict=False):
        shown += [
            (f"{motion.name}, network", [motion], [color]),
            (f"{motion.name}, physics", [reference], [draw.SLATE]),
        ]
    if layers:
        shown.append((TITLE, layers, COLORS))
    panels = [
        draw.film(body, garments, size=size, colors=colors, frames=frames, camera=camera, device=device)
        for _, garments, colors in shown
    ]
    for pictures in zip(*panels, strict=True):
        yield np.concatenate([draw.titled(p, text) for p, (text, _, _) in zip(pictures, shown, strict=True)], axis=1)
