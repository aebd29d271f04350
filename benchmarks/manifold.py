"""Geodesic distances, and the manifold heads that use them: dense, pooled, or between patches."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from unittest import mock

import numpy as np
import torch

from benchmarks.measure import Call, Row, aimed, aimed_time, compared
from benchmarks.scenes import remeshed
from warpgarment.geometry.pooled_geodesics import CENTRES
from warpgarment.kernels.mesh.shortest_paths import usable_cores
from warpgarment.nn.attention import ManifoldAwareAttention, geodesic_weights
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.layout import dense_weights, pooled_weights
from warpgarment.nn.patches.layout import PatchLayout
from warpgarment.nn.rows import padded_views
from warpgarment.objects.garment import KEPT, Garment
from warpgarment.objects.pack import PackedGarments

from . import exact

SOURCES = 4  # number of faces whose distances are compared with exact ones
ROWS = 64  # number of rows of the pooled weights that are compared with dense ones
POOLED_FROM = 9_000  # number of faces from which pooled weights are timed, too; garments use them beyond 10,000 only


def geodesics(sizes: Sequence[int]) -> Iterator[Row]:
    """Rows on distances between all faces of a garment, computed once and read from disk; later parts use them."""
    for number, size in enumerate(sizes):
        garment = remeshed(size)[0]
        count = len(garment.faces)
        base = {"part": "geodesics", "faces": count}
        with tempfile.TemporaryDirectory() as folder, mock.patch.dict(os.environ, WARPGARMENT_CACHE=folder):
            garment.__dict__.pop("geodesics", None)
            row = base | {"what": "geodesics of all pairs of faces"} | _once(lambda g=garment: g.geodesics)
            how = f" by the clock on {usable_cores()} cores"
            named = 8_000 < count < 12_000
            yield aimed_time(row, 10_000.0, 10_000, 2.0, key="wall_ms", how=how) if named else row
            if count >= KEPT:
                again = Garment(garment.vertices, garment.faces)
                yield base | {"what": "the same from disk"} | _once(lambda g=again: g.geodesics)
        if number == 0:
            yield _worst(garment, base | {"what": "geodesics, off the exact ones"})


def _worst(garment: Garment, base: Row) -> Row:
    sources = np.linspace(0, len(garment.faces) - 1, SOURCES).astype(int)
    try:
        truth = exact.geodesics(garment.vertices, garment.faces, sources)
    except ImportError:
        return base | {"note": "not run: pygeodesic is not installed"}
    far = np.isfinite(truth) & (truth > 0.0)
    far[np.arange(len(sources)), sources] = False
    error = float(np.abs(garment.geodesics[sources][far] / truth[far] - 1.0).max())
    return aimed(base | {"error": error}, "under 5 % at worst", f"{error:.2%}", error < 0.05)


def _once(call: Call) -> Row:
    wall, work = time.perf_counter(), time.process_time()
    call()
    spent = 1e3 * (time.process_time() - work)
    return {"min_ms": spent, "median_ms": spent, "wall_ms": 1e3 * (time.perf_counter() - wall), "runs": 1}


@torch.inference_mode()
def heads(garment: Garment, device: torch.device, seconds: float) -> Iterator[Row]:
    """Rows on two manifold heads of a layer with projections, against softmax(-(D/r)^p) V of all pairs."""
    config, fast = NetworkConfig.small(), NetworkConfig.fast()
    head = config.embedding // config.heads
    attention = ManifoldAwareAttention(2 * head, 2, 2, 0.0).to(device).eval()
    packed = PackedGarments.pack([garment], device)
    count = len(garment.faces)
    tokens = torch.randn(1, count, 2 * head, device=device)
    distances = torch.from_numpy(garment.geodesics).to(device)
    calls: dict[str, Call] = {}
    for name, settings in (("", config), (", patches", fast)):
        weights = padded_views(packed, [garment], settings)[0].weights
        heard = tokens
        if isinstance(weights, PatchLayout):
            weights, heard = weights.weights, tokens[:, : weights.start.shape[1]]
        calls[f"manifold heads of a layer{name}"] = lambda x=heard, w=weights: attention(x, w, None)
    pooled = count > POOLED_FROM and not garment.pools
    if pooled:
        every = [(garment.pooled_geodesics, np.arange(count))]
        spread = pooled_weights(every, config.geodesic_radius, config.geodesic_power, device)
        calls["manifold heads of a layer, pooled"] = lambda: attention(tokens, spread, None)

    def dense() -> object:
        value = torch.nn.functional.linear(tokens, attention.qkv.weight[-2 * head :], attention.qkv.bias[-2 * head :])
        scores = [  # each head has its own softmax over all pairs, as in attention
            torch.softmax(-((distances / config.geodesic_radius) ** config.geodesic_power), dim=-1) @ part
            for part in value[0].split(head, dim=-1)
        ]
        return attention.out(torch.cat(scores, dim=-1))

    base = {"part": "stages", "faces": count, "what": "manifold heads"}
    yield from compared(base, calls, {"dense softmax": dense}, device, seconds)
    if pooled:
        yield from _pooling(garment, distances, device)


def _pooling(garment: Garment, distances: torch.Tensor, device: torch.device) -> Iterator[Row]:
    """Difference between pooled and dense weights in rows' L1 norm, on such a subset of faces as a network reads."""
    subset = np.arange(0, len(garment.faces), 2)
    part = distances[::2, ::2]
    chosen = np.linspace(0, len(subset) - 1, ROWS).astype(int)
    for name, config in (("base", NetworkConfig.base()), ("small", NetworkConfig.small())):
        settings = config.geodesic_radius, config.geodesic_power
        near = dense_weights(garment.pooled_geodesics, subset, *settings, device)[chosen]
        off = (near - geodesic_weights(part, *settings)[chosen]).abs().sum(dim=1)
        mean, worst = float(off.mean()), float(off.max())
        row = {"part": "stages", "faces": len(garment.faces), "error": worst}
        row |= {"what": f"weights of {name}, pooled at {CENTRES:,} centres, off the dense ones"}
        yield aimed(row, "under 1e-3", f"mean {mean:.1e}, worst {worst:.1e}", worst < 1e-3)
