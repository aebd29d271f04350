"""A network whose cost is linear in the faces: a transformer over patches of cloth, between layers of faces.

    features [N, H*34] -> linear -> N faces -> face layer -+--------------------------> (+) -> face layers -> Psi, Sigma
                                                           v pool                       ^ spread what changed
                                                           P patches -> encoder layers -+
    velocities [C, (H-1)*3] -> linear, + linear(mean) --> C tokens  ->  (attention.py) ------------------------> q

The mean is over the patches of the piece of cloth whose velocity the token is. `layout.py` defines how faces are pooled
into patches, and how the change of the patches is spread to faces. The encoder layers are those of the manifold-aware
transformer, with geodesic distances between the centres of patches. A face layer is a small perceptron on each face.
Face layers after the patches also read the mean of the face's neighbours across the edges, so that folds much smaller
than a patch are kept. The weights of that mean start at zero, so a network may first be trained on subsets of faces,
which have no neighbours, and then on whole garments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import nn

from warpgarment.nn.attention import ACTIVATIONS, one_by_one
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import FrameInputs, NormalisedOutput, RowInputs, VertexStep
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.parametrisation import Step
from warpgarment.nn.rows import RowLayout
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

from . import blocks, first, fused, trained, trained_encoder, trained_head
from .bags import Sums, sums_of
from .layout import PatchLayout

if TYPE_CHECKING:
    from warpgarment.nn.faces.network import ManifoldAwareTransformer


class FaceLayer(nn.Module):
    """A residual perceptron on every face, normalised before.

    Args:
        embedding: Width of a face.
        feed_forward: Width of the hidden layer.
        activation: "relu" or "gelu".
        hears: Whether the hidden layer also reads the mean of the face's neighbours, with weights that start at zero.
    """

    def __init__(self, embedding: int, feed_forward: int, activation: str, hears: bool) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(embedding)
        self.expand = nn.Linear(embedding, feed_forward)
        self.contract = nn.Linear(feed_forward, embedding)
        self.activation = ACTIVATIONS[activation]
        if hears:
            self.hear = nn.Linear(embedding, feed_forward, bias=False)
            nn.init.zeros_(self.hear.weight)
        self.hears = hears

    def forward(self, x: torch.Tensor, neighbours: Sums | None) -> torch.Tensor:
        """Faces of all garments [F,E] -> [F,E]; `neighbours` is the mean over those of a face, None for subsets."""
        if trained.fits(self, x, neighbours):
            return trained.forward(self, x, neighbours)
        own = self.norm(x)
        hidden = self.expand(own)
        if self.hears:
            around = torch.zeros_like(own) if neighbours is None else neighbours(own)
            hidden = hidden + self.hear(around)
        return x + self.contract(self.activation(hidden))


class PatchTransformer(GarmentNetwork):
    """Faces are pooled into patches, which attend to each other. On a CPU without gradients it runs by blocks of faces.

    Args:
        config: Shape and settings; `NetworkConfig.fast()` is the named one.
    """

    shares_threads = True

    @property
    def launches(self) -> tuple[str, ...]:
        """As in `GarmentNetwork`, and the kernels of its layers on a processor that has vectors for them."""
        return (*super().launches, *(fused.LAUNCHED if fused.suits(self) else ()))

    @property
    def takes_frames(self) -> bool:
        """As in `GarmentNetwork`."""
        return type(self).predict is PatchTransformer.predict and "predict" not in vars(self)

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        width = config.face_embedding
        self.embed_faces = nn.Linear(config.inputs, width)
        self.embed_velocity = nn.Linear((config.history - 1) * 3, config.embedding)
        self.before = self._face_layer(hears=False)
        self.to_patches = nn.Linear(width, config.embedding)
        self.to_velocity = nn.Linear(width, config.embedding, bias=False)
        self.layers = self.encoder_layers()
        self.final_norm = nn.LayerNorm(config.embedding) if config.norm_first else nn.Identity()
        self.from_patches = nn.Linear(config.embedding, width)
        self.after = nn.ModuleList(self._face_layer(hears=True) for _ in range(config.face_layers))
        self.face_norm = nn.LayerNorm(width)
        self.face_head = nn.Linear(width, 12)
        self.velocity_head = nn.Linear(config.embedding, 3)
        self.start_like_skin()

    @classmethod
    def from_faces(cls, network: ManifoldAwareTransformer, config: NetworkConfig) -> PatchTransformer:
        """A network of patches made from a trained one of faces, as a start for further training.

        The encoder layers of the given network run on patches, their change is spread to the faces, and face layers add
        nothing yet. If every face were a patch, it would be the same network.

        Args:
            network: The network of faces, whose weights and statistics are copied.
            config: Settings of the new network, with the same widths (faces as wide as patches), layers, heads and
                history.

        Raises:
            ValueError: These settings differ (the message names them), or the network normalises after its layers.
        """
        old = network.config
        shared = ("embedding", "layers", "feed_forward", "heads", "manifold_heads", "history", "residual", "heading",
                  "norm_first", "activation")  # fmt: skip
        other = [name for name in shared if getattr(old, name) != getattr(config, name)]
        if config.face_embedding != old.embedding:
            other.append("face_embedding")
        if other:
            raise ValueError(f"a network of patches cannot start from this one of faces: {', '.join(other)} differ")
        if not old.norm_first:
            raise ValueError("a network of patches can only start from one with norm_first")
        made = cls(config)
        wanted = made.state_dict()
        made.load_state_dict(wanted | {k: v for k, v in network.state_dict().items() if k in wanted})
        made.face_norm.load_state_dict(network.final_norm.state_dict())
        for linear in (made.to_patches, made.from_patches):
            nn.init.eye_(linear.weight)
            nn.init.zeros_(linear.bias)
        nn.init.zeros_(made.to_velocity.weight)
        for layer in (made.before, *made.after):
            nn.init.zeros_(layer.contract.weight)
            nn.init.zeros_(layer.contract.bias)
        return made

    def _face_layer(self, *, hears: bool) -> FaceLayer:
        config = self.config
        return FaceLayer(config.face_embedding, config.face_feed_forward, config.activation, hears)

    def predict(self, inputs: FrameInputs, layout: RowLayout, *, bfloat16: bool = False) -> Step | VertexStep:
        """As in `GarmentNetwork`; on a CPU without gradients by few launches."""
        if not bfloat16 and blocks.by_blocks(inputs.vertices) and fused.predicts(self, layout):
            return fused.predict(self, inputs, layout)
        return super().predict(inputs, layout, bfloat16=bfloat16)

    def layout(self, garments: Sequence[Garment], packed: PackedGarments, *, face_splits: int = 1) -> RowLayout:
        """As in `GarmentNetwork`; weights that were written past torch are noticed here, once for each scene."""
        fused.look(self)
        return super().layout(garments, packed, face_splits=face_splits)

    def replayed(self, layout: RowLayout) -> object | None:
        """As in `GarmentNetwork`, where `predict` is kernels."""
        fits = self.takes_frames and layout.face_component.device.type == "cpu" and fused.predicts(self, layout)
        return fused.packed(self) if fits else None

    def embedded(
        self, face_features: torch.Tensor, turn: torch.Tensor | None, face_mask: torch.Tensor | None
    ) -> torch.Tensor:
        """The result of `embed_faces` for turned and normalised features, computed from features in world space.

        W ((G f - mean) / std) + b = (W / std) G f + (b - (W / std) mean)        G turns the features of a frame
        """
        face_features = self.read(self._without_padding(face_features, face_mask))
        if blocks.by_blocks(face_features) and fused.fits(self):
            return fused.embedded(self, face_features, turn)
        weight = self.embed_faces.weight
        if self.outdoor.width:
            weight = weight[:, : -self.outdoor.width]
        scaled = weight.unflatten(1, (-1, self.channels.width)) / self.feature_std  # [E,H,K]
        bias = self.embed_faces.bias - scaled.sum(dim=1) @ self.feature_mean
        if turn is None:
            return F.linear(face_features, scaled.flatten(1), bias)
        turned = torch.einsum("ehi,bij->behj", scaled, self.channels.turn(turn)).flatten(2)
        if blocks.by_blocks(face_features):
            return blocks.linear(face_features, turned, bias)
        if len(turned) == 1:
            return F.linear(face_features, turned[0], bias)
        return torch.baddbmm(bias, face_features, turned.mT)

    def embedded_rows(self, inputs: RowInputs, turn: torch.Tensor | None) -> torch.Tensor:
        """The same for rows that may be mirrored: first.py."""
        return first.embedded(self, inputs, turn)

    def forward_normalised(
        self,
        x: torch.Tensor,
        v: torch.Tensor,
        rows: PatchLayout,
        *,
        face_mask: torch.Tensor | None = None,
        component_mask: torch.Tensor | None = None,
    ) -> NormalisedOutput:
        """The network. `rows` assign faces to patches."""
        with torch.autocast(x.device.type, enabled=False):  # differences of frames, which bfloat16 would round away
            faces = self.embed_faces(self._without_padding(x, face_mask))
        return self.forward_embedded(faces, v, rows, face_mask=face_mask, component_mask=component_mask)

    def forward_embedded(
        self,
        embedded: torch.Tensor,
        v: torch.Tensor,
        rows: PatchLayout,
        *,
        face_mask: torch.Tensor | None = None,
        component_mask: torch.Tensor | None = None,
    ) -> NormalisedOutput:
        """The same as `forward_normalised`, from embedded faces [R,N,F]."""
        with torch.autocast(v.device.type, enabled=False):
            tokens = one_by_one(self.embed_velocity, self._without_padding(v, component_mask))
        return self._from_embeddings(embedded, tokens, rows, component_mask)

    @staticmethod
    def _without_padding(values: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
        """Values with zeros in place of padding, whose values, even NaN, must not spread."""
        return values if mask is None else torch.where(mask[..., None], values, 0.0)

    def _from_embeddings(
        self, faces: torch.Tensor, tokens: torch.Tensor, weights: PatchLayout, velocity_mask: torch.Tensor | None
    ) -> NormalisedOutput:
        """Embedded faces [B,N,F] and velocities [B,C,E] -> normalised output."""
        batch, count = faces.shape[:2]
        if blocks.by_blocks(faces):
            mask = self.key_mask(weights, velocity_mask, tokens)
            answer, velocity = blocks.forward(self, faces.contiguous(), tokens, weights, mask)
            psi, singular_values = answer.split([9, 3], dim=-1)
            return NormalisedOutput(psi, singular_values, velocity)
        sums = sums_of(weights, batch)
        faces = self.before(faces.flatten(0, 1), sums.around)
        faces, velocity = self._encoded(faces.unflatten(0, (batch, count)), tokens, weights, velocity_mask)
        for layer in self.after:
            faces = layer(faces, sums.around)
        with torch.autocast(faces.device.type, enabled=False):
            precise = self.face_head.weight.dtype
            faces = faces.to(precise)
            if trained_head.fits(self, faces):
                answer = trained_head.forward(self, faces)
            else:
                answer = self.face_head(self.face_norm(faces))
            answer = answer.unflatten(0, (batch, count))
            psi, singular_values = answer.split([9, 3], dim=-1)
            return NormalisedOutput(psi, singular_values, velocity)

    def _encoded(
        self, faces: torch.Tensor, tokens: torch.Tensor, weights: PatchLayout, velocity_mask: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Faces with what they hear of the patches, end to end [B*N,F], and normalised velocities [B,C,3]."""
        batch, patches = len(faces), weights.start.shape[1]
        mask = self.key_mask(weights, velocity_mask, tokens)
        if trained_encoder.fits(self, faces, weights):
            heard, velocity = trained_encoder.forward(self, faces, tokens, weights, mask)
            return heard.flatten(0, 1), velocity
        sums, faces = sums_of(weights, batch), faces.flatten(0, 1)
        pooled = sums.pool(faces).unflatten(0, (batch, patches))
        mean = _rows(weights.pieces, batch).to(pooled.dtype) @ pooled
        tokens = torch.cat([self.to_patches(pooled), tokens + one_by_one(self.to_velocity, mean)], dim=1)
        kind = faces.device.type
        half = torch.is_autocast_enabled(kind)
        geodesic = weights.weights.to(torch.get_autocast_dtype(kind) if half else tokens.dtype)
        before = tokens
        for layer in self.layers:
            tokens = layer(tokens, geodesic, mask)
        heard = self.from_patches((tokens - before)[:, :patches]).flatten(0, 1)
        tokens = self.final_norm(tokens)
        with torch.autocast(kind, enabled=False):
            precise = tokens[:, patches:].to(self.velocity_head.weight.dtype)
            return faces + sums.spread(heard), one_by_one(self.velocity_head, precise)

    @staticmethod
    def key_mask(weights: PatchLayout, velocity_mask: torch.Tensor | None, v: torch.Tensor) -> torch.Tensor | None:
        """True where a token is real, shape [B,1,1,P+C]; None where all are."""
        if weights.mask is None and velocity_mask is None:
            return None
        real = torch.ones((), dtype=torch.bool, device=v.device)
        patch_mask = real.expand(*weights.start.shape) if weights.mask is None else weights.mask
        velocity_mask = real.expand(*v.shape[:2]) if velocity_mask is None else velocity_mask
        return torch.cat([patch_mask.expand(len(v), -1), velocity_mask], dim=1)[:, None, None]


def _rows(values: torch.Tensor, batch: int) -> torch.Tensor:
    """Expands values of one shared row to all rows of the batch."""
    return values.expand(batch, *values.shape[1:])
