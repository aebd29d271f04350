"""The manifold-aware transformer (section 4.3; supplement, section 4).

    face features [N, H*34]  -> linear -> N tokens --+                       +-> linear -> Psi (9), Sigma (3) per face
                                                     +-> encoder layers -----+
    velocities [C, (H-1)*3]  -> linear -> C tokens --+   (attention.py)      +-> linear -> q (3) per component

History is oldest first: feature k of K in frame h is number h*K + k, and h = H-1 is the newest. There is no positional
encoding: the features of a face include its position. The code shared with other networks is in `nn/network.py`.
"""

from __future__ import annotations

import torch
from torch import nn

from warpgarment.nn.attention import one_by_one
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import NormalisedOutput
from warpgarment.nn.network import GarmentNetwork

from .layout import PooledWeights


class ManifoldAwareTransformer(GarmentNetwork):
    """The paper's network: every face is a token.

    Args:
        config: Shape and settings; `NetworkConfig.base()` and `.small()` are named ones.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.embed_faces = nn.Linear(config.inputs, config.embedding)
        self.embed_velocity = nn.Linear((config.history - 1) * 3, config.embedding)
        self.layers = self.encoder_layers()
        self.final_norm = nn.LayerNorm(config.embedding) if config.norm_first else nn.Identity()
        self.face_head = nn.Linear(config.embedding, 12)
        self.velocity_head = nn.Linear(config.embedding, 3)
        self.start_like_skin()

    def forward_normalised(
        self,
        x: torch.Tensor,
        v: torch.Tensor,
        rows: torch.Tensor | PooledWeights,
        *,
        face_mask: torch.Tensor | None = None,
        component_mask: torch.Tensor | None = None,
    ) -> NormalisedOutput:
        """The transformer. `rows` are geodesic weights, zero in padded columns."""
        key_mask = None
        if face_mask is not None or component_mask is not None:
            if face_mask is None:
                face_mask = torch.ones(x.shape[:2], dtype=torch.bool, device=x.device)
            if component_mask is None:
                component_mask = torch.ones(v.shape[:2], dtype=torch.bool, device=x.device)
            x = torch.where(face_mask[..., None], x, 0.0)  # values of padding, even NaN, must not spread
            v = torch.where(component_mask[..., None], v, 0.0)
            key_mask = torch.cat([face_mask, component_mask], dim=1)[:, None, None, :]
        faces, kind = x.shape[1], x.device.type
        half = torch.is_autocast_enabled(kind)
        with torch.autocast(kind, enabled=False):  # velocities are differences of frames that bfloat16 would round away
            tokens = torch.cat([self.embed_faces(x), one_by_one(self.embed_velocity, v)], dim=1)
        # cast once here, not in every layer, under autocast to half precision
        weights = rows.to(torch.get_autocast_dtype(kind) if half else tokens.dtype)
        for layer in self.layers:
            tokens = layer(tokens, weights, key_mask)
        with torch.autocast(kind, enabled=False):
            tokens = self.final_norm(tokens.to(self.face_head.weight.dtype))
            psi, singular_values = self.face_head(tokens[:, :faces]).split([9, 3], dim=-1)
            return NormalisedOutput(psi, singular_values, one_by_one(self.velocity_head, tokens[:, faces:]))
