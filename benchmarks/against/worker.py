"""What one build does in one process, run by path in the environment of that build: `python worker.py THREADS`.

Only public names that all builds have are used. Commands are lines of JSON on the standard input, answers lines of JSON
on the standard output: `["prepare", name, kind, options]` makes a case, `["run", name]` times it once.
"""

from __future__ import annotations

import itertools
import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

threads = int(sys.argv[1])
os.environ["OMP_NUM_THREADS"] = str(threads)
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # what libraries print is no answer

began = time.perf_counter()
import numpy as np  # noqa: E402
import torch  # noqa: E402

import warpgarment as wg  # noqa: E402

torch.set_num_threads(threads)
_simulators: dict[str, wg.Simulator] = {}


def simulator(network: str = "fast") -> wg.Simulator:
    """The simulator of a network, made once."""
    if network not in _simulators:
        _simulators[network] = wg.Simulator.from_pretrained(network, device="cpu")
    return _simulators[network]


class Frames:
    """Frames of one or several garments on bodies that walk forth and back."""

    def __init__(self, scenes: list[str], network: str = "fast") -> None:
        self.garments, self.first, self.bodies, faces = [], [], [], []
        for scene in scenes:
            with np.load(scene) as data:
                self.garments.append(wg.Garment(data["vertices"], data["faces"]))
                self.first.append(data["first"])
                self.bodies.append(data["body"])
                faces.append(data["body_faces"])
        count = len(self.bodies[0])
        self.order = itertools.cycle([*range(1, count), *range(count - 2, -1, -1)])
        self.simulator = simulator(network)
        shapes = [body[0] for body in self.bodies]
        self.state = self.simulator.start(self.garments, shapes, faces, first_vertices=self.first)

    def __call__(self) -> None:
        """Simulates one frame."""
        frame = next(self.order)
        self.state = self.simulator.step(self.state, [body[frame] for body in self.bodies])


class SetUp:
    """Geodesics and set-up of a garment that was never seen: nothing is on disk, and the object is new."""

    def __init__(self, scene: str, network: str = "fast") -> None:
        os.environ["WARPGARMENT_NO_CACHE"] = "1"
        with np.load(scene) as data:
            self.data = dict(data)
        self.simulator = simulator(network)

    def __call__(self) -> None:
        """Computes all distances between faces and starts a simulation."""
        garment = wg.Garment(self.data["vertices"], self.data["faces"])
        assert garment.geodesics.shape == (len(garment.faces),) * 2
        first = self.data["first"]
        self.simulator.start(garment, self.data["body"][0], self.data["body_faces"], first_vertices=first)


class NextFrames:
    """The frame after each of several known histories, as positions: what two builds make of the same state.

    Histories are moved by `noise` [m], in turn with each of the `seeds`.
    """

    def __init__(
        self, motions: list[str], starts: list[int], noise: float, seeds: list[int], network: str = "fast"
    ) -> None:
        self.motions, self.starts, self.simulator = motions, starts, simulator(network)
        self.noise, self.seeds = noise, seeds

    def __call__(self) -> list[list[Any]]:
        """File of the motion, first known frame and positions [m] for each history."""
        found = []
        known = self.simulator.network.config.history
        for path in self.motions:
            with np.load(path) as data:
                garment = wg.Garment(data["vertices"], data["faces"], pins=data["pins"])
                frames, bodies, body_faces = data["frames"], data["body"], data["body_faces"]
            for start, seed in itertools.product(self.starts, self.seeds):
                body = wg.BodyMotion(bodies[start:], body_faces, 30.0)
                history = frames[start : start + known]
                history = history + np.random.default_rng(seed).normal(0, self.noise, history.shape).astype(np.float32)
                motion = self.simulator.rollout(garment, body, history=history, frames=known + 1)
                found.append([path, start, motion.vertices[known].tolist()])
        return found


class FirstRollout:
    """The first rollout of this process; a case that can run once."""

    def __init__(self, frames: int = 10, network: str = "fast") -> None:
        self.frames, self.network = frames, network

    def __call__(self) -> None:
        """Loads the bundled dress and rolls it out."""
        assets = wg.demo.assets()
        dress = assets.garments["dress"]
        first = dress.first_vertices
        simulator(self.network).rollout(dress.garment, assets.collider, first_vertices=first, frames=self.frames)


CASES = {"frames": Frames, "set-up": SetUp, "next": NextFrames, "first": FirstRollout}


def peak_mb() -> float:
    """Largest memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6


def main() -> None:
    """Answers commands until the input ends."""
    made: dict[str, Any] = {}
    where = str(Path(str(wg.__file__)).resolve().parent)
    print(json.dumps({"package": where, "import_s": time.perf_counter() - began}), file=answers, flush=True)
    for line in sys.stdin:
        command, name, *rest = json.loads(line)
        result = None
        clock, worked = time.perf_counter(), time.process_time()
        if command == "prepare":
            made[name] = CASES[rest[0]](**rest[1])
        else:
            result = made[name]()
        wall, work = time.perf_counter() - clock, time.process_time() - worked
        answer = {"wall_s": wall, "work_s": work, "peak_mb": peak_mb(), "result": result}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
