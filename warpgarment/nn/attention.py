"""Manifold-aware self-attention (section 4.3, equation 1) and the encoder layer around it.

Of `heads` heads, the last `manifold_heads` do not compare queries with keys: their attention matrix is fixed,

    A = softmax(-(D/r)^p)        D geodesic distances between face centroids, r radius, p power

so a face attends to the faces near it *on the cloth*, whatever lies near it in space. The other heads are ordinary.

Tokens are N faces followed by C velocity tokens. In a manifold head faces attend to faces, a velocity token to itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import nn

# CPU libraries add a product of more columns up in another order, so that a garment in a batch would differ from the
# same garment alone. With more faces than `ALIKE`, the larger product is so much faster that it is taken anyway.
COLUMNS, ALIKE = 128, 2048
ALIKE_ON = frozenset({"cpu"})  # kinds of devices on which a garment in a batch gets the bits that it gets alone

ACTIVATIONS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {"relu": F.relu, "gelu": F.gelu}


class Spreading(Protocol):
    """Weights [R,N,N] that are not kept as a matrix, see `faces.layout.PooledWeights`."""

    @property
    def faces(self) -> int:
        """Number of faces N."""

    def spread(self, value: torch.Tensor) -> torch.Tensor:
        """Weights times values, [R,N,K] -> [R,N,K]; weights of one row apply to all rows of values."""


def geodesic_weights(distances: torch.Tensor, radius: float, power: float) -> torch.Tensor:
    """Attention weights of the manifold heads, softmax(-(D/r)^p) along rows (equation 1).

    Args:
        distances: Geodesic distances between face centroids [m], shape [...,N,N]; inf between components.
        radius: r [m]. A large power makes the weights a ball of this radius, a small one a smooth decay.
        power: p, without unit.

    Returns:
        Weights, shape [...,N,N], finite. Rows sum to one; a row whose distances are all inf (padding) is zero.
    """
    score = -((distances / radius) ** power)  # may overflow to -inf, whose weight is correctly 0
    score = torch.where(torch.isinf(distances), -math.inf, score)  # inf ** power is 1 for a power that rounds to 0
    highest = score.amax(dim=-1, keepdim=True)
    weight = torch.exp(score - torch.where(torch.isinf(highest), 0.0, highest))
    return weight / weight.sum(dim=-1, keepdim=True).clamp(min=torch.finfo(weight.dtype).tiny)


class ManifoldAwareAttention(nn.Module):
    """Multi-head self-attention, some of whose heads use fixed geodesic weights.

    Queries, keys, values and the output have projections for all heads, as in the paper's count of parameters. The rows
    of `qkv` for queries and keys of the manifold heads come first and are not used, since these heads compare nothing.

    Args:
        embedding: Width of a token.
        heads: Number of heads; divides `embedding`.
        manifold_heads: Number of heads that use the geodesic weights.
        dropout: Dropout rate of the learned attention weights.
    """

    def __init__(self, embedding: int, heads: int, manifold_heads: int, dropout: float) -> None:
        super().__init__()
        self.heads, self.manifold_heads, self.dropout = heads, manifold_heads, dropout
        self.head_width = embedding // heads
        self.qkv = nn.Linear(embedding, 3 * embedding)
        self.out = nn.Linear(embedding, embedding)
        nn.init.xavier_uniform_(self.qkv.weight)
        nn.init.zeros_(self.qkv.bias)
        nn.init.zeros_(self.out.bias)

    def forward(
        self, x: torch.Tensor, weights: torch.Tensor | Spreading, key_mask: torch.Tensor | None
    ) -> torch.Tensor:
        """Applies the attention to tokens.

        Args:
            x: Tokens, shape [B,T,E], faces first.
            weights: Geodesic weights, shape [B,N,N], or [1,N,N] if the whole batch is one garment; or a `Spreading`.
            key_mask: True where a token is real, shape [B,1,1,T]; None where all are.

        Returns:
            Tokens, shape [B,T,E].
        """
        batch, tokens, embedding = x.shape
        width_manifold = self.manifold_heads * self.head_width
        width_learned = embedding - width_manifold
        unused = 2 * width_manifold
        projected = F.linear(x, self.qkv.weight[unused:], self.qkv.bias[unused:])
        query, key, value = projected.split([width_learned, width_learned, embedding], dim=-1)

        outputs = []
        if width_learned:
            query, key, learned_value = (
                part.reshape(batch, tokens, -1, self.head_width).transpose(1, 2)
                for part in (query, key, value[..., :width_learned])
            )
            dropout = self.dropout if self.training else 0.0
            learned = F.scaled_dot_product_attention(query, key, learned_value, attn_mask=key_mask, dropout_p=dropout)
            outputs.append(learned.transpose(1, 2).reshape(batch, tokens, width_learned))
        if width_manifold:
            outputs.append(_spread(weights, value[..., width_learned:]))
        return self.out(outputs[0] if len(outputs) == 1 else torch.cat(outputs, dim=-1))


def _spread(weights: torch.Tensor | Spreading, value: torch.Tensor) -> torch.Tensor:
    """Weights times the values of faces; values of velocity tokens are kept. [B,N,N], [B,T,K] -> [B,T,K].

    All manifold heads share their weights, so one product serves them all, and also a batch of one garment. On a CPU
    without gradients, there is one product for every `COLUMNS` values of a face.
    """
    if not isinstance(weights, torch.Tensor):
        return torch.cat([weights.spread(value[:, : weights.faces]), value[:, weights.faces :]], dim=1)
    faces = weights.shape[-1]
    face_value, velocity_value = value[:, :faces], value[:, faces:]
    if weights.shape[0] == 1 and value.shape[0] > 1:
        batch, _, width = face_value.shape
        together = batch
        if value.device.type in ALIKE_ON and not torch.is_grad_enabled() and faces <= ALIKE:
            together = max(1, COLUMNS // width)
        parts = []
        for some in face_value.split(together):
            flat = some.transpose(0, 1).reshape(faces, len(some) * width)
            parts.append((weights[0] @ flat).reshape(faces, len(some), width).transpose(0, 1))
        spread = torch.cat(parts) if len(parts) > 1 else parts[0]
    else:
        spread = torch.bmm(weights, face_value)
    return torch.cat([spread, velocity_value], dim=1)


class EncoderLayer(nn.Module):
    """One transformer encoder layer: attention and feed-forward, normalised before (pre-norm) or after (post-norm).

    Args:
        embedding: Width of a token.
        feed_forward: Width of the feed-forward layer.
        heads: Number of heads.
        manifold_heads: Number of heads that use the geodesic weights.
        dropout: Dropout rate in training.
        norm_first: Whether to normalise before each sublayer (pre-norm), not after it (post-norm).
        activation: "relu" or "gelu".
    """

    def __init__(
        self,
        embedding: int,
        feed_forward: int,
        heads: int,
        manifold_heads: int,
        *,
        dropout: float,
        norm_first: bool,
        activation: str,
    ) -> None:
        super().__init__()
        self.attention = ManifoldAwareAttention(embedding, heads, manifold_heads, dropout)
        self.expand = nn.Linear(embedding, feed_forward)
        self.contract = nn.Linear(feed_forward, embedding)
        self.attention_norm = nn.LayerNorm(embedding)
        self.feed_forward_norm = nn.LayerNorm(embedding)
        self.dropout = nn.Dropout(dropout)
        self.norm_first = norm_first
        self.activation = ACTIVATIONS[activation]

    def forward(
        self, x: torch.Tensor, weights: torch.Tensor | Spreading, key_mask: torch.Tensor | None
    ) -> torch.Tensor:
        """Tokens [B,T,E] -> tokens [B,T,E]; the other arguments as in `ManifoldAwareAttention.forward`."""
        if self.norm_first:
            x = x + self.dropout(self.attention(self.attention_norm(x), weights, key_mask))
            return x + self._feed_forward(self.feed_forward_norm(x))
        x = self.attention_norm(x + self.dropout(self.attention(x, weights, key_mask)))
        return self.feed_forward_norm(x + self._feed_forward(x))

    def _feed_forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.dropout(self.contract(self.dropout(self.activation(self.expand(x)))))


def one_by_one(layer: nn.Linear, tokens: torch.Tensor) -> torch.Tensor:
    """A linear layer over velocity tokens, such that a garment's result does not depend on the others in the batch.

    Matrix libraries have another kernel for a single row than for several, which adds in another order. A garment of
    one piece has one velocity token: alone and in a batch its results would differ in the last bit. So on a CPU, where
    no gradients are asked for, the layer is applied to one token after another.

    Args:
        layer: The layer, from I to O values.
        tokens: Shape [R,C,I].

    Returns:
        Shape [R,C,O].
    """
    if tokens.device.type not in ALIKE_ON or torch.is_grad_enabled() or tokens.shape[0] * tokens.shape[1] == 1:
        result: torch.Tensor = layer(tokens)
        return result
    rows = [layer(row) for row in tokens.reshape(-1, 1, 1, tokens.shape[-1])]
    return torch.cat(rows).reshape(*tokens.shape[:-1], -1)
