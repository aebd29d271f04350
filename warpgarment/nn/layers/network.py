"""LayersNet: patches of all garments of an outfit attend to each other, to the body, to wind, gravity and their cloth.

Towards Multi-Layered 3D Garments Animation (Shao, Loy and Dai 2023). A frame is

    states, directions, descriptors     inputs.py
    patches                             means over their vertices (cloth.py)
    edges                               mesh edges; patches and body vertices within a radius, by a hash grid
    tokens                              encoders of two layers; receivers and senders from these
    blocks                              block.py
    decoder                             accelerations of vertices, each against up to four patches
    positions                           inputs.py

Everything is packed, not padded: garments and outfits of any sizes share a call. The paper's form and what differs from
it is in docs/layersnet.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import nn

from warpgarment.kernels.features.outdoor import ATTRIBUTES
from warpgarment.kernels.neighbours import NearestPoints
from warpgarment.nn.inputs import FrameInputs, VertexStep
from warpgarment.nn.network import GarmentNetwork
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

from .block import Block, Edges, Links, Tokens
from .cloth import ClothLayout, cloth_layout, cloth_patches
from .config import BODY, VERTEX_PATCHES, LayersNetConfig
from .inputs import Seen, acceleration, moved, positions, seen
from .turns import Bases, frames, turned

STATE, ABOUT, GRAVITY, WIND = 12, 6, 6, 22
KINDS = ("state", "attributes", "wind", "gravity")  # of tokens, in their order: patches and body vertices are "state"
READS = frozenset({"previous", "materials", "wind"})
WAITS = ("cpu",)  # devices on which the number of real entries of a table is read; a GPU would have to be waited for
STATISTICS = {"state_mean": STATE, "state_std": STATE, "acceleration_mean": 3, "acceleration_std": 3}
STATISTICS_ABOUT = STATISTICS | {"offset_mean": ABOUT, "offset_std": ABOUT}  # with `carried_by="body"`


class LayersLayout(NamedTuple):
    """The constants of a batch."""

    cloth: ClothLayout
    search: NearestPoints


class Decoded(NamedTuple):
    """What the network predicts for a frame."""

    seen: Seen
    vertices: torch.Tensor  # [V,3] accelerations in the frame of the outfit [m/frame^2]
    patches: torch.Tensor  # [P,3] those of patches, with no part relative to the patch


class LayersNet(GarmentNetwork):
    """Predicts where the vertices of layered garments are in the next frame.

    Args:
        config: Settings of the network.
    """

    config: LayersNetConfig

    offset_mean: torch.Tensor
    offset_std: torch.Tensor
    state_mean: torch.Tensor
    state_std: torch.Tensor
    acceleration_mean: torch.Tensor
    acceleration_std: torch.Tensor

    def __init__(self, config: LayersNetConfig) -> None:
        about = config.carried_by == "body"
        self.reads = READS | {"skin"} if about else READS
        self.statistics = STATISTICS_ABOUT if about else STATISTICS
        super().__init__(config)
        width, state = config.embedding, STATE + ABOUT * about
        self.state = state  # numbers of the state of a garment or body
        sizes = (state, len(ATTRIBUTES), WIND, GRAVITY)
        self.encoders = nn.ModuleDict(
            {
                kind: nn.Sequential(nn.Linear(size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
                for kind, size in zip(KINDS, sizes, strict=True)
            }
        )
        self.receiver = _start(width)
        self.senders = nn.ModuleDict({kind: _start(width) for kind in KINDS})
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.layers))
        self.bases = Bases(config.heads, config.head_width, config.rotation)
        hidden = config.decoder
        self.decoder = nn.Sequential(
            nn.Linear(state + 2 * width, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 3)
        )
        if config.residual:  # untrained, cloth goes to its base
            last = cast(nn.Linear, self.decoder[-1])
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def layout(self, garments: Sequence[Garment], packed: PackedGarments, *, face_splits: int = 1) -> LayersLayout:
        """The patches of a batch, and its hash grid; `face_splits` has no effect."""
        patches = [cloth_patches(garment, self.config.patch_spacing, self.config.patches) for garment in garments]
        device = packed.faces.device
        return LayersLayout(cloth_layout(patches, device), NearestPoints(device))

    def predict(self, inputs: FrameInputs, layout: LayersLayout, *, bfloat16: bool = False) -> VertexStep:
        """Positions at t+1; see `GarmentNetwork.predict`. The features are not read."""
        decoded, cloth = self.decoded(inputs, layout, bfloat16=bfloat16), layout.cloth
        view = decoded.seen
        outfit = view.outfit_of_garment[cloth.garment_of_patch]
        patches = moved(cloth.means(view.base), decoded.patches, view.heading[outfit])
        return VertexStep(positions(view, decoded.vertices), patches)

    def decoded(self, inputs: FrameInputs, layout: LayersLayout, *, bfloat16: bool = False) -> Decoded:
        """Accelerations of vertices and of patches; the arguments are those of `predict`."""
        cloth = layout.cloth
        kind = inputs.vertices.device.type
        with torch.autocast(kind, enabled=False):
            view = self._seen(inputs, cloth)
            patch_state = cloth.means(view.vertices)
            nearest, edges, body = self._edges(view, patch_state, layout)
            state = self._normalised(view.vertices, view.offsets)
            patch = self._normalised(patch_state, cloth.means(view.offsets))
            body_state = (view.body[body] - self.state_mean) / self.state_std
            body_state = nn.functional.pad(body_state, (0, self.state - STATE))  # a body is at no offset from itself
            pull = (view.gravity - self.acceleration_mean) / self.acceleration_std
        with torch.autocast(kind, dtype=torch.bfloat16, enabled=bfloat16):
            encoded = [
                self.encoders["state"](torch.cat([patch, body_state])),
                self.encoders["attributes"](torch.nan_to_num(view.attributes)),
                self.encoders["wind"](view.wind.flatten(1)),
                self.encoders["gravity"](pull.flatten(1)),
            ]
            sent = [self.senders[name](part) for name, part in zip(KINDS, encoded, strict=True)]
            values = torch.cat(encoded)
            tokens = Tokens(values, self.receiver(values[: cloth.patches]), torch.cat(sent))
            for number, block in enumerate(self.blocks, 1):
                tokens = block(tokens, edges, last=number == len(self.blocks))
            received = tokens.value
            body_token = encoded[0][cloth.patches :]
        with torch.autocast(kind, enabled=False):
            return self._decode(
                view, cloth, state, patch, received.to(state.dtype), body_token.to(state.dtype), nearest
            )

    def observed(self, inputs: FrameInputs, layout: LayersLayout, after: torch.Tensor) -> dict[str, torch.Tensor]:
        """States of garments and bodies together, and accelerations; see `GarmentNetwork.observed`."""
        view = self._seen(inputs, layout.cloth)
        found = {"state": torch.cat([view.vertices, view.body]), "acceleration": acceleration(view, after)}
        return found | ({"offset": view.offsets} if self.config.carried_by == "body" else {})

    def _seen(self, inputs: FrameInputs, cloth: ClothLayout) -> Seen:
        config = self.config
        return seen(
            inputs, cloth, fps=config.fps, canonical=config.heading == "canonical", carried_by=config.carried_by
        )

    def _normalised(self, state: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        """States [N,12] and offsets [N,6] or [N,0], in units of zero mean and unit variance, side by side."""
        state = (state - self.state_mean) / self.state_std
        if not offset.shape[1]:
            return state
        return torch.cat([state, (offset - self.offset_mean) / self.offset_std], dim=1)

    def _edges(
        self, view: Seen, patch_state: torch.Tensor, layout: LayersLayout
    ) -> tuple[_NearestBody, Edges, torch.Tensor]:
        """Nearest body vertices, edges between tokens, and which body vertices [U'] are tokens."""
        config, cloth = self.config, layout.cloth
        outfit = view.outfit_of_garment[cloth.garment_of_patch]
        owner, places = outfit.int(), patch_state[:, :3].float().contiguous()
        body, body_owner = view.body[:, :3].float().contiguous(), view.outfit_of_body.int()
        plain = layout.search(
            places, owner, places, owner, radius=config.patch_radius, count=config.patch_neighbours, skip=cloth.mesh
        ).long()
        near = layout.search(places, owner, body, body_owner, radius=config.body_radius, count=BODY).long()
        points = view.vertices[:, :3].float().contiguous()
        of_vertex = layout.search(
            points, view.outfit_of_vertex.int(), body, body_owner, radius=config.body_radius, count=1
        )[:, 0].long()

        used, near, of_vertex = _used(near, of_vertex, len(body))
        patches, garments = cloth.patches, len(view.outfit_of_garment)
        attributes = patches + len(used)
        wind, gravity = attributes + garments, attributes + 2 * garments
        mine = cloth.garment_of_patch
        known = torch.isfinite(view.attributes).all(dim=1)[mine]
        mesh = torch.cat([cloth.mesh.long(), torch.where(known, attributes + mine, -1)[:, None]], dim=1)
        tables = [plain, torch.where(near < 0, -1, near + patches), (wind + mine)[:, None], (gravity + outfit)[:, None]]
        world, counts = _links(tables)
        turn = frames(view.normals[used])
        beside = (world.token[counts[0] : counts[0] + counts[1]] - patches).clamp(min=0)
        around = torch.cat(
            [
                turn.index_select(0, beside),
                frames(view.air).index_select(0, mine),
                frames(view.gravity[:, 0], -1.0).index_select(0, outfit),
            ]
        )
        return _NearestBody(of_vertex, near[:, 0], turn), Edges(world, counts, around, _links([mesh])[0]), used

    def _decode(
        self,
        view: Seen,
        cloth: ClothLayout,
        state: torch.Tensor,
        patch: torch.Tensor,
        received: torch.Tensor,
        body_token: torch.Tensor,
        nearest: _NearestBody,
    ) -> Decoded:
        """Accelerations from the state after the blocks; `received` [P,D] and `body_token` [U',D] are tokens."""
        basis = self.bases.matrix(self.bases())
        triples = self.config.heads * self.bases.triples
        of_patch, of_body = received @ basis, body_token @ basis
        chosen = self._patches_of_vertices(state, patch, cloth)
        vertex, slot = _real(chosen)
        which = chosen[vertex, slot].clamp(min=0)
        relative = torch.cat([state[vertex] - patch[which], torch.zeros_like(patch)])
        which = torch.cat([which, torch.arange(len(patch), device=patch.device)])
        point = torch.cat([nearest.of_vertex[vertex], nearest.of_patch])

        there, point = (point >= 0)[:, None], point.clamp(min=0)
        eye = torch.eye(3, dtype=state.dtype, device=state.device)
        if len(body_token):
            turn = torch.where(there[..., None], nearest.rotation.index_select(0, point), eye)
            beneath = torch.where(there, of_body.index_select(0, point), 0.0)
        else:
            turn, beneath = eye.expand(len(point), 3, 3), of_patch.new_zeros((len(point), of_patch.shape[1]))
        # the basis and the first layer are one product: W (Q R Q^T e) = (W Q) (R Q^T e)
        first = cast(nn.Linear, self.decoder[0])
        own, patches, bodies = first.weight.split([self.state, *2 * [received.shape[1]]], dim=1)
        relative = turned(_by_axis(relative), turn, self.state // 3)
        hidden = torch.nn.functional.linear(relative, _by_axis(own), first.bias)
        for part, weight in ((of_patch.index_select(0, which), patches), (beneath, bodies)):
            hidden = hidden + turned(part, turn, triples) @ (weight @ basis).mT
        answer = turned(self.decoder[1:](hidden), turn, 1, inverse=True)
        answer = answer * self.acceleration_std + self.acceleration_mean

        weight = (chosen >= 0).to(state.dtype)
        weight = (weight / weight.sum(dim=1, keepdim=True))[vertex, slot]
        mean = torch.zeros_like(state[:, :3]).index_add(0, vertex, answer[: len(vertex)] * weight[:, None])
        return Decoded(view, mean, answer[len(vertex) :])

    def _patches_of_vertices(self, state: torch.Tensor, patch: torch.Tensor, cloth: ClothLayout) -> torch.Tensor:
        """Patches against which each vertex is decoded, int64 [V,4], -1 where there is none: its own, and the nearest
        three of those mesh neighbours of it whose centre is nearer."""
        scale = self.state_std[:3]
        near = cloth.mesh[cloth.own].long()  # [V,M]
        with torch.no_grad():
            away = (patch[near.clamp(min=0), :3] - state[:, None, :3]) * scale
            distance = away.square().sum(-1)
            own = ((patch[cloth.own, :3] - state[:, :3]) * scale).square().sum(-1)
            closer = (near >= 0) & (distance < own[:, None])
            distance = torch.where(closer, distance, torch.inf)
            kept = min(VERTEX_PATCHES - 1, near.shape[1])
            value, index = distance.topk(kept, dim=1, largest=False)
            others = torch.where(torch.isfinite(value), near.gather(1, index), -1)
        return torch.cat([cloth.own[:, None], others], dim=1)

    def rotation_penalty(self) -> torch.Tensor:
        """Mean of `Bases.penalty` over all bases; about zero, and without effect, if `rotation` is "orthogonal"."""
        bases = [cast(Block, block).bases for block in self.blocks] + [self.bases]
        return torch.stack([basis.penalty() for basis in bases]).mean()


class _NearestBody(NamedTuple):
    """Nearest body vertices, as numbers of body tokens; -1 where none is within the radius."""

    of_vertex: torch.Tensor  # int64 [V]
    of_patch: torch.Tensor  # int64 [P]
    rotation: torch.Tensor  # [U',3,3], R of the normals


def _start(width: int) -> nn.Sequential:
    """The layers that make receivers, or senders, of encoded tokens."""
    return nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.LayerNorm(width))


def _by_axis(states: torch.Tensor) -> torch.Tensor:
    """States [N,12] or [N,18], vectors one after the other, sorted by x, y and z as `turned` expects it."""
    return states.unflatten(1, (-1, 3)).mT.flatten(1)


def _links(tables: list[torch.Tensor]) -> tuple[Links, tuple[int, ...]]:
    """Links of the entries of tables [P,K] of tokens, table by table, and how many each has; -1 is no token.

    On a GPU, which would have to wait for the number of real entries, all are links.
    """
    columns, start = sum(table.shape[1] for table in tables), 0
    rows, tokens, places, real = [], [], [], []
    for table in tables:
        row, column = _real(table)
        token = table[row, column]
        rows.append(row)
        tokens.append(token.clamp(min=0))
        places.append(row * columns + column + start)
        real.append(token >= 0)
        start += table.shape[1]
    there = None if tables[0].device.type in WAITS else torch.cat(real)
    links = Links(torch.cat(rows), torch.cat(tokens), torch.cat(places), there, columns)
    return links, tuple(len(row) for row in rows)


def _used(near: torch.Tensor, of_vertex: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Body vertices that are seen, and the arguments as numbers of these.

    On a CPU only these become tokens, a part of the body. A GPU would have to wait for their number, and takes all.
    """
    if near.device.type not in WAITS:
        return torch.arange(count, device=near.device), near, of_vertex
    used = torch.cat([near.flatten(), of_vertex]).unique()
    used = used[used >= 0]
    number = torch.full((count + 1,), -1)  # the last is for -1
    number[used] = torch.arange(len(used))
    return used, number[near], number[of_vertex]


def _real(chosen: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns of the entries that are not -1; on a GPU, which would have to wait for their number, of all."""
    if chosen.device.type in WAITS:
        row, column = (chosen >= 0).nonzero(as_tuple=True)
        return row, column
    rows, columns = chosen.shape
    row = torch.arange(rows, device=chosen.device)[:, None].expand(rows, columns).flatten()
    return row, torch.arange(columns, device=chosen.device).repeat(rows)
