"""Lays packed faces out in padded rows for a network.

A row of a padded view is one garment, or one of its `face_splits` interleaved subsets of faces (section 4.3). Rows of
similar length share a view, so little is padded, and a batch of one garment many times shares its geodesic weights.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.geometry.pooled_geodesics import CENTRES
from warpgarment.nn.faces.layout import PooledWeights, pooled_weights
from warpgarment.nn.patches.layout import PatchLayout, garment_patches, patch_layout
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

from .attention import geodesic_weights
from .config import NetworkConfig
from .parametrisation import NetworkOutput

TOKENS_PER_VIEW = 131_072  # faces in one call of the network: bounds its activations to a few GB


WEIGHTS_PER_VIEW = 2**30  # entries of geodesic weights in one call: 4 GB


PADDING = 1.25  # rows share a view when the longest has at most this many times the faces of the shortest


@dataclasses.dataclass(frozen=True)
class PaddedView:
    """Some rows of a batch as the network wants them; R rows of at most N faces and C components."""

    face_index: torch.Tensor  # int64 [R,N], into the packed faces; 0 where padded
    face_mask: torch.Tensor | None  # bool [R,N]; None where nothing is padded
    component_index: torch.Tensor  # int64 [R,C], into the packed components; 0 where padded
    component_mask: torch.Tensor | None  # bool [R,C]
    # geodesic weights, [R,N,N] or [1,N,N], pooled for large garments; or patches, of R rows or one:
    weights: torch.Tensor | PooledWeights | PatchLayout
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

    def add_to(self, packed: NetworkOutput, rows: NetworkOutput) -> None:
        """Writes what the network said of these rows into packed arrays.

        All rows of a garment say something of a component's velocity: their mean is taken, so it must start at zero.
        """
        for target, values in ((packed.psi, rows.psi), (packed.singular_values, rows.singular_values)):
            index, said = _those(self.real_faces, self.face_index, values)
            target[index] = said
        velocity = rows.velocity * self.share[:, None, None]
        packed.velocity.index_add_(0, *_those(self.real_components, self.component_index, velocity))


def padded_views(
    packed: PackedGarments, garments: Sequence[Garment], config: NetworkConfig, face_splits: int = 1
) -> list[PaddedView]:
    """Lays a packed batch out for the network.

    Args:
        packed: The batch.
        garments: The same garments, for their geodesic distances.
        config: Of the network.
        face_splits: Disjoint subsets of faces per garment, each seen by the network alone: faces s, s+n, s+2n, ...
            Attention costs n times less, and a face no longer hears all others. A network of patches sees whole
            garments always.
    """
    if config.architecture == "patches":
        face_splits = 1
    groups = row_groups(garments, config, face_splits)
    return [_view(packed, garments, config, face_splits, group) for group in groups]


def row_groups(
    garments: Sequence[Garment], config: NetworkConfig, face_splits: int
) -> list[list[tuple[int, int, int]]]:
    """Which rows share a view, the longest first; each row is a garment's number, its first face, and how many faces.

    Args:
        garments: In the order of the batch.
        config: Of the network.
        face_splits: As `padded_views`.
    """
    if face_splits < 1:
        raise ValueError(f"face_splits must be at least 1, got {face_splits}")
    if config.architecture == "patches":
        face_splits = 1
    rows = []
    for number, garment in enumerate(garments):
        faces = len(garment.faces)
        rows += [(number, s, len(range(s, faces, face_splits))) for s in range(min(face_splits, faces))]
    rows.sort(key=lambda row: -row[2])

    groups: list[list[tuple[int, int, int]]] = []
    for row in rows:
        if groups:
            longest, together = groups[-1][0][2], len(groups[-1]) + 1
            if config.architecture == "patches":
                fits, alike = together * longest <= TOKENS_PER_VIEW, True
            else:
                pooled = garments[row[0]].pools
                entries = CENTRES**2 if pooled else longest**2
                fits = together * longest <= TOKENS_PER_VIEW and together * entries <= WEIGHTS_PER_VIEW
                alike = pooled == garments[groups[-1][0][0]].pools
            if fits and alike and longest <= PADDING * row[2]:
                groups[-1].append(row)
                continue
        groups.append([row])
    return groups


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

    weights: torch.Tensor | PooledWeights | PatchLayout
    shared = len({(id(garments[g]), first) for g, first, _ in rows}) == 1
    if config.architecture == "patches":
        shown = [garment_patches(garments[g], config.patch_spacing) for g, _, _ in (rows[:1] if shared else rows)]
        weights = patch_layout(shown, config.geodesic_radius, config.geodesic_power, device)
    elif not config.manifold_heads:
        weights = torch.zeros((1, 0, 0), device=device)
    elif garments[rows[0][0]].pools:
        weights = pooled_weights(
            [
                (garments[g].pooled_geodesics, np.arange(first, len(garments[g].faces), face_splits))
                for g, first, _ in (rows[:1] if shared else rows)
            ],
            config.geodesic_radius,
            config.geodesic_power,
            device,
        )
    elif shared:
        weights = _weights(garments[rows[0][0]], rows[0][1], face_splits, config, device)[None]
    else:
        weights = torch.zeros((len(rows), faces, faces), device=device)
        for r, (g, first, count) in enumerate(rows):
            weights[r, :count, :count] = _weights(garments[g], first, face_splits, config, device)

    return PaddedView(
        face_index=torch.from_numpy(face_index.clip(min=0)).to(device),
        face_mask=_mask(face_index, device),
        component_index=torch.from_numpy(component_index.clip(min=0)).to(device),
        component_mask=_mask(component_index, device),
        weights=weights,
        real_faces=_real(face_index, device),
        real_components=_real(component_index, device),
        share=torch.tensor([1.0 / min(face_splits, len(garments[g].faces)) for g, _, _ in rows], device=device),
        in_order=packed.count == 1 and face_splits == 1,
    )


def _weights(
    garment: Garment, first: int, face_splits: int, config: NetworkConfig, device: torch.device
) -> torch.Tensor:
    distances = np.ascontiguousarray(garment.geodesics[first::face_splits, first::face_splits])
    return geodesic_weights(torch.from_numpy(distances).to(device), config.geodesic_radius, config.geodesic_power)


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
