"""Lays packed faces out in padded rows for a network.

A row of a padded view is one garment, or one of its `face_splits` interleaved subsets of faces (section 4.3). Rows of
similar length share a view, so little is padded, and a batch of one garment many times shares its geodesic weights.

On a CPU larger garments share a view with themselves only. Padding changes the order in which attention adds up, hence
the last bit; without it a garment in a batch moves as it does alone, bit for bit. Beyond `SMALL` faces that costs no
time, since padded rows are not computed either.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

from .architecture import architecture
from .config import NetworkConfig
from .inputs import RowInputs
from .parametrisation import NetworkOutput

TOKENS_PER_VIEW = 131_072  # faces in one call of the network: bounds its activations to a few GB
WEIGHTS_PER_VIEW = 2**30  # entries of geodesic weights in one call: 4 GB
TOKENS = 6.5  # vectors per token within a layer, in float32; autocast keeps some more, of half the size
PADDING = 1.25  # rows share a view when the longest has at most this many times the faces of the shortest
SMALL = 512  # faces of a row up to which others share its view on a CPU too: calls would take longer than padding


@dataclasses.dataclass(frozen=True)
class PaddedView:
    """Some rows of a batch as the network wants them; R rows of at most N faces and C components."""

    face_index: torch.Tensor  # int64 [R,N], into the packed faces; 0 where padded
    face_mask: torch.Tensor | None  # bool [R,N]; None where nothing is padded
    component_index: torch.Tensor  # int64 [R,C], into the packed components; 0 where padded
    component_mask: torch.Tensor | None  # bool [R,C]
    weights: Any  # from `Architecture.rows`, of R rows, or of one that serves them all
    share: torch.Tensor  # [R], one over the number of rows of the same garment
    real_faces: torch.Tensor | None  # int64, where face_mask is True in rows end to end; None where all are
    real_components: torch.Tensor | None  # the same of component_mask
    in_order: bool  # the view is the packed batch itself, in one row

    def faces(self, packed: torch.Tensor) -> torch.Tensor:
        """Values of the packed faces in rows; [F,...] -> [R,N,...]."""
        return packed[None] if self.in_order else packed[self.face_index]

    def components(self, packed: torch.Tensor) -> torch.Tensor:
        """Values of the packed components in rows; [C,...] -> [R,C,...]."""
        return packed[self.component_index]

    def inputs(self, features: torch.Tensor, velocities: torch.Tensor) -> RowInputs:
        """These rows of packed features [F,H*K] and velocities [C,(H-1)*3]."""
        rows = self.faces(features), self.components(velocities)
        return RowInputs(*rows, self.weights, self.face_mask, self.component_mask)

    def add_to(self, packed: NetworkOutput, rows: NetworkOutput) -> None:
        """Writes what the network said of these rows into packed arrays.

        All rows of a garment say something of a component's velocity: their mean is taken, so it must start at zero.
        """
        for target, values in ((packed.psi, rows.psi), (packed.singular_values, rows.singular_values)):
            index, said = _those(self.real_faces, self.face_index, values)
            target[index] = said
        velocity = rows.velocity * self.share[:, None, None]
        packed.velocity.index_add_(0, *_those(self.real_components, self.component_index, velocity))


class RowLayout(NamedTuple):
    """A packed batch as a network wants it that answers face by face."""

    views: list[PaddedView]
    face_component: torch.Tensor  # int32 [F], of the packed faces


def row_layout(
    packed: PackedGarments, garments: Sequence[Garment], config: NetworkConfig, face_splits: int = 1
) -> RowLayout:
    """Arguments as in `padded_views`."""
    return RowLayout(padded_views(packed, garments, config, face_splits), packed.face_component)


def padded_views(
    packed: PackedGarments, garments: Sequence[Garment], config: NetworkConfig, face_splits: int = 1
) -> list[PaddedView]:
    """Lays a packed batch out for the network.

    Args:
        packed: The batch.
        garments: The same garments, for their geodesic distances.
        config: Of the network.
        face_splits: Disjoint subsets of faces per garment, each seen by the network alone: faces s, s+n, s+2n, ...
            Attention costs n times less, and a face no longer hears all others. Kinds of networks without `subsets`
            see whole garments always.
    """
    if not architecture(config.architecture).subsets:
        face_splits = 1
    groups = row_groups(garments, config, face_splits, cpu=packed.faces.device.type == "cpu")
    return [_view(packed, garments, config, face_splits, group) for group in groups]


def row_groups(
    garments: Sequence[Garment], config: NetworkConfig, face_splits: int, *, cpu: bool
) -> list[list[tuple[int, int, int]]]:
    """Which rows share a view, the longest first; each row is a garment's number, its first face, and how many faces.

    Args:
        garments: In the order of the batch.
        config: Of the network.
        face_splits: As `padded_views`.
        cpu: Whether the network runs on a CPU.
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
    occurrence: dict[int, int] = {}
    for number, garment in enumerate(garments):
        occurrence.setdefault(id(garment), number)
    rows.sort(key=lambda row: (-row[2], occurrence[id(garments[row[0]])] if cpu else 0))

    groups: list[list[tuple[int, int, int]]] = []
    for row in rows:
        if groups:
            longest, together = groups[-1][0][2], len(groups[-1]) + 1
            garment, first = garments[row[0]], garments[groups[-1][0][0]]
            entries = kind.entries(garment, longest, config)
            fits = together * longest <= TOKENS_PER_VIEW and together * entries <= WEIGHTS_PER_VIEW
            alike = kind.alike(garment) == kind.alike(first)
            if cpu and longest > SMALL:
                alike = alike and garment is first and longest == row[2]
            if fits and alike and longest <= PADDING * row[2]:
                groups[-1].append(row)
                continue
        groups.append([row])
    return groups


def activation_bytes(tokens: int, stack: int, stacks: tuple[float, float], width: int, hidden: int, half: bool) -> int:
    """Bytes that a call of a transformer needs in passing, by factors that were measured with torch's profiler.

    Args:
        tokens: Number of faces in the call, padded ones included.
        stack: Bytes of the stacked features of a face.
        stacks: Copies of these, while they are prepared and while the network runs.
        width: Of a token.
        hidden: Of its feed-forward layer.
        half: Whether it runs in bfloat16.
    """
    inside = stacks[1] * stack + (2 * (TOKENS + 1.5) if half else 4 * TOKENS) * width
    inside += 4 * max(0, 2 * hidden - 3 * width)
    return int(tokens * max(stacks[0] * stack, inside))


def _view(
    packed: PackedGarments,
    garments: Sequence[Garment],
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
    shared = len({(id(garments[g]), first) for g, first, _ in rows}) == 1
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
        in_order=packed.count == 1 and face_splits == 1,
    )


def _mask(index: np.ndarray, device: torch.device) -> torch.Tensor | None:
    mask = index >= 0
    return None if mask.all() else torch.from_numpy(mask).to(device)


def _real(index: np.ndarray, device: torch.device) -> torch.Tensor | None:
    """Where a mask is True, found once: a GPU that is indexed by a mask makes the host wait for the number of rows."""
    real = np.flatnonzero(index >= 0)
    return None if len(real) == index.size else torch.from_numpy(real).to(device)


def _those(real: torch.Tensor | None, *rows: torch.Tensor) -> list[torch.Tensor]:
    """Tensors [R,N,...] with their rows end to end, and only the real ones of these; [M,...] each."""
    flat = [tensor.flatten(0, 1) for tensor in rows]
    return flat if real is None else [tensor[real] for tensor in flat]
