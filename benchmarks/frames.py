"""Counts within a frame: launches, operators, and waits of the host for the device."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from unittest import mock

import torch
import warp as wp
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.batch import Rolling, scenes_of
from benchmarks.measure import NO_GPU, Row, aimed
from benchmarks.networks import Named
from warpgarment.kernels import recorded, threads
from warpgarment.kernels.linear import progress
from warpgarment.sim.advance import advance
from warpgarment.sim.arguments import packed_on
from warpgarment.sim.graph import WARM_UP
from warpgarment.sim.simulator import Simulator

READS = {"_local_scalar_dense", "nonzero", "masked_select", "unique", "equal", "is_nonzero"}  # the host waits for these
VIEWS = {"view", "unsqueeze", "expand", "slice", "select", "t", "transpose", "split", "split_with_sizes", "alias"}
VIEWS |= {"_unsafe_view", "permute", "squeeze", "as_strided", "detach", "unbind", "lift_fresh", "_reshape_alias"}
FRAMES = 8  # number of frames in the profile of a GPU
WAITS = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize")
LAUNCHES = ("cudaLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernel", "cuLaunchKernelEx")


class Operators(TorchDispatchMode):
    """Counts torch operators except views, and lists the tensors for which the host would wait."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[str] = Counter()
        self.read: list[tuple[str, torch.Tensor]] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        """Runs the operator."""
        name = func._schema.name.split("::")[1]
        if name not in VIEWS:
            self.counts[name] += 1
        indices = args[1] if name.startswith(("index", "_index")) and len(args) > 1 else ()
        by_mask = isinstance(indices, (list, tuple)) and any(i is not None and i.dtype == torch.bool for i in indices)
        if name in READS or by_mask:
            self.read.append((name, args[0]))
        return func(*args, **(kwargs or {}))


class FrameCounts:
    """Counts within one frame in which the device takes every decision; the counts are the same on all devices.

    Attributes:
        operators: Number of calls of torch operators by name.
        launches: Number of Warp launches by kernel; `refit` is one per body.
        reads: Operators for whose result the host would wait.
    """

    def __init__(self, scene, now, next_body: torch.Tensor) -> None:
        self.launches: Counter[str] = Counter()
        early, scene.contact.early_exit = scene.contact.early_exit, False
        looks = scene.meet is not None and scene.meet.early_exit
        if scene.meet is not None:
            scene.meet.early_exit = False
        made = [(wp, "launch"), (wp, "launch_tiled"), (recorded, "prepared")]
        patches = [mock.patch.object(where, name, self._counted(getattr(where, name))) for where, name in made]
        patches.append(mock.patch.object(scene.pieces, "on", False))  # replays launch nothing through Python
        patches.append(mock.patch.object(threads, "count", return_value=1))  # one launch, not one for each thread
        refit = wp.Mesh.refit

        def counted_refit(mesh: wp.Mesh) -> None:
            self.launches["refit"] += 1
            refit(mesh)

        patches.append(mock.patch.object(wp.Mesh, "refit", counted_refit))
        patches.append(
            mock.patch.object(progress.Progress, "_warn", return_value=None)
        )  # a CPU would read reports immediately
        try:
            for patch in patches:
                patch.start()
            with torch.inference_mode(), Operators() as seen:
                advance(scene, now, next_body)
        finally:
            for patch in patches:
                patch.stop()
            scene.contact.early_exit = early
            if scene.meet is not None:
                scene.meet.early_exit = looks
        self.operators = seen.counts
        # Sizes of the compliance matrices are on the host.
        self.reads = [name for name, tensor in seen.read if tensor.dtype != torch.int64 or tensor.numel() != 1]

    def _counted(self, original):
        def counted(kernel, *args, **options):
            self.launches[kernel.key] += not options.get("record_cmd")  # a recorded one is counted as it is prepared
            return original(kernel, *args, **options)

        return counted


def rows(faces: int, batches: Sequence[int], device: torch.device, networks: Sequence[Named]) -> Iterator[Row]:
    """Counts per frame for each batch; on a GPU also calls in torch's profile of frames with and without a graph."""
    for named in networks:
        for row in _rows(faces, batches, device, named):
            yield row | {"network": named.label}


def _rows(faces: int, batches: Sequence[int], device: torch.device, named: Named) -> Iterator[Row]:
    simulator, alone = Simulator(named.network, device), 0
    for number in batches:
        scenes = scenes_of([faces], number)
        rolling = Rolling(simulator, scenes)
        rolling()
        bodies = packed_on([scene.body.vertices[2] for scene in scenes], simulator.device)
        counts = FrameCounts(rolling.state.scene, rolling.state.now, bodies)
        refits = counts.launches.pop("refit", 0)
        launches, reads = sum(counts.launches.values()), len(counts.reads)
        alone = alone or launches
        row = {
            "part": "profile",
            "what": "one frame, counted",
            "faces": len(scenes[0].garment.faces),
            "batch": number,
            "warp_launches": launches,
            "torch_operators": sum(counts.operators.values()),
            "refits": refits,
            "host_reads": reads,
        }
        reached = f"{reads} reads, {launches} launches"
        yield aimed(row, f"no reads, {alone} launches as for {batches[0]}", reached, not reads and launches == alone)
    for graph in (False, True):
        base = {"part": "profile", "what": f"frames {'as a CUDA graph' if graph else 'without a graph'}, profiled"}
        if device.type != "cuda":
            yield base | {"note": NO_GPU}
            continue
        for number in batches:
            yield base | {"batch": number} | _profiled(faces, number, device, named, graph)


def _profiled(faces: int, number: int, device: torch.device, named: Named, graph: bool) -> Row:
    """Calls of the CUDA runtime per frame in torch's profile."""
    rolling = Rolling(Simulator(named.network, device, graph=graph), scenes_of([faces], number))
    for _ in range(WARM_UP + 2):
        rolling()
    torch.cuda.synchronize(device)
    activities = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profile:
        for _ in range(FRAMES):
            rolling()
    seen = {event.key: event.count / FRAMES for event in profile.key_averages()}
    torch.cuda.synchronize(device)
    recorded = rolling.state.graph is not None and rolling.state.graph.recorded
    return {
        "faces": len(rolling.state.scene.packed.faces) // number,
        "graph": recorded,
        "synchronisations": sum(seen.get(name, 0.0) for name in WAITS),
        "launches": sum(seen.get(name, 0.0) for name in LAUNCHES),
        "graph_launches": seen.get("cudaGraphLaunch", 0.0),
        "copies": sum(count for name, count in seen.items() if name.startswith("cudaMemcpy")),
    }
