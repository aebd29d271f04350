"""The `Architecture` of LayersNet.

Number of operations, for V vertices, P patches, B' other tokens, T = P + B' tokens of width D, feed-forward width F,
decoder width G, heads of width w, K world and M mesh edges of a patch. Searches and softmax are not counted.

    encoders         2 T D^2 + 2 D (12 P + 12 B')      and receivers and senders 4 P D^2 + 4 T D^2
    block            2 D^2 (3 P + T) + 2 D^2 (P + T) + 2 P D^2 + 4 T D F
      edges          6 P D (K + M)                     score and sum
      turned values  2 * 4 P 18 H_w w^2                 to the basis, layer, and back
    decoder          2 V' (12 + 2 D + G + 3) G         V' about 1.2 V + P pairs of a vertex and a patch
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from warpgarment.nn.architecture import Architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import NetworkSizes
from warpgarment.nn.network import GarmentNetwork
from warpgarment.objects.garment import Garment

from .cloth import ClothPatches, cloth_patches
from .config import BODY, VERTEX_PATCHES, LayersNetConfig
from .network import LayersLayout, LayersNet

PRESETS = {"layersnet": LayersNetConfig(), "layersnet-paper": LayersNetConfig.paper()}
DECODED = 1.1  # patches against which a vertex is decoded on average
MESH, PADDED_MESH = 12, 18  # mesh edges of a patch, and with padding
WORLD = 11  # world edges and body vertices that a patch sees
BODIES = 6  # body vertices that are seen, for each patch
PER_VERTEX = 200  # bytes of memberships and of the heading


class Layers(Architecture):
    """Garments of an outfit see each other; there are no rows."""

    config = LayersNetConfig
    presets = PRESETS
    subsets = False
    positions = True

    def build(self, config: NetworkConfig) -> GarmentNetwork:
        """An untrained `LayersNet`."""
        assert isinstance(config, LayersNetConfig)
        return LayersNet(config)

    def geometry(self, garment: Garment, config: NetworkConfig) -> ClothPatches:
        """The garment's patches."""
        assert isinstance(config, LayersNetConfig)
        return cloth_patches(garment, config.patch_spacing, config.patches)

    def patch_means(self, layout: LayersLayout, positions: torch.Tensor) -> torch.Tensor:
        """Means over the vertices of each patch, [V,3] -> [P,3]."""
        return layout.cloth.means(positions)

    def memory(self, sizes: NetworkSizes, config: NetworkConfig) -> dict[str, int]:
        """Bytes of the patches and of a call, in which the edges of a block or the decoder are largest."""
        assert isinstance(config, LayersNetConfig)
        patches = sum(self.geometry(garment, config).patches for garment in sizes.garments)
        vertices = sum(len(garment.vertices) for garment in sizes.garments)
        width, half = config.embedding, config.embedding // 2  # about half of the heads see the world
        if sizes.cpu:  # only what there is
            bodies, mesh, world, pairs = min(sizes.body_vertices, int(BODIES * patches)), MESH, WORLD, DECODED
        else:
            bodies, mesh, world, pairs = (
                sizes.body_vertices,
                PADDED_MESH,
                config.patch_neighbours + BODY,
                VERTEX_PATCHES,
            )
        tokens = patches + bodies + 2 * len(sizes.garments)
        edges = patches * half * max(8 * (world + 2), 6 * mesh)
        block = 6 * tokens * width + max(edges, 2 * tokens * config.feed_forward)
        decoder = int(pairs * vertices + patches) * 7 * max(width, config.decoder)
        return {"patches": PER_VERTEX * vertices + 4 * mesh * patches, "network": 4 * max(block, decoder)}

    def flops(self, config: NetworkConfig, faces: int, components: int, rows: Any) -> tuple[int, int]:
        """Operations for one outfit.

        Args:
            config: Settings of the network.
            faces: Number of faces, from which the number of vertices follows.
            components: Number of garments.
            rows: Number of patches, an integer; None for one to ten vertices.
        """
        assert isinstance(config, LayersNetConfig)
        vertices = faces // 2
        patches = max(vertices // 10, 1) if rows is None else int(rows)
        width, bodies = config.embedding, 4 * patches
        tokens = patches + bodies + 2 * components + 1
        start = 2 * tokens * width**2 + 4 * (patches + tokens) * width**2
        block = 2 * width**2 * (4 * patches + 2 * tokens + patches) + 4 * tokens * width * config.feed_forward
        block += 6 * patches * width * (config.patch_neighbours + BODY + 2 + MESH)
        block += 8 * patches * (BODY + 2) * config.world_heads * config.head_width**2
        pairs = int(DECODED * vertices) + patches
        decoder = 2 * pairs * (2 * width + config.decoder + 3) * config.decoder
        return start + config.layers * block + decoder, 24 * (tokens + pairs) * width

    def sampled(self, geometry: Any, config: NetworkConfig, device: torch.device) -> Any:
        """The geometry as it is."""
        return geometry

    def rows(
        self,
        shown: Sequence[tuple[Any, np.ndarray | None]],
        config: NetworkConfig,
        device: torch.device,
        scale: Sequence[float] | np.ndarray | None = None,
    ) -> Any:
        """None: outfits are packed, not padded."""
        return None
