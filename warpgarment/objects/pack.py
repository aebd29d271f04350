"""Packs garments and bodies end to end, and lays the packed faces out in padded rows for the network.

Packed arrays hold all garments one after another; faces hold global vertex indices. A row of a padded view is one
garment, or one of its `face_splits` interleaved subsets of faces (section 4.3). Rows of similar length share a view, so
little is padded, and a batch of one garment many times shares its geodesic weights.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch

from warpgarment.kernels.mesh.laplacian import components

from .garment import Garment


@dataclasses.dataclass(frozen=True)
class PackedGarments:
    """Garments end to end. Offsets are host integers of length B+1; the rest are tensors on the device."""

    rest_vertices: torch.Tensor  # [V,3]
    faces: torch.Tensor  # int32 [F,3]
    garment_of_vertex: torch.Tensor  # int32 [V]
    garment_of_face: torch.Tensor  # int32 [F]
    vertex_component: torch.Tensor  # int32 [V]
    face_component: torch.Tensor  # int32 [F]
    garment_of_pin: torch.Tensor  # int32 [P]
    pins: torch.Tensor  # int32 [P], global vertex indices
    vertex_offsets: tuple[int, ...]
    face_offsets: tuple[int, ...]
    component_offsets: tuple[int, ...]

    @classmethod
    def pack(cls, garments: Sequence[Garment], device: torch.device) -> PackedGarments:
        """Packs garments in the order given."""
        vertex_component: list[np.ndarray] = []
        face_component: list[np.ndarray] = []
        counts: list[int] = []
        for garment in garments:
            of_vertex, of_face, count = components(len(garment.vertices), garment.faces)
            vertex_component.append(np.asarray(of_vertex) + sum(counts))
            face_component.append(np.asarray(of_face) + sum(counts))
            counts.append(count)
        vertex_offsets = _offsets([len(garment.vertices) for garment in garments])
        face_offsets = _offsets([len(garment.faces) for garment in garments])
        pins = [garment.pins + start for garment, start in zip(garments, vertex_offsets, strict=False)]

        def integers(arrays: Sequence[np.ndarray]) -> torch.Tensor:
            return torch.from_numpy(np.concatenate(arrays).astype(np.int32)).to(device)

        rest_vertices = np.concatenate([garment.vertices for garment in garments])
        return cls(
            rest_vertices=torch.from_numpy(rest_vertices).to(device),
            faces=integers([g.faces + start for g, start in zip(garments, vertex_offsets, strict=False)]),
            garment_of_vertex=_owner(vertex_offsets, device),
            garment_of_face=_owner(face_offsets, device),
            vertex_component=integers(vertex_component),
            face_component=integers(face_component),
            garment_of_pin=_owner(_offsets([len(p) for p in pins]), device),
            pins=integers(pins),
            vertex_offsets=vertex_offsets,
            face_offsets=face_offsets,
            component_offsets=_offsets(counts),
        )

    @property
    def count(self) -> int:
        """Number of garments B."""
        return len(self.vertex_offsets) - 1

    @property
    def component_count(self) -> int:
        """Number of connected components C of all garments."""
        return self.component_offsets[-1]

    def split(self, vertices: np.ndarray) -> list[np.ndarray]:
        """Packed positions [...,V,3] as one array per garment."""
        return np.split(vertices, self.vertex_offsets[1:-1], axis=-2)


@dataclasses.dataclass(frozen=True)
class PackedBodies:
    """Topology of bodies end to end, and which garment is on which."""

    faces: torch.Tensor  # int32 [G,3], global vertex indices
    vertex_offsets: tuple[int, ...]
    face_offsets: tuple[int, ...]
    body_of_garment: torch.Tensor  # int32 [B]

    @classmethod
    def pack(
        cls,
        faces: Sequence[np.ndarray],
        vertex_counts: Sequence[int],
        body_of_garment: Sequence[int],
        device: torch.device,
    ) -> PackedBodies:
        """Packs bodies in the order given.

        Args:
            faces: Of each body, shape [G,3].
            vertex_counts: Of each body.
            body_of_garment: Index of the body each garment is on.
            device: Where the tensors go.
        """
        offsets = _offsets(vertex_counts)
        packed = np.concatenate([np.asarray(f) + start for f, start in zip(faces, offsets, strict=False)])
        return cls(
            faces=torch.from_numpy(packed.astype(np.int32)).to(device),
            vertex_offsets=offsets,
            face_offsets=_offsets([len(f) for f in faces]),
            body_of_garment=torch.tensor(list(body_of_garment), dtype=torch.int32, device=device),
        )


def _offsets(counts: Sequence[int]) -> tuple[int, ...]:
    return (0, *np.cumsum(list(counts)).tolist())


def _owner(offsets: Sequence[int], device: torch.device) -> torch.Tensor:
    """Which of the packed things each element belongs to; offsets [B+1] -> int32 [offsets[-1]]."""
    counts = torch.tensor(np.diff(offsets))
    return torch.repeat_interleave(torch.arange(len(counts)), counts).to(device, torch.int32)
