"""The `Architecture` of networks of faces."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Hashable, Iterator, Sequence
from typing import Any

import numpy as np
import torch

from warpgarment.geometry.pooled_geodesics import CENTRES, NEAR
from warpgarment.kernels.features.channels import FEATURES, OUTDOOR
from warpgarment.nn.architecture import Architecture
from warpgarment.nn.attention import geodesic_weights
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.flops import layer_flops
from warpgarment.nn.inputs import NetworkSizes
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.rows import SMALL, activation_bytes, first_equal, row_groups
from warpgarment.objects.garment import Garment

from .grow import added
from .grow import grow as grown
from .layout import Sampled, pooled_weights, sampled
from .network import ManifoldAwareTransformer

MAKING_WEIGHTS = 2.3  # number of matrices besides the result while geodesic weights are made
STACKS = (6.0, 4.0)  # number of copies of the stacked features while they are prepared, and while the network runs
BAG_ENTRY = 12  # bytes of an entry of a sparse matrix: a column and a weight
PRESETS = {"base": NetworkConfig.base(), "small": NetworkConfig.small()}


class Faces(Architecture):
    """Every face is a token. `rows` are geodesic weights: a tensor [R,N,N], or `PooledWeights` for large garments."""

    config = NetworkConfig
    presets = PRESETS
    subsets = True

    def build(self, config: NetworkConfig) -> GarmentNetwork:
        """An untrained `ManifoldAwareTransformer`."""
        return ManifoldAwareTransformer(config)

    def geometry(self, garment: Garment, config: NetworkConfig) -> Any:
        """Geodesic distances between all faces, or pooled ones; None for a network without manifold heads."""
        if not config.manifold_heads:
            return None
        return garment.pooled_geodesics if garment.pools else garment.geodesics

    def sampled(self, geometry: Any, config: NetworkConfig, device: torch.device) -> Any:
        """Kernel or pooled distances on the device, as `Sampled`; None for a network without manifold heads."""
        return None if geometry is None else sampled(geometry, config.geodesic_radius, config.geodesic_power, device)

    def rows(
        self,
        shown: Sequence[tuple[Any, np.ndarray | None]],
        config: NetworkConfig,
        device: torch.device,
        scale: Sequence[float] | np.ndarray | None = None,
    ) -> Any:
        """Geodesic weights; `scale` has an effect only on a `geometry` from `sampled`."""
        first, radius, power = shown[0][0], config.geodesic_radius, config.geodesic_power
        if first is None:
            return torch.zeros((1, 0, 0), device=device)
        if isinstance(first, np.ndarray):
            parts = (d if f is None else np.ascontiguousarray(d[np.ix_(f, f)]) for d, f in shown)
            lengths = [len(d if f is None else f) for d, f in shown]
            return _padded(lengths, (geodesic_weights(torch.from_numpy(d).to(device), radius, power) for d in parts))
        subsets = [(g, np.arange(g.faces) if f is None else f) for g, f in shown]
        if isinstance(first, Sampled):
            factors = [1.0] * len(shown) if scale is None else scale
            drawn = (g.weights(f, float(s)) for (g, f), s in zip(subsets, factors, strict=True))
            return _padded([len(f) for _, f in subsets], drawn)
        return pooled_weights(subsets, radius, power, device)

    def entries(self, garment: Garment, faces: int, config: NetworkConfig) -> int:
        """Number of pairs of faces, or of centres for pooled distances."""
        return CENTRES**2 if garment.pools else faces**2

    def alike(self, garment: Garment) -> Hashable:
        """Whether the distances of the garment are pooled."""
        return garment.pools

    def memory(self, sizes: NetworkSizes, config: NetworkConfig) -> dict[str, int]:
        """Bytes of geodesic weights, of the distances they are made from (on a CPU), and of a call of the network."""
        garments, stack = sizes.garments, 4 * (config.history * FEATURES + OUTDOOR.width)
        weights, largest, network, equal = 0, 0, 0, first_equal(garments)
        for group in row_groups(garments, config, sizes.face_splits, cpu=sizes.cpu):
            length, matrices, pooled = max(count for _, _, count in group), 0, garments[group[0][0]].pools
            alike = len({(equal[g], first) for g, first, _ in group}) == 1
            if config.manifold_heads:
                rows = 1 if alike else len(group)
                each = self.entries(garments[group[0][0]], length, config)
                distinct = len({equal[g] for g, _, _ in group}) if pooled else rows
                matrices, largest = each * distinct, max(largest, 4 * each)
                weights += 4 * matrices
                weights += rows * (length * (2 * NEAR * BAG_ENTRY + 12) + 8 * CENTRES) if pooled else 0
            one_by_one = sizes.cpu and not sizes.half and alike and length > SMALL  # see `PaddedView.one_by_one`
            tokens = length if one_by_one else len(group) * length
            activations = activation_bytes(tokens, stack, STACKS, config.embedding, config.feed_forward, sizes.half)
            network = max(network, activations + (2 * matrices if sizes.half and not pooled else 0))
        distances = 0
        if sizes.cpu and config.manifold_heads:
            distances = sum(4 * _distances(garment) for garment in {id(g): g for g in garments}.values())
        return {
            "geodesic weights": weights,
            "geodesic distances": distances,
            "network": network,
            "making weights": int(MAKING_WEIGHTS * largest),
        }

    def flops(self, config: NetworkConfig, faces: int, components: int, rows: Any) -> tuple[int, int]:
        """Operations as in flops.py; pooled weights count like a full matrix."""
        heads = 2 * config.embedding * (12 * faces + 3 * components)
        inputs = faces * config.inputs + components * 3 * (config.history - 1)
        layers, geodesic = layer_flops(config, faces, components)
        return layers + heads, 2 * config.embedding * inputs + geodesic

    def start_from(
        self, network: GarmentNetwork, config: NetworkConfig, *, grow: bool, seed: int = 0
    ) -> GarmentNetwork:
        """The network grown as in grow.py; without `grow` the network itself, in its own shape. Both with the outdoor
        channels of `config`, at first without weight."""
        if grow:
            network = grown(network, dataclasses.replace(config, outdoor=network.config.outdoor), seed=seed)
        return added(network, config.outdoor)


def _padded(lengths: Sequence[int], matrices: Iterator[torch.Tensor]) -> torch.Tensor:
    """Matrices [n,n] as one tensor [R,N,N], padded with zeros; they come one by one to save memory."""
    first = next(matrices)
    if len(lengths) == 1:
        return first[None]
    padded = first.new_zeros((len(lengths), max(lengths), max(lengths)))
    for row, matrix in zip(padded, itertools.chain([first], matrices), strict=True):
        row[: len(matrix), : len(matrix)] = matrix
    return padded


def _distances(garment: Garment) -> int:
    """Number of distances from which geodesic weights are made: between all faces, or of `PooledGeodesics`."""
    count = len(garment.faces)
    return CENTRES**2 + 2 * NEAR * count if garment.pools else count**2
