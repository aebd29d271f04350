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

from .config import LayersNetConfig
from .turns import Bases, turned

TURNED = ("body", "wind", "gravity")  # senders with a direction, each with layers of its own
SHORTEST = 1e-6  # added to |r - s|^2


class Links(NamedTuple):
    """Pairs of a patch that sees and a token that is seen, E of them, out of a table of P x K."""

    patch: torch.Tensor  # int64 [E]
    token: torch.Tensor  # int64 [E]; tokens are numbered with the patches first
    place: torch.Tensor  # int64 [E], patch * K + column
    real: torch.Tensor | None  # bool [E], whether there is such a token; None if all are
    columns: int  # K


class Edges(NamedTuple):
    """What the patches see."""

    world: Links  # patches that world edges join, then body vertices, wind, gravity
    counts: tuple[int, ...]  # number of links of each of these four
    rotation: torch.Tensor  # [E',3,3], R of those after the patches
    mesh: Links  # mesh patches and the tokens of attributes


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
        self.bases = Bases(heads, head, config.rotation)  # one for each head, so that it turns as one space
        self.turned_weight = nn.Parameter(torch.randn(len(TURNED), heads, head, head) / head**0.5)
        self.turned_bias = nn.Parameter(torch.zeros(len(TURNED), heads, head))
        self.gain, self.offset = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))
        self.out = nn.Linear(width, width)
        self.attention_norm, self.feed_forward_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.expand, self.contract = nn.Linear(width, config.feed_forward), nn.Linear(config.feed_forward, width)

    def forward(self, tokens: Tokens, edges: Edges, *, last: bool = False) -> Tokens:
        """The tokens after the block; with `last` only those of patches, as nothing reads the others then."""
        value, patches = tokens.value, len(tokens.receiver)
        query = self.query(value[:patches])
        receiver = self.receive(value[:patches]) + self.remember(tokens.receiver) + tokens.receiver
        sender = self.send(value) + self.remember(tokens.sender) + tokens.sender

        wide = self.world * self.head
        world = self._seen(query[:, :wide], receiver[:, :wide], sender[:, :wide], edges.world, edges)
        mesh = self._seen(query[:, wide:], receiver[:, wide:], sender[:, wide:], edges.mesh, None)
        seen = torch.cat([world, mesh], dim=1)
        update = self.out(self.gain * seen + self.offset)
        update = value[:patches] + update
        value = self.attention_norm(update if last else torch.cat([update, value[patches:]]))
        value = self.feed_forward_norm(value + self.contract(torch.relu(self.expand(value))))
        return Tokens(value, receiver, sender)

    def _seen(
        self, q: torch.Tensor, r: torch.Tensor, s: torch.Tensor, links: Links, directed: Edges | None
    ) -> torch.Tensor:
        """What some heads see.

        Args:
            q, r: Queries and receivers of patches, shape [P,H*w].
            s: Senders, shape [T,H*w].
            links: Who sees whom.
            directed: The edges whose last links have a rotation; None if none has.

        Returns:
            Sums over the senders, shape [P,H*w].
        """
        patches, head = len(q), self.head
        receiver, sender = r.index_select(0, links.patch), s.index_select(0, links.token)
        near = ((receiver - sender).square().unflatten(1, (-1, head)).sum(-1) + SHORTEST).rsqrt()  # [E,H]
        both = receiver + sender
        score = (q.index_select(0, links.patch) * both).unflatten(1, (-1, head)).sum(-1) * near * (2.0 / head**0.5)
        if links.real is not None:
            score = score.masked_fill(~links.real[:, None], -torch.inf)
        table = score.new_full((patches * links.columns, score.shape[1]), -torch.inf)
        table = table.index_copy(0, links.place, score).view(patches, links.columns, -1).softmax(dim=1)
        share = table.flatten(0, 1).index_select(0, links.place)
        if directed is None:
            seen = both * (share * near).repeat_interleave(head, dim=1)
        else:
            plain = directed.counts[0]
            weight = torch.cat([share[:plain] * near[:plain], share[plain:]]).repeat_interleave(head, dim=1)
            values = both[plain:] * near[plain:].repeat_interleave(head, dim=1)
            turned_ones = self.turned_values(values, directed.rotation, directed.counts[1:])
            seen = torch.cat([both[:plain], turned_ones.to(both.dtype)]) * weight
        return torch.zeros_like(q, dtype=seen.dtype).index_add(0, links.patch, seen)

    def turned_values(self, values: torch.Tensor, rotation: torch.Tensor, counts: tuple[int, ...]) -> torch.Tensor:
        """R_h^T relu(L (R_h f)) of the senders with a direction.

        Args:
            values: f of body vertices, wind and gravity, one after the other, shape [E',H*w].
            rotation: Their rotations R, shape [E',3,3].
            counts: Number of each of the three kinds.
        """
        basis = self.bases.matrix(self.bases())
        triples = self.world * self.bases.triples
        found = []
        for kind, (f, turn) in enumerate(zip(values.split(counts), rotation.split(counts), strict=True)):
            layer = torch.block_diag(*self.turned_weight[kind]) @ basis  # the basis and the layer are one product
            inner = turned(f @ basis.to(f.dtype), turn, triples)
            hidden = torch.relu(inner @ layer.mT.to(f.dtype) + self.turned_bias[kind].flatten())
            back = turned(hidden @ basis.to(hidden.dtype), turn, triples, inverse=True)
            found.append(back @ basis.mT.to(back.dtype))
        return torch.cat(found)
