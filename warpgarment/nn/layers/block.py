r"""One block of LayersNet: attention between receivers and senders, whose tokens remember those of the block before.

Towards Multi-Layered 3D Garments Animation, section A.2 of the supplement:

    q_i = W_q v_i      r_i = W_r v_i + W_m r'_i + r'_i      s_j = W_s v_j + W_m s'_j + s'_j     (' of the block before)
    f_ij = (r_i + s_j) / |r_i - s_j|                                                            per head, of width w
    a_ij = softmax_j( 2 q_i . f_ij / sqrt(w) )
    v_i <- LN(v_i + W_o (gain * sum_j a_ij f'_ij + offset)),      v <- LN(v + feed-forward(v))

f'_ij = f_ij for patches and attributes. For a sender j with a direction (body vertex, wind, gravity) it is rotated into
the frame of that direction, goes through a layer, and is rotated back (turns.py):

    f'_ij = R_h^T relu(L (R_h f_ij))

The first `world_heads` heads have one softmax over world patches, body vertices, wind and gravity; the others over mesh
patches and attributes. Only patches receive. All other tokens pass through the layer norms and the feed-forward layer.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import nn

from .config import BODY, LayersNetConfig
from .turns import Bases, turned

TURNED = ("body", "wind", "gravity")  # senders with a direction, each with layers of its own
SHORTEST = 1e-6  # added to |r - s|^2


class Edges(NamedTuple):
    """Which tokens each of P patches sees. Tokens are numbered with the patches first; -1 where there is none."""

    plain: torch.Tensor  # int64 [P,K], patches that world edges join
    directed: torch.Tensor  # int64 [P,BODY+2], body vertices, then wind and gravity
    rotation: torch.Tensor  # [P,BODY+2,3,3], R of these senders
    mesh: torch.Tensor  # int64 [P,M], mesh patches, then the token of the garment's attributes


class Tokens(NamedTuple):
    """State of T tokens of width D, of which the first P are patches."""

    value: torch.Tensor  # [T,D]
    receiver: torch.Tensor  # [P,D]
    sender: torch.Tensor  # [T,D]


class Block(nn.Module):
    """One block.

    Args:
        config: Settings of the network.
    """

    def __init__(self, config: LayersNetConfig) -> None:
        super().__init__()
        width, head, heads = config.embedding, config.head_width, config.world_heads
        self.heads, self.world, self.head = config.heads, heads, head
        self.query, self.receive, self.send, self.remember = (nn.Linear(width, width, bias=False) for _ in range(4))
        self.bases = Bases(len(TURNED) * heads, head, config.rotation)
        self.turned_weight = nn.Parameter(torch.randn(len(TURNED), heads, head, head) / head**0.5)
        self.turned_bias = nn.Parameter(torch.zeros(len(TURNED), heads, head))
        self.gain, self.offset = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))
        self.out = nn.Linear(width, width)
        self.attention_norm, self.feed_forward_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.expand, self.contract = nn.Linear(width, config.feed_forward), nn.Linear(config.feed_forward, width)

    def forward(self, tokens: Tokens, edges: Edges) -> Tokens:
        """The tokens after the block."""
        value, patches = tokens.value, len(tokens.receiver)
        query = self.query(value[:patches])
        receiver = self.receive(value[:patches]) + self.remember(tokens.receiver) + tokens.receiver
        sender = self.send(value) + self.remember(tokens.sender) + tokens.sender

        q, r, s = (part.unflatten(-1, (self.heads, self.head)) for part in (query, receiver, sender))
        world, mesh = slice(None, self.world), slice(self.world, None)
        seen = torch.cat(
            [
                self._world(q[:, world], r[:, world], s[:, world], edges),
                self._mesh(q[:, mesh], r[:, mesh], s[:, mesh], edges.mesh),
            ],
            dim=1,
        ).flatten(1)
        update = self.out(self.gain * seen + self.offset)
        value = self.attention_norm(torch.cat([value[:patches] + update, value[patches:]]))
        value = self.feed_forward_norm(value + self.contract(torch.relu(self.expand(value))))
        return Tokens(value, receiver, sender)

    def _mesh(self, q: torch.Tensor, r: torch.Tensor, s: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
        """What the mesh heads see, [P,H,w]."""
        score, near, senders = _scores(q, r, s, seen)
        return _summed(score.softmax(dim=1) * near, r, senders)

    def _world(self, q: torch.Tensor, r: torch.Tensor, s: torch.Tensor, edges: Edges) -> torch.Tensor:
        """What the world heads see, [P,H,w]."""
        score, near, senders = _scores(q, r, s, torch.cat([edges.plain, edges.directed], dim=1))
        share, plain = score.softmax(dim=1), edges.plain.shape[1]
        values = (r[:, None] + senders[:, plain:]) * near[:, plain:, :, None]
        values = self.turned_values(values, edges.rotation)
        directed = (share[:, plain:, :, None] * values).sum(dim=1)
        return _summed(share[:, :plain] * near[:, :plain], r, senders[:, :plain]) + directed

    def turned_values(self, values: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
        """R_h^T relu(L (R_h f)) of the senders with a direction.

        Args:
            values: f of body vertices, wind and gravity, shape [P,BODY+2,H,w].
            rotation: Their rotations R, shape [P,BODY+2,3,3].
        """
        bases = self.bases().unflatten(0, (len(TURNED), self.world))  # [3,H,w,k]
        parts = values.split([BODY, 1, 1], dim=1), rotation[:, :, None].split([BODY, 1, 1], dim=1)
        found = []
        for kind, (f, turn) in enumerate(zip(*parts, strict=True)):
            basis = bases[kind]
            inner = turned(torch.einsum("pkhw,hwi->pkhi", f, basis), turn)
            layer = self.turned_weight[kind] @ basis  # the basis and the layer are one product
            hidden = torch.relu(torch.einsum("pkhi,hwi->pkhw", inner, layer) + self.turned_bias[kind])
            back = turned(torch.einsum("pkhw,hwi->pkhi", hidden, basis), turn, inverse=True)
            found.append(torch.einsum("pkhi,hwi->pkhw", back, basis))
        return torch.cat(found, dim=1)


def _scores(
    q: torch.Tensor, r: torch.Tensor, s: torch.Tensor, seen: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Scores [P,K,H] (-inf where nothing is seen), 1 / |r - s| [P,K,H], and senders [P,K,H,w]."""
    senders = s[seen.clamp(min=0)]
    near = ((r[:, None] - senders).square().sum(-1) + SHORTEST).rsqrt()
    score = (q[:, None] * (r[:, None] + senders)).sum(-1) * near * (2.0 / q.shape[-1] ** 0.5)
    return score.masked_fill((seen < 0)[..., None], -torch.inf), near, senders


def _summed(weight: torch.Tensor, r: torch.Tensor, senders: torch.Tensor) -> torch.Tensor:
    """sum_k weight_k (r + s_k): [P,K,H], [P,H,w] and [P,K,H,w] -> [P,H,w]."""
    return r * weight.sum(dim=1)[..., None] + torch.einsum("pkh,pkhw->phw", weight, senders)
