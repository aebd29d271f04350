"""The demo: bundled garments on a bundled walking body, simulated by the bundled network, beside their ground truth.

`assets()` returns these data for first experiments: a body in motion, two garments, and physics to compare with.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpgarment.io.disk.outputs import check_writable
from warpgarment.io.npz import read_npz
from warpgarment.io.usd import write_usd
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.motion import GarmentMotion
from warpgarment.view.report import rollout_table

from . import metrics
from .errors import MeshError
from .view import draw

ASSETS = Path(__file__).parent / "assets" / "demo"
GARMENTS = ("dress", "tshirt")


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
class DemoAssets:
    """Bundled data of the demo.

    Attributes:
        body: The whole walking body, for pictures.
        collider: The body without parts such as hands, with which garments collide.
        garments: Garments by name.
    """

    body: BodyMotion
    collider: BodyMotion
    garments: Mapping[str, DemoGarment]


def assets(folder: str | Path | None = None) -> DemoAssets:
    """Reads the bundled assets, or those of another folder with body.npz and one .npz per garment.

    Args:
        folder: Folder to read; None for the bundled one.

    Raises:
        FileNotFoundError: A file is missing.
        MeshError: A file holds something else.
    """
    folder = Path(folder) if folder is not None else ASSETS
    body = BodyMotion.load(folder / "body.npz", collider=False)
    garments = {}
    for name in GARMENTS:
        path = folder / f"{name}.npz"
        arrays = read_npz(path, ("rest_vertices", "faces", "pins", "truth"))
        garment = Garment(arrays["rest_vertices"], arrays["faces"], pins=arrays["pins"], name=name)
        truth = GarmentMotion(arrays["truth"].astype(np.float32), garment.faces, body.fps, name=name, start=body.start)
        if truth.frames > body.frames:
            raise MeshError(f"{path}: {truth.frames} frames of ground truth, the body has {body.frames}")
        garments[name] = DemoGarment(garment, truth)
    return DemoAssets(body, BodyMotion.load(folder / "body.npz"), garments)


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
        out: Folder for dress.usd, dress.pc2 with dress.obj, the corresponding files of the T-shirt, rollout.png and
            demo.mp4.
        device: "cpu" or "cuda"; None takes CUDA if it is available.
        weights: Name or path of a checkpoint, as for `Simulator.from_pretrained`.
        frames: Number of frames to simulate; None for all.
        moments: Number of columns of rollout.png.
        film: Whether demo.mp4 is drawn.
        folder: Folder of other assets; None for the bundled ones.
        progress: Whether progress bars are shown.

    Returns:
        Motions of the garments by name.
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
    for name, motion in motions.items():
        body = _until(bundle.body, motion.frames)
        meshes = [(name, motion.vertices, motion.faces), ("body", body.vertices, body.faces)]
        write_usd(out / f"{name}.usd", meshes, body.fps, start=body.clock.number)
        motion.save(out / f"{name}.pc2")
    body = _until(bundle.body, min(motion.frames for motion in motions.values()))
    truth = [bundle.garments[name].truth for name in motions]
    brush = str(simulator.device)
    draw.contact_sheet(out / "rollout.png", body, list(motions.values()), truth, frames=moments, device=brush)
    if film:
        # On a CPU only every second frame is drawn: drawing all of them would take longer than the simulation.
        step = 2 if simulator.device.type == "cpu" else 1
        pictures = _film(body, list(motions.values()), truth, range(0, body.frames, step), brush)
        draw.write_mp4(out / "demo.mp4", pictures, body.fps / step)
    print(rollout_table(motions, timings, errors))
    print(f"\nwrote {', '.join(sorted(p.name for p in out.iterdir()))} to {out} in {time.perf_counter() - began:.0f} s")
    return motions


def _until(body: BodyMotion, frames: int) -> BodyMotion:
    return BodyMotion(body.vertices[:frames], body.faces, body.fps, start=body.start)


def _film(
    body: BodyMotion, motions: Sequence[GarmentMotion], truth: Sequence[GarmentMotion], frames: range, device: str
) -> Iterator[np.ndarray]:
    """Pictures of each garment as simulated by the network and by physics, side by side, uint8 [H, W, 3]."""
    size = (240, 400)
    camera = draw.chase([body, *truth], size=size)
    panels, labels = [], []
    for motion, reference, color in zip(motions, truth, draw.PALETTE, strict=False):
        for shown, tint, label in ((motion, color, "network"), (reference, draw.SLATE, "physics")):
            panels.append(
                draw.film(body, [shown], size=size, colors=[tint], frames=frames, camera=camera, device=device)
            )
            labels.append(f"{motion.name}, {label}")
    for pictures in zip(*panels, strict=True):
        yield np.concatenate([draw.titled(p, label) for p, label in zip(pictures, labels, strict=True)], axis=1)
