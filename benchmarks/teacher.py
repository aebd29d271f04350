"""Speed of a physics teacher: garments of several sizes one at a time, and many worlds at once.

    python -m benchmarks.teacher                                                # Newton on one core: 1k and 2k faces
    python -m benchmarks.teacher --teacher newton --device cpu --faces 1000 2000 --worlds 1 4
    python -m benchmarks.teacher --device cuda:0 --worlds 1 4 16 64 256 1024    # frames a second over all worlds
    python -m benchmarks.teacher --teacher blender

The scene is the bundled dress, remeshed to each size, draped on the bundled body as it walks; worlds start at different
frames of the walk. Building a model, compiling and the first frame are timed separately. A case that cannot run on the
machine is a row with a note. Results are in benchmarks/results/teacher_<teacher>_<device>.json and .md.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.batch import Rolling, scenes_of
from benchmarks.measure import RESULTS, Row, figures, interleaved, machine
from benchmarks.networks import Named
from benchmarks.scenes import dressed
from warpgarment.io.disk.atomic import atomic_files
from warpgarment.kernels.replay.pieces import FIRST
from warpgarment.sim.simulator import Simulator
from warpgarment.training.teachers import TEACHERS, Cloth, ClothScene, Teacher, TeacherError, make_teacher
from warpgarment.view.markdown import table

WORLDS = {"cpu": (1, 4), "cuda": (1, 4, 16, 64, 256, 1024)}
STARTS = 24  # number of frames of the walk at which worlds start


@lru_cache(maxsize=4 * STARTS)
def world(faces: int, frames: int, start: int) -> ClothScene:
    """The dress with about `faces` faces on `frames` frames of the walk, from frame `start` on."""
    scene = dressed(faces, start=8 + start)
    ends = scene.garment.vertices[scene.garment.edges]
    edge = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
    cloth = Cloth(scene.garment, edge, scene.first)
    return ClothScene((cloth,), scene.body.vertices[:frames], scene.body.faces, fps=scene.body.fps, settle=0)


def timed(teacher: Teacher, scenes: list[ClothScene]) -> tuple[float, float]:
    """Time until the first frame [s], and time per frame after it [s]."""
    began = time.perf_counter()
    stream = teacher.simulate_many(scenes)
    next(stream)
    started = time.perf_counter()
    frames = sum(1 for _ in stream)
    return started - began, (time.perf_counter() - started) / frames


def rows(teacher: str, device: str, sizes: list[int], worlds: list[int], frames: int) -> Iterator[dict[str, Any]]:
    """One dictionary per measurement: faces, worlds, and either the times or a note why there are none."""
    for faces in sizes:
        for number in worlds if faces == sizes[0] else worlds[:1]:
            row: dict[str, Any] = {"teacher": teacher, "device": device, "faces": faces, "worlds": number}
            if device.startswith("cuda") and not torch.cuda.is_available():
                yield row | {"note": "not run: there is no CUDA device"}
                continue
            scenes = [world(faces, frames, w % STARTS) for w in range(number)]
            row["faces"] = len(scenes[0].cloths[0].garment.faces)
            try:
                first, each = timed(make_teacher(teacher, device), scenes)
            except (RuntimeError, MemoryError) as error:  # for example, out of memory
                yield row | {"note": f"not run: {str(error).splitlines()[0][:120] or type(error).__name__}"}
                continue
            yield row | {
                "first_frame_s": round(first, 2),
                "frame_s": round(each, 4),
                "frames_per_s": round(number / each, 2),
                "frames_per_hour": round(3600.0 * number / each),
            }


def against(faces: list[int], device: torch.device, networks: Sequence[Named], frames: int) -> Iterator[Row]:
    """Rows on whole frames of the simulator and of Newton's VBD, with one garment on one body, one at a time."""
    for size in faces:
        scene = world(size, frames + 1, 32)
        base = {"part": "teacher", "what": "whole frame", "faces": len(scene.cloths[0].garment.faces), "batch": 1}
        reference = {"reference": "Newton VBD, 10 substeps of 5 iterations"}
        try:
            stream = make_teacher("newton", str(device)).simulate_many([scene])
            next(stream)
        except TeacherError as error:
            yield base | {"reference": "Newton VBD", "note": str(error).splitlines()[0]}
            continue
        rolling = {
            f"ours: {label}": Rolling(Simulator(network, device), scenes_of([size], 1)) for label, network in networks
        }
        for roll in rolling.values():
            for _ in range(FIRST + 2):
                roll()
        times = interleaved({**rolling, "VBD": lambda s=stream: next(s)}, device, 1e9, most=frames - 1)
        vbd = {f"reference_{key}": value for key, value in figures(times["VBD"]).items()}
        for label, _ in networks:
            own = figures(times[f"ours: {label}"])
            ratio = vbd["reference_min_ms"] / own["min_ms"]
            yield base | {"network": label} | own | reference | vbd | {"ratio": ratio}


def settings(teacher: str) -> dict[str, Any]:
    """Settings and versions of a teacher; empty if it is not installed."""
    try:
        return make_teacher(teacher, "cpu").settings()
    except TeacherError:
        return {}


def markdown(about: dict[str, str], command: str, done: list[dict[str, Any]]) -> str:
    """The results as a table."""
    lines = ["# " + ", ".join(f"{k} {v}" for k, v in about.items()), ""]
    lines += [
        f"`{command}`",
        "",
        "The bundled dress on its walking body. On a CPU one process on one thread: frames an hour",
    ]
    lines += ["are per core. First frame: building, compiling and the first frame itself.", ""]
    names = ["teacher", "device", "faces", "worlds", "first frame s", "s a frame", "frames/s, all worlds"]
    cells = []
    for row in done:
        shown = [row["teacher"], row["device"], f"{row['faces']:,}", f"{row['worlds']:,}"]
        if "note" in row:
            shown += [row["note"], "-", "-", "-"]
        else:
            shown += [f"{row['first_frame_s']:.1f}", f"{row['frame_s']:.3f}", f"{row['frames_per_s']:.2f}"]
            shown += [f"{row['frames_per_hour']:,}"]
        cells.append(shown)
    return "\n".join([*lines, *table([*names, "frames an hour"], cells, text=2)]) + "\n"


def main() -> None:
    """Runs all cases that the device can run, and writes the results."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--teacher", choices=TEACHERS, default="newton")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--faces", type=int, nargs="+", default=[1000, 2000])
    parser.add_argument("--worlds", type=int, nargs="+", help="worlds of the first size; default by device")
    parser.add_argument("--frames", type=int, default=20, help="frames measured, after the first")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    options = parser.parse_args()
    kind = "cuda" if options.device.startswith("cuda") else "cpu"
    if kind == "cpu":
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        torch.set_num_threads(1)
    worlds = options.worlds or list(WORLDS[kind])
    done = []
    measured = rows(options.teacher, options.device, options.faces, worlds, options.frames + 1)
    if kind == "cpu" and options.teacher == "newton" and not torch.cuda.is_available():
        missing = rows(options.teacher, "cuda", options.faces[:1], list(WORLDS["cuda"]), options.frames + 1)
    else:
        missing = iter(())
    for row in (*measured, *missing):
        done.append(row)
        print(row.get("note") or f"{row['frames_per_s']:.2f} frames/s", {k: row[k] for k in ("faces", "worlds")})
    device = torch.device(kind if kind == "cpu" or torch.cuda.is_available() else "cpu")
    used = settings(options.teacher)
    about = machine(device) | {k: str(used[k]) for k in ("newton", "bpy", "substeps", "iterations") if k in used}
    command = (
        f"python -m benchmarks.teacher --teacher {options.teacher} --device {options.device} --faces "
        f"{' '.join(map(str, options.faces))} --worlds {' '.join(map(str, worlds))} --frames {options.frames}"
    )
    target = options.out / f"teacher_{options.teacher}_{options.device.replace(':', '')}"
    with atomic_files(target.with_suffix(".json"), target.with_suffix(".md")) as (data, page):
        data.write_text(json.dumps({"machine": about, "command": command, "settings": used, "rows": done}, indent=1))
        page.write_text(markdown(about, command, done))
    print(f"written {target}.md")


if __name__ == "__main__":
    main()
