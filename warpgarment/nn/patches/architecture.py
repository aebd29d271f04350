"""The `Architecture` of networks of patches.

Number of operations, with the symbols of `nn/flops.py`, P patches, faces of width F, face layers of width G, and K face
layers after the patches: the encoder layers run on P + C tokens, and around them there are

    embedding        2 N (34 H) F + 2 C 3 (H - 1) E
    face layers      (K + 1) 4 N F G + K 2 N F G      without pooling and spreading, a few operations per number
    patches          4 P F E + 2 C P F + 2 C F E      to width E and back, and the mean of each component
    heads            2 N F 12 + 2 C E 3
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.features.channels import FEATURES, OUTDOOR
from warpgarment.nn.architecture import Architecture, GrowthError
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.grow import added
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.nn.flops import layer_flops
from warpgarment.nn.inputs import NetworkSizes
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.rows import activation_bytes, row_groups
from warpgarment.objects.garment import Garment

from . import fused
from .blocks import BLOCK
from .layout import Patches, PatchLayout, garment_patches, patch_layout
from .network import PatchTransformer

PER_PATCHED_FACE = 120  # bytes for the patches of a face, its shares in them, and its neighbours
STACKS = (1.0, 3.0)  # number of copies of the stacked features at a time, for a single garment and for several
BLOCK_TOKENS = 3.5  # number of copies of the embedded faces of a block while it is worked on
PRESETS = {"fast": NetworkConfig.fast()}


class PatchesOfCloth(Architecture):
    """Faces are pooled into patches; `rows` are a `PatchLayout`."""

    config = NetworkConfig
    presets = PRESETS
    subsets = False  # faces use their neighbours across the edges
    apart = True

    def build(self, config: NetworkConfig) -> GarmentNetwork:
        """An untrained `PatchTransformer`."""
        return PatchTransformer(config)

    def geometry(self, garment: Garment, config: NetworkConfig) -> Patches:
        """The garment's patches."""
        return garment_patches(garment, config.patch_spacing)

    def rows(
        self,
        shown: Sequence[tuple[Patches, np.ndarray | None]],
        config: NetworkConfig,
        device: torch.device,
        scale: Sequence[float] | np.ndarray | None = None,
    ) -> PatchLayout:
        """The patches of the garments, in padded rows."""
        patches = [whole if faces is None else whole.subset(faces) for whole, faces in shown]
        return patch_layout(patches, config.geodesic_radius, config.geodesic_power, device, scale)

    def memory(self, sizes: NetworkSizes, config: NetworkConfig) -> dict[str, int]:
        """Bytes of the patches of all faces, and of a call of the network."""
        garments, stack = sizes.garments, 4 * (config.history * FEATURES + OUTDOOR.width)
        stacks = (STACKS[len(garments) > 1],) * 2
        layouts, network, kernels = 0, 0, sizes.cpu and not sizes.half and fused.planned(config)
        for group in row_groups(garments, config, 1, cpu=sizes.cpu):
            length = max(count for _, _, count in group)
            shared = len({id(garments[g]) for g, _, _ in group}) == 1
            layouts += length * PER_PATCHED_FACE * (1 if shared else len(group))
            widths = config.face_embedding, config.face_feed_forward
            if sizes.cpu and not sizes.half:  # of all faces only what one layer hands to the next
                faces, block = len(group) * length * 4 * 3 * config.face_embedding, 0.0
                if kernels:  # the turned weights of the first layer
                    faces += len(group) * 4 * config.face_embedding * config.inputs
                else:
                    block = (stack + BLOCK_TOKENS * 4 * config.face_embedding) * min(length, BLOCK)
                network = max(network, faces + int(block))
                continue
            network = max(network, activation_bytes(len(group) * length, stack, stacks, *widths, sizes.half))
        packed = {"packed weights": fused.packed_bytes(config)} if kernels else {}
        return {"geodesic weights": layouts, **packed, "network": network}

    def flops(self, config: NetworkConfig, faces: int, components: int, rows: PatchLayout) -> tuple[int, int]:
        """Operations as at the top of this file."""
        e, width, patches = config.embedding, config.face_embedding, rows.start.shape[1]
        embedding = 2 * (width * faces * config.inputs + e * components * 3 * (config.history - 1))
        layers, geodesic = layer_flops(config, patches, components)
        layers += (6 * config.face_layers + 4) * faces * width * config.face_feed_forward + 4 * patches * width * e
        layers += 2 * components * width * (patches + e)
        return layers + 2 * (width * 12 * faces + e * 3 * components), embedding + geodesic

    def start_from(
        self, network: GarmentNetwork, config: NetworkConfig, *, grow: bool, seed: int = 0
    ) -> GarmentNetwork:
        """A network of patches from one of faces, by `PatchTransformer.from_faces`; any other network as it is. Both
        with the outdoor channels of `config`, at first without weight."""
        if grow:
            raise GrowthError(
                f"only networks of faces can be grown, and to a shape of faces; this shape has "
                f"architecture={config.architecture!r}, whose layers of faces have no rule for a larger one. Leave out "
                "grow to train a network further in its own shape, or grow a network of faces and start one of patches "
                "from that: init without grow, for a shape of patches with its widths"
            )
        if isinstance(network, ManifoldAwareTransformer):
            shape = dataclasses.replace(config, outdoor=network.config.outdoor)
            network = PatchTransformer.from_faces(network, shape).to(network.face_head.weight.device)
        return added(network, config.outdoor)
