"""The network against the device: operations and bytes, and the highest rates of the device for both.

Operations are those of `warpgarment.nn.flops`, forward. Bytes are the least number for the layers as written, in which
every operator reads its inputs and writes its outputs once: per token and layer, in units of the embedding E,

    norms 4, q, k, v 1 + 3 - 2 m, attention 4 - 2 m, output 2, residual sums 6, feed-forward 2 + 4 W/E

with m the share of manifold heads and W the feed-forward width, plus all parameters once, the geodesic weights once per
layer, and the stacked features. In a network of patches these tokens are the patches; per face, of width F in K face
layers of hidden width G, it is

    embedding 1, pooling 1, spreading 4, answer 3 + 12/F, the layer before 7 + 4 G/F, each after 10 + 8 G/F

in units of F, the indices and shares of pools and neighbours once, and per patch 3 F + 5 E for the change to its width
and back. The least time of a call is the larger of operations over the matrix rate and bytes over the copy bandwidth,
both measured in one run; the achieved share is that time over the measured one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch

from benchmarks.batch import scenes_of
from benchmarks.measure import NO_GPU, Row, figures, interleaved
from benchmarks.networks import Named
from warpgarment.geometry.pooled_geodesics import CENTRES, NEAR
from warpgarment.kernels.features.channels import FEATURES
from warpgarment.nn.architecture import architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import FrameInputs
from warpgarment.nn.patches.layout import SHARES, PatchLayout
from warpgarment.objects.garment import POOLED
from warpgarment.sim.simulator import Simulator

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
MATRIX = {"cpu": 1536, "cuda": 8192}
COPIED = {"cpu": 2**28, "cuda": 2**30}  # size of the copy that is timed [bytes]
TOKENS = {"cpu": 8192, "cuda": 131_072}  # largest number of faces in a batch


def network_bytes(
    config: NetworkConfig, faces: int, components: int, batch: int, parameters: int, size: int, patches: int = 0
) -> int:
    """Bytes as counted in the module's docstring; `size` is that of a number in bytes."""
    e, nodes = config.embedding, patches or faces
    manifold = config.manifold_heads / config.heads
    layer = e * (4 + (4 - 2 * manifold) + (4 - 2 * manifold) + 2 + 6 + 2) + 4 * config.feed_forward
    weights = nodes**2 if config.manifold_heads else 0
    indices = 0
    if not patches and faces > POOLED:
        weights, indices = CENTRES**2 + 2 * NEAR * faces, config.layers * 8 * 2 * NEAR * faces
    numbers = config.layers * (batch * (nodes + components) * layer + weights) + parameters
    stacked = 4 * config.history * FEATURES * batch * faces
    if patches:
        width, hidden = config.face_embedding, config.face_feed_forward
        each = 16 * width + 4 * hidden + 12 + config.face_layers * (10 * width + 8 * hidden)
        numbers += batch * (faces * each + patches * (3 * width + 5 * e))
        indices = faces * (2 * 12 * SHARES + 8 * 3 * config.face_layers)  # once: the batch shares its garment
    return int(size * numbers + stacked + indices)


def device_rates(device: torch.device, seconds: float) -> dict[str, float]:
    """Measured rates: operations per second of a large matrix product by precision, bytes per second of a copy."""
    n, rates = MATRIX[device.type], {}
    for name, dtype in PRECISIONS.items():
        a, b = (torch.randn(n, n, device=device).to(dtype) for _ in range(2))
        out = torch.empty_like(a)
        times = interleaved({name: lambda a=a, b=b, out=out: torch.mm(a, b, out=out)}, device, seconds)
        rates[name] = 2e3 * n**3 / min(times[name])
    source = torch.randn(COPIED[device.type] // 4, device=device)
    target = torch.empty_like(source)
    times = interleaved({"copy": lambda: target.copy_(source)}, device, seconds)
    rates["copy"] = 2e3 * COPIED[device.type] / min(times["copy"])  # bytes that are read and bytes that are written
    return rates


def rows(
    faces: Sequence[int], batches: Sequence[int], device: torch.device, networks: Sequence[Named], seconds: float
) -> Iterator[Row]:
    """The device's rates, then one row per size, batch and precision."""
    rates = device_rates(device, seconds)
    for name, rate in rates.items():
        unit = "bytes" if name == "copy" else "operations"
        yield {"part": "roofline", "what": f"device: {name}, {unit} per second", "rate": rate}
    for label, network in networks:
        for row in _rows(faces, batches, Simulator(network, device), seconds, rates):
            yield row | {"network": label}
    if device.type == "cpu":
        yield {"part": "roofline", "what": "network", "device": "cuda", "note": NO_GPU}


def _rows(
    faces: Sequence[int], batches: Sequence[int], simulator: Simulator, seconds: float, rates: dict[str, float]
) -> Iterator[Row]:
    device, config, parameters = simulator.device, simulator.network.config, simulator.network.parameter_count()
    for size in faces:
        for number in batches:
            if number > 1 and number * size > TOKENS[device.type]:
                continue
            scenes = scenes_of([size], number)
            shapes, body_faces = [s.body.vertices[0] for s in scenes], [s.body.faces for s in scenes]
            first = [s.first for s in scenes]
            scene = simulator.start([s.garment for s in scenes], shapes, body_faces, first_vertices=first).scene
            total, count = len(scene.packed.faces), len(scenes[0].garment.faces)
            components = scene.packed.component_count // number
            stacked = torch.randn(total, config.history, FEATURES, device=device)
            velocities = torch.randn(scene.packed.component_count, config.history - 1, 3, device=device)

            places = (torch.empty(0, 3, device=device),) * 3  # of cloth and bodies, which these networks do not look at

            def call(half: bool, scene=scene, stacked=stacked, velocities=velocities, places=places) -> None:
                scene.half = half
                with torch.inference_mode():
                    scene.predict(FrameInputs(stacked, velocities, *places))

            calls = {"float32": lambda call=call: call(False), "bfloat16": lambda call=call: call(True)}
            layout = scene.layout.views[0].weights
            patches = layout.start.shape[1] if isinstance(layout, PatchLayout) else 0
            operations = number * sum(architecture(config.architecture).flops(config, count, components, layout))
            for name, times in interleaved(calls, device, seconds).items():
                moved = network_bytes(config, count, components, number, parameters, PRECISIONS[name].itemsize, patches)
                measured = figures(times)
                floor = 1e3 * max(operations / rates[name], moved / rates["copy"])
                yield {
                    "part": "roofline",
                    "what": f"network, {name}",
                    "faces": count,
                    "batch": number,
                    **measured,
                    "operations": operations,
                    "bytes": moved,
                    "floor_ms": floor,
                    "bound": "matrix rate" if operations / rates[name] > moved / rates["copy"] else "bandwidth",
                    "achieved": floor / measured["min_ms"],
                    "rate": 1e3 * operations / measured["min_ms"],
                }
