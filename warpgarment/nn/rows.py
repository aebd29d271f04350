"""Arranges packed faces in padded rows for a network.

A row of a padded view is one garment, or one of its `face_splits` interleaved subsets of faces (section 4.3). Rows of
similar length share a view, so there is little padding, and a batch that repeats one garment shares geodesic weights.

On a CPU, larger garments share a view only with garments of the same mesh. Padding changes the order in which
attention adds up, hence the last bit; without it a garment in a batch moves as it does alone, bit for bit. Beyond
`SMALL` faces that costs no time, since padded rows are not computed either.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch

from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

from .architecture import architecture
from .config import NetworkConfig
from .inputs import Frames, RowInputs
from .parametrisation import NetworkOutput

TOKENS_PER_VIEW = 131_072  # most faces in one call of the network; bounds its activations to a few GB
TOKENS_ON_CPU = 32_768  # the same on a CPU, where calls that are larger gain nothing
WEIGHTS_PER_VIEW = 2**30  # most entries of geodesic weights in one call, 4 GB
TOKENS = 6.5  # vectors per token within a layer, in float32; autocast keeps 1.5 more, of half the size
PADDING = 1.25  # rows share a view if the longest has at most this many times the faces of the shortest
SMALL = 512  # most faces of a row that shares its view with others on a CPU too: calls would take longer than padding


@dataclasses.dataclass(frozen=True)
class PaddedView:
    """Some rows of a batch, padded for the network: R rows of at most N faces and C components."""

    face_index: torch.Tensor  # int64 [R,N], into the packed faces; 0 where padded
    face_mask: torch.Tensor | None  # bool [R,N]; None where nothing is padded
    component_index: torch.Tensor  # int64 [R,C], into the packed components; 0 where padded
    component_mask: torch.Tensor | None  # bool [R,C]
    weights: Any  # the result of `Architecture.rows` for R rows, or for one row that serves them all
    share: torch.Tensor  # [R], one over the number of rows of the same garment
    real_faces: torch.Tensor | None  # int64, indices of True entries of the flattened face_mask; None if it is None
    real_components: torch.Tensor | None  # int64, indices of True entries of the flattened component_mask
    begin: int | None  # first packed face, if the rows are faces that follow each other, without padding
    shared: bool = False  # whether `weights` are of one row that serves several

    @cached_property
    def index(self) -> torch.Tensor:
        """Packed face of each entry, int64 [R,N]; -1 for padding."""
        return _or_none(self.face_index, self.face_mask)

    @cached_property
    def piece(self) -> torch.Tensor:
        """Packed component of each entry, int64 [R,C]; -1 for padding."""
        return _or_none(self.component_index, self.component_mask)

    @cached_property
    def one_by_one(self) -> list[PaddedView]:
        """Views of one row each, which gets the same bits as alone: some matrix libraries add up the rows of a product
        in an order that depends on their number. Rows that are padded, or have weights of their own, stay together."""
        rows, faces = self.face_index.shape
        if not self.shared or faces <= SMALL or self.face_mask is not None or self.component_mask is not None:
            return [self]
        return [
            dataclasses.replace(
                self,
                face_index=self.face_index[r : r + 1],
                component_index=self.component_index[r : r + 1],
                share=self.share[r : r + 1],
                begin=None if self.begin is None else self.begin + r * faces,
            )
            for r in range(rows)
        ]

    def faces(self, packed: torch.Tensor | Frames) -> torch.Tensor:
        """Takes values of packed faces to rows, [F,...] -> [R,N,...]; frames side by side, [R,N,H*K]."""
        if isinstance(packed, Frames):
            return torch.cat([self.faces(frame) for frame in packed.frames], dim=-1)
        if self.begin is None:
            return packed[self.face_index]
        rows, count = self.face_index.shape
        return packed[self.begin : self.begin + rows * count].unflatten(0, (rows, count))

    def components(self, packed: torch.Tensor) -> torch.Tensor:
        """Takes values of packed components to rows, [C,...] -> [R,C,...]."""
        return packed[self.component_index]

    def inputs(
        self, features: torch.Tensor | Frames, velocities: torch.Tensor, outdoor: torch.Tensor | None = None
    ) -> RowInputs:
        """Inputs of these rows, from packed features [F,H*K], velocities [C,(H-1)*3] and outdoor channels [F,K]."""
        rows = self.faces(features), self.components(velocities)
        outside = None if outdoor is None else self.faces(outdoor)
        return RowInputs(*rows, self.weights, self.face_mask, self.component_mask, outdoor=outside)

    def add_to(self, packed: NetworkOutput, rows: NetworkOutput) -> None:
        """Writes the output of these rows into packed arrays.

        Every row of a garment predicts the velocities of its components. Their mean is added to `packed.velocity`,
        which must start at zero.
        """
        for target, values in ((packed.psi, rows.psi), (packed.singular_values, rows.singular_values)):
            index, said = _those(self.real_faces, self.face_index, values)
            target[index] = said
        self.add_velocities(packed.velocity, rows.velocity)

    def add_velocities(self, packed: torch.Tensor, rows: torch.Tensor) -> None:
        """Adds these rows' share of the velocities of components to the packed ones, [R,C,3] to [C,3]."""
        velocity = rows * self.share[:, None, None]
        packed.index_add_(0, *_those(self.real_components, self.component_index, velocity))


class RowLayout(NamedTuple):
    """The layout of a packed batch for a network that predicts face by face."""

    views: list[PaddedView]
    face_component: torch.Tensor  # int32 [F], component of each packed face
    faces: torch.Tensor  # int32 [F,3], global vertex indices
    garment_of_face: torch.Tensor  # int32 [F]


def row_layout(
    packed: PackedGarments, garments: Sequence[Garment], config: NetworkConfig, face_splits: int = 1
) -> RowLayout:
    """The `RowLayout` of a batch; the arguments are those of `padded_views`."""
    views = padded_views(packed, garments, config, face_splits)
    return RowLayout(views, packed.face_component, packed.faces, packed.garment_of_face)


def padded_views(
    packed: PackedGarments, garments: Sequence[Garment], config: NetworkConfig, face_splits: int = 1
) -> list[PaddedView]:
    """Divides a packed batch into padded views for the network.

    Args:
        packed: The batch.
        garments: The same garments, for their geodesic distances.
        config: Settings of the network.
        face_splits: Number n of disjoint subsets of each garment's faces (s, s+n, s+2n, ...), each of which the network
            sees alone. Attention costs n times less, but a face no longer attends to all others. Kinds of networks
            without `subsets` always see whole garments.
    """
    if not architecture(config.architecture).subsets:
        face_splits = 1
    groups = row_groups(garments, config, face_splits, cpu=packed.faces.device.type == "cpu")
    equal = first_equal(garments)
    return [_view(packed, garments, equal, config, face_splits, group) for group in groups]


def row_groups(
    garments: Sequence[Garment], config: NetworkConfig, face_splits: int, *, cpu: bool
) -> list[list[tuple[int, int, int]]]:
    """Groups rows that share a view, the longest first. A row is (number of its garment, first face, number of faces).

    Args:
        garments: The garments, in the order of the batch.
        config: Settings of the network.
        face_splits: Number of subsets, as in `padded_views`.
        cpu: Whether the network runs on a CPU.

    Raises:
        ValueError: `face_splits` is less than 1.
    """
    if face_splits < 1:
        raise ValueError(f"face_splits must be at least 1, got {face_splits}")
    kind = architecture(config.architecture)
    if not kind.subsets:
        face_splits = 1
    rows = []
    for number, garment in enumerate(garments):
        faces = len(garment.faces)
        rows += [(number, s, len(range(s, faces, face_splits))) for s in range(min(face_splits, faces))]
    equal, most = first_equal(garments), TOKENS_ON_CPU if cpu else TOKENS_PER_VIEW
    rows.sort(key=lambda row: (-row[2], equal[row[0]] if cpu else 0))

    groups: list[list[tuple[int, int, int]]] = []
    for row in rows:
        if groups:
            longest, together = groups[-1][0][2], len(groups[-1]) + 1
            garment, first = garments[row[0]], garments[groups[-1][0][0]]
            entries = kind.entries(garment, longest, config)
            fits = together * longest <= most and together * entries <= WEIGHTS_PER_VIEW
            alike = kind.alike(garment) == kind.alike(first)
            if cpu and longest > SMALL:
                alike = alike and equal[row[0]] == equal[groups[-1][0][0]] and longest == row[2]
            if fits and alike and longest <= PADDING * row[2]:
                groups[-1].append(row)
                continue
        groups.append([row])
    return groups


def first_equal(garments: Sequence[Garment]) -> list[int]:
    """For each garment the first one with the same mesh, as numbers in the batch."""
    first: dict[tuple[bytes, bytes], int] = {}
    meshes = ((garment.faces.tobytes(), garment.vertices.tobytes()) for garment in garments)
    return [first.setdefault(mesh, number) for number, mesh in enumerate(meshes)]


def activation_bytes(tokens: int, stack: int, stacks: tuple[float, float], width: int, hidden: int, half: bool) -> int:
    """Temporary memory [bytes] of a call of a transformer, by factors measured with torch's profiler.

    Args:
        tokens: Number of faces in the call, padded ones included.
        stack: Bytes of the stacked features of a face.
        stacks: Number of copies of the stacked features while they are prepared, and while the network runs.
        width: Width of a token.
        hidden: Width of the feed-forward layer.
        half: Whether the network runs in bfloat16.
    """
    inside = stacks[1] * stack + (2 * (TOKENS + 1.5) if half else 4 * TOKENS) * width
    inside += 4 * max(0, 2 * hidden - 3 * width)
    return int(tokens * max(stacks[0] * stack, inside))


def _view(
    packed: PackedGarments,
    garments: Sequence[Garment],
    equal: Sequence[int],
    config: NetworkConfig,
    face_splits: int,
    rows: Sequence[tuple[int, int, int]],
) -> PaddedView:
    device = packed.faces.device
    faces = max(row[2] for row in rows)
    width = max(packed.component_offsets[g + 1] - packed.component_offsets[g] for g, _, _ in rows)
    face_index = np.full((len(rows), faces), -1)
    component_index = np.full((len(rows), width), -1)
    for r, (g, first, count) in enumerate(rows):
        face_index[r, :count] = np.arange(first, len(garments[g].faces), face_splits) + packed.face_offsets[g]
        mine = range(packed.component_offsets[g], packed.component_offsets[g + 1])
        component_index[r, : len(mine)] = mine

    kind = architecture(config.architecture)
    shared = len({(equal[g], first) for g, first, _ in rows}) == 1
    shown: list[tuple[Any, np.ndarray | None]] = []
    for g, first, _ in rows[:1] if shared else rows:
        subset = None if face_splits == 1 else np.arange(first, len(garments[g].faces), face_splits)
        shown.append((kind.geometry(garments[g], config), subset))
    return PaddedView(
        face_index=torch.from_numpy(face_index.clip(min=0)).to(device),
        face_mask=_mask(face_index, device),
        component_index=torch.from_numpy(component_index.clip(min=0)).to(device),
        component_mask=_mask(component_index, device),
        weights=kind.rows(shown, config, device),
        real_faces=_real(face_index, device),
        real_components=_real(component_index, device),
        share=torch.tensor([1.0 / min(face_splits, len(garments[g].faces)) for g, _, _ in rows], device=device),
        begin=_begin(face_index),
        shared=shared and len(rows) > 1,
    )


def _or_none(index: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    return index if mask is None else torch.where(mask, index, -1)


def _begin(index: np.ndarray) -> int | None:
    """The first of indices [R,N] that follow each other; None if they do not, or some are -1."""
    flat = index.reshape(-1)
    follows = len(flat) > 0 and flat[0] >= 0 and np.array_equal(flat, np.arange(flat[0], flat[0] + len(flat)))
    return int(flat[0]) if follows else None


def _mask(index: np.ndarray, device: torch.device) -> torch.Tensor | None:
    mask = index >= 0
    return None if mask.all() else torch.from_numpy(mask).to(device)


def _real(index: np.ndarray, device: torch.device) -> torch.Tensor | None:
    """Indices of the real entries, found once: indexing by a mask on a GPU makes the host wait for the count."""
    real = np.flatnonzero(index >= 0)
    return None if len(real) == index.size else torch.from_numpy(real).to(device)


def _those(real: torch.Tensor | None, *rows: torch.Tensor) -> list[torch.Tensor]:
    """Tensors [R,N,...] with rows flattened and without padding, [M,...] each; `real` are the indices to keep."""
    flat = [tensor.flatten(0, 1) for tensor in rows]
    return flat if real is None else [tensor[real] for tensor in flat]
