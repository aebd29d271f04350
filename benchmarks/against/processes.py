"""Processes in which one build or the other works."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import warpgarment as wg
from warpgarment.training.data.sequence import write_sequence

from .cases import Case

WORKER = Path(__file__).with_name("worker.py")
STEPS = 6  # of a training run; the first is not timed


def surroundings(threads: int) -> dict[str, str]:
    """Environment variables of a process with some threads, in which `warpgarment` is that of its interpreter."""
    # Installed packages keep their byte code, which Python would make anew in each process where it may not be written.
    left_out = "PYTHONPATH", "PYTHONHOME", "PYTHONDONTWRITEBYTECODE"
    kept = {name: value for name, value in os.environ.items() if name not in left_out}
    return kept | {"OMP_NUM_THREADS": str(threads)}


class Worker:
    """A process that answers commands of `worker.py`.

    Args:
        python: Interpreter of the build.
        threads: Number of threads.
        extra: Further environment variables.
    """

    def __init__(self, python: Path, threads: int, extra: dict[str, str] | None = None) -> None:
        command = [str(python), str(WORKER), str(threads)]
        pipe = subprocess.PIPE
        around = surroundings(threads) | (extra or {})
        self.process = subprocess.Popen(
            command, env=around, cwd="/", stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True
        )
        self.about = self._answer()

    def ask(self, *command: Any) -> dict[str, Any]:
        """The answer to a command."""
        assert self.process.stdin is not None
        print(json.dumps(command), file=self.process.stdin, flush=True)
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{' '.join(map(str, self.process.args))} ended with status {self.process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """Ends the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def fresh(python: Path, case: Case, given: dict[str, Any]) -> float:
    """The figure of a process that does the case once: seconds from its start, or the largest memory [MB]."""
    with tempfile.TemporaryDirectory() as empty:
        extra = {} if case.cached else {"WARP_CACHE_PATH": empty}
        began = time.perf_counter()
        worker = Worker(python, case.threads, extra)
        worker.ask("prepare", "case", case.kind, given)
        answer = worker.ask("run", "case")
        seconds = time.perf_counter() - began
        worker.close()
    return seconds if case.unit == "s" else float(answer["peak_mb"])


def trained(python: Path, case: Case, folder: Path) -> float:
    """Seconds per step of a run of unrolled training, eight frames of two garments."""
    data = _training_data(folder)
    with tempfile.TemporaryDirectory() as out:
        command = [str(python), "-m", "warpgarment", "train", "--data", str(data), "--out", out, "--network", "fast"]
        command += ["--init", "fast", "--steps", str(STEPS), "--batch-size", "2", "--unroll.steps", "8"]
        command += ["--threads", str(case.threads), "--log-every", "1", "--statistics-batches", "1"]
        subprocess.run(command, env=surroundings(case.threads), cwd=out, check=True, capture_output=True)
        lines = [json.loads(line) for line in (Path(out) / "log.jsonl").read_text().splitlines()]
    at = {line["step"]: line["seconds"] for line in lines if "loss" in line}
    steps = sorted(at)
    return (at[steps[-1]] - at[steps[0]]) / (steps[-1] - steps[0])


def demo_motions(folder: Path) -> list[str]:
    """The demo's garments and their recorded motions as files, since those that a build brings may be others."""
    assets, paths = wg.demo.assets(), []
    for name, item in sorted(assets.garments.items()):
        path = folder / f"{name}_recorded.npz"
        garment, body = item.garment, assets.collider
        arrays = {"vertices": garment.vertices, "faces": garment.faces, "pins": garment.pins}
        np.savez(path, frames=item.truth.vertices, body=body.vertices, body_faces=body.faces, **arrays)
        paths.append(str(path))
    return paths


def _training_data(folder: Path) -> Path:
    """The demo's garments as sequences of 60 frames, written once."""
    data = folder / "sequences"
    if data.exists():
        return data
    with np.load(wg.demo.ASSETS / "body.npz") as stored:
        body = {key: stored[key] for key in ("collider_faces", "bone_indices", "bone_weights")}
        body |= {"body_rest_vertices": stored["rest_vertices"], "body_faces": stored["faces"]}
        body["bone_transforms"] = stored["bone_transforms"][:60]
    for name, item in wg.demo.assets().garments.items():
        arrays = body | {
            "garment_rest_vertices": item.garment.vertices,
            "garment_faces": item.garment.faces,
            "pins": item.garment.pins,
            "garment_vertices": item.truth.vertices[:60],
        }
        about = {"status": "good", "split": "train", "garment": name, "motion": "walk", "fps": 30.0, "frames": 60}
        write_sequence(data / f"{name}_walk", arrays, about)
    return data
