"""The Warp teacher beside Newton 10 x 5, frame by frame in turns, and both beside their own most converged runs.

    python -m benchmarks.physics.converged                      # garments of jersey, 30 frames: eight minutes
    python -m benchmarks.physics.converged --material default   # of the default material, which is far stiffer
    python -m benchmarks.physics.converged --iterations 60 --tolerance 1e-5
    python -m benchmarks.physics.converged --frames 20 --newton-converged   # and Newton 20 x 20, which is slow

The T-shirt has 5 frames to settle, the last dress 15; the two others start at rest on a body that walks at once. For
each garment: time of a frame (processor time, least, without the first), mean distance of vertices from the same
solver's most converged run, and the floor below which that distance means nothing: the distance of the converged run
from its twin, which starts from positions with 0.1 mm of noise. Deepest vertex in the body, crossing triangle pairs
and stretch are counted without the kernels that are judged. Results: benchmarks/results/teachers_converged_MATERIAL.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.measure import RESULTS, machine
from benchmarks.teacher import world
from benchmarks.teachers_side_by_side import figures, of_material, scenes
from warpgarment.io.disk.atomic import atomic_files
from warpgarment.training.tables.outfits.crossings import crossing_pairs
from warpgarment.training.teachers import ClothScene, Teacher
from warpgarment.training.teachers.newton.settings import NewtonSettings
from warpgarment.training.teachers.newton.teacher import NewtonTeacher
from warpgarment.training.teachers.warp.settings import WarpSettings
from warpgarment.training.teachers.warp.teacher import WarpTeacher
from warpgarment.view.markdown import table

NOISE = 1e-4  # metres, of the twin's start
BEST = WarpSettings(iterations=150, tolerance=1e-7)
HEADINGS = (
    "garment", "faces", "teacher", "ms a frame", "share of Newton", "from converged cm", "twin cm", "deepest mm",
    "crossing pairs", "stretch p99 %",
)  # fmt: skip


def in_turns(teachers: list[Teacher], scene: ClothScene) -> tuple[list[np.ndarray], list[float]]:
    """Frames by each teacher [T,V,3], and the least processor time of a frame [s], each taking one frame in turn."""
    streams: list[Iterator[np.ndarray]] = [iter(teacher.simulate(scene)) for teacher in teachers]
    shown: list[list[np.ndarray]] = [[] for _ in teachers]
    least = [float("inf")] * len(teachers)
    for number in range(len(scene)):
        for k, stream in enumerate(streams):
            began = time.process_time()
            shown[k].append(next(stream))
            if number > 0:
                least[k] = min(least[k], time.process_time() - began)
    return [np.stack(frames) for frames in shown], least


def twin_of(scene: ClothScene) -> ClothScene:
    """The scene from positions with noise."""
    rng = np.random.default_rng(1)
    cloths = []
    for cloth in scene.cloths:
        noisy = cloth.first + NOISE * rng.normal(size=cloth.first.shape)
        cloths.append(replace(cloth, start=noisy.astype(np.float32)))
    return replace(scene, cloths=tuple(cloths))


def distance(one: np.ndarray, other: np.ndarray) -> float:
    """Mean distance of vertices [cm]."""
    return 100.0 * float(np.linalg.norm(one.astype(np.float64) - other, axis=2).mean())


def crossings(scene: ClothScene, frames: np.ndarray) -> float:
    """Mean number of crossing pairs in every fifth frame."""
    faces = np.concatenate([c.garment.faces + s for c, s in zip(scene.cloths, scene.starts, strict=False)])
    return float(np.mean([len(crossing_pairs(points, faces)) for points in frames[::5]]))


def compared(name: str, scene: ClothScene, settings: WarpSettings, newton_converged: bool) -> list[list[str]]:
    """Rows of the table for a scene."""
    newton, ours = NewtonTeacher(NewtonSettings()), WarpTeacher(settings)
    for teacher in (newton, ours):
        next(iter(teacher.simulate(scene)))  # compiles what is not compiled
    (by_newton, by_us), (slow, fast) = in_turns([newton, ours], scene)
    best, twin = (np.stack(list(WarpTeacher(BEST).simulate(s))) for s in (scene, twin_of(scene)))
    faces = sum(len(c.garment.faces) for c in scene.cloths)
    rows = []
    for label, frames, seconds in (
        ("Newton 10 x 5", by_newton, slow),
        (f"Warp {settings.substeps} x {settings.iterations}", by_us, fast),
    ):
        found = figures(scene, frames)
        own, floor = "-", "-"
        if frames is by_us:
            own, floor = f"{distance(frames, best):.3f}", f"{distance(best, twin):.3f}"
        elif newton_converged:
            more = NewtonTeacher(NewtonSettings(substeps=20, iterations=20))
            own = f"{distance(frames, np.stack(list(more.simulate(scene)))):.3f}"
        rows.append(
            [
                name,
                f"{faces:,}",
                label,
                f"{1e3 * seconds:.0f}",
                f"{seconds / slow:.2f}",
                own,
                floor,
                f"{found['deepest']:.1f}",
                f"{crossings(scene, frames):.1f}",
                f"{found['stretch_p99']:.1f}",
            ]
        )
        print("  ".join(rows[-1]), flush=True)
    return rows


def main() -> None:
    """Simulates, measures and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--material", default="jersey", help="a preset, or default")
    parser.add_argument("--iterations", type=int, default=WarpSettings.iterations)
    parser.add_argument("--tolerance", type=float, default=WarpSettings.tolerance)
    parser.add_argument("--newton-converged", action="store_true")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    torch.set_num_threads(1)
    made = {
        "T-shirt": replace(scenes(20 + options.frames)["T-shirt"], settle=5),
        "dress, remeshed": world(1100, options.frames, 0),
        "dress, finer": world(1836, options.frames, 0),
        "dress, settled": scenes(options.frames)["dress"],
    }
    made = of_material(made, options.material)
    settings = WarpSettings(iterations=options.iterations, tolerance=options.tolerance)
    rows = [row for name, scene in made.items() for row in compared(name, scene, settings, options.newton_converged)]
    about = ", ".join(f"{k} {v}" for k, v in machine(torch.device("cpu")).items())
    lines = [
        "# Teachers and convergence",
        "",
        about,
        "",
        f"`python -m benchmarks.physics.converged --material {options.material} --frames {options.frames}`",
    ]
    lines += ["", *table(list(HEADINGS), rows, text=3)]
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"teachers_converged_{options.material}.md"
    with atomic_files(path) as (written,):
        written.write_text("\n".join(lines) + "\n")
    print(f"written {path}")


if __name__ == "__main__":
    main()
