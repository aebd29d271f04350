"""Whole frames: batches of garments, packed, against the same garments one by one in a Python loop."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from unittest import mock

import torch

from benchmarks.measure import NO_GPU, Row, aimed_time, figures, interleaved
from benchmarks.networks import Named
from benchmarks.scenes import Dressed, dressed
from warpgarment.errors import NotEnoughMemory
from warpgarment.objects.garment import Garment
from warpgarment.sim import memory
from warpgarment.sim.arguments import packed_on
from warpgarment.sim.simulator import Simulator
from warpgarment.sim.state import SimulationState

CPU_BATCH = (1, 2, 4, 8, 16)
GPU_BATCH = (1, 4, 16, 64, 256, 1024, 4096)
LOOP = 16  # largest batch that is also simulated one by one
START, STARTS = 40, 8  # first frame of the walk at which a body begins, and number of such frames
WALK = 12  # number of frames that are played forth and back
LONGEST = 6.0  # largest time of a frame, estimated from the batch before it [s]


class Rolling:
    """A simulation of any number of frames: the bodies walk, and walk back.

    On a GPU the bodies are uploaded beforehand, so that the time of the transfer is not measured.
    """

    def __init__(self, simulator: Simulator, scenes: Sequence[Dressed]) -> None:
        self.simulator = simulator
        self.bodies = [scene.body for scene in scenes]
        frames = min(WALK, *(body.frames for body in self.bodies))
        self.order = itertools.cycle([*range(1, frames), *range(frames - 2, -1, -1)])
        garments, first = [scene.garment for scene in scenes], [scene.first for scene in scenes]
        shapes, faces = [body.vertices[0] for body in self.bodies], [body.faces for body in self.bodies]
        self.state: SimulationState = simulator.start(garments, shapes, faces, first_vertices=first)
        self.sent: list[torch.Tensor] = []
        if simulator.device.type == "cuda":
            walk = [[body.vertices[frame] for body in self.bodies] for frame in range(frames)]
            self.sent = [packed_on(positions, simulator.device) for positions in walk]

    def __call__(self) -> None:
        """Simulates one frame."""
        frame = next(self.order)
        if self.sent:
            self.state = self.simulator._advance(self.state, self.sent[frame])
        else:
            self.state = self.simulator.step(self.state, [body.vertices[frame] for body in self.bodies])


def scenes_of(sizes: Sequence[int], number: int) -> list[Dressed]:
    """A number of garments with the given numbers of faces in turn, on bodies that begin at different frames."""
    return [dressed(sizes[k % len(sizes)], start=START + k % STARTS) for k in range(number)]


def rows(
    faces: Sequence[int], batches: Sequence[int], device: torch.device, networks: Sequence[Named], seconds: float
) -> Iterator[Row]:
    """Milliseconds per garment and frame: each size alone in a batch, then all sizes mixed, and frames by stage."""
    simulators = [(label, Simulator(network, device)) for label, network in networks]
    mixed = [(list(faces[:3]), [b for b in batches if b > 1])] if len(faces) > 1 else []
    for sizes, numbers in [([size], batches) for size in faces] + mixed:
        for label, simulator in simulators:
            for row in _series(sizes, numbers, simulator, seconds):
                row = row | {"network": label}
                named = row["batch"] == len(sizes) == 1 and 1_500 < row["faces"] < 2_500 and device.type == "cpu"
                yield aimed_time(row, 33.0, 2_000) if named else row
            if len(sizes) == 1:
                yield from (row | {"network": label} for row in _stages(sizes[0], simulator))
    if device.type == "cpu":
        for number in GPU_BATCH:
            yield {"part": "batch", "what": "frame per garment", "device": "cuda", "batch": number, "note": NO_GPU}


def _series(sizes: Sequence[int], batches: Sequence[int], simulator: Simulator, seconds: float) -> Iterator[Row]:
    device, each = simulator.device, 0.0
    for number in batches:
        scenes = scenes_of(sizes, number)
        garments: list[Garment] = [scene.garment for scene in scenes]
        mean = round(sum(len(g.faces) for g in garments) / number)
        what = "frame per garment" if len(sizes) == 1 else "frame per garment, mixed sizes"
        base = {"part": "batch", "what": what, "device": device.type, "faces": mean, "batch": number}
        if each * number > LONGEST:
            yield base | {"note": f"not run: a frame would take some {each * number:.0f} s"}
            continue
        try:
            packed = Rolling(simulator, scenes)
        except NotEnoughMemory as error:
            yield base | {"note": f"not run: {str(error).split(':')[0]}"}
            return
        except torch.cuda.OutOfMemoryError:
            yield base | {"note": "not run: out of memory, which was not predicted"}
            return
        need = memory.predict(garments, [scene.body for scene in scenes], simulator.network.config, device=device)
        calls = {"packed": _block(packed, device)}
        if 1 < number <= LOOP and each * number < LONGEST / 4:
            alone = [_block(Rolling(simulator, [scene]), device) for scene in scenes]
            calls["loop"] = lambda alone=alone: [call() for call in alone]
        began = time.perf_counter()
        times = interleaved(calls, device, seconds)
        each = min(times["packed"]) / _frames(device) / number / 1e3
        row = base | figures(times["packed"], 1.0 / number / _frames(device)) | {"memory_mb": need.total / 1e6}
        if "loop" in calls:
            loop = figures(times["loop"], 1.0 / number / _frames(device))
            row |= {"reference": "Python loop over garments"}
            row |= {f"reference_{key}": value for key, value in loop.items()}
            row["ratio"] = loop["min_ms"] / row["min_ms"]
        row["spent_s"] = round(time.perf_counter() - began, 1)
        yield row


def _stages(size: int, simulator: Simulator) -> Iterator[Row]:
    """The time of a frame by stage for one garment, as the mean of a few frames."""
    rolling = Rolling(simulator, scenes_of([size], 1))
    simulator.timings.synchronise = True
    rolling()
    simulator.timings.clear()
    frames = 4
    # processor time on a CPU, as in all measurements here
    clock = time.process_time if simulator.device.type == "cpu" else time.perf_counter
    with mock.patch("warpgarment.sim.timing.time.perf_counter", clock):
        for _ in range(frames):
            rolling()
    simulator.timings.synchronise = False
    count = len(dressed(size).garment.faces)
    for stage, seconds in simulator.timings.items():
        mean = 1e3 * seconds / frames
        yield {"part": "batch", "what": f"stage of a frame: {stage}", "faces": count, "batch": 1, "median_ms": mean}


def _frames(device: torch.device) -> int:
    """Number of frames per timed call; a GPU is not synchronised between them."""
    return 1 if device.type == "cpu" else 16


def _block(rolling: Rolling, device: torch.device):
    def run() -> None:
        for _ in range(_frames(device)):
            rolling()

    return run
