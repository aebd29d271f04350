"""Garments and bodies packed end to end.

Packed arrays hold all garments one after another; faces hold global vertex indices. The padded rows that a network
reads are made from them in `nn/rows.py`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch

from warpgarment.kernels.mesh.laplacian import components

from .garment import Garment


@dataclasses.dataclass(frozen=True)
class PackedGarments:
    """Garments end to end. Offsets are host integers [B+1]; all other fields are tensors on the device."""

    rest_vertices: torch.Tensor  # float32 [V,3], positions [m]
    faces: torch.Tensor  # int32 [F,3], global vertex indices
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
        """Packs garments in their order in the sequence, as tensors on a device."""
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

    @cached_property
    def vertex_start(self) -> torch.Tensor:
        """`vertex_offsets` on the device, int32 [B+1]."""
        return torch.tensor(self.vertex_offsets, dtype=torch.int32, device=self.faces.device)

    @cached_property
    def owner(self) -> torch.Tensor:
        """`garment_of_vertex` as an index, int64 [V]."""
        return self.garment_of_vertex.long()

    @property
    def component_count(self) -> int:
        """Number of connected components C of all garments."""
        return self.component_offsets[-1]

    def split(self, vertices: np.ndarray) -> list[np.ndarray]:
        """Splits packed positions [...,V,3] into one array per garment."""
        return np.split(vertices, self.vertex_offsets[1:-1], axis=-2)


@dataclasses.dataclass(frozen=True)
class PackedBodies:
    """Faces of bodies end to end, and the body of each garment. Offsets are host integers [number of bodies + 1]."""

    faces: torch.Tensor  # int32 [G,3], global vertex indices
    vertex_offsets: tuple[int, ...]
    face_offsets: tuple[int, ...]
    body_of_garment: torch.Tensor  # int32 [B]
    body_of_vertex: torch.Tensor  # int32 [U]

    @classmethod
    def pack(
        cls,
        faces: Sequence[np.ndarray],
        vertex_counts: Sequence[int],
        body_of_garment: Sequence[int],
        device: torch.device,
    ) -> PackedBodies:
        """Packs bodies in their order in the sequence.

        Args:
            faces: Faces of each body as its own vertex indices, shape [G,3].
            vertex_counts: Number of vertices of each body.
            body_of_garment: Index of the body of each garment, length B.
            device: Device of the tensors.
        """
        offsets = _offsets(vertex_counts)
        packed = np.concatenate([np.asarray(f) + start for f, start in zip(faces, offsets, strict=False)])
        return cls(
            faces=torch.from_numpy(packed.astype(np.int32)).to(device),
            vertex_offsets=offsets,
            face_offsets=_offsets([len(f) for f in faces]),
            body_of_garment=torch.tensor(list(body_of_garment), dtype=torch.int32, device=device),
            body_of_vertex=_owner(offsets, device),
        )


def _offsets(counts: Sequence[int]) -> tuple[int, ...]:
    return (0, *np.cumsum(list(counts)).tolist())


def _owner(offsets: Sequence[int], device: torch.device) -> torch.Tensor:
    """Index of the garment or body to which each packed element belongs, int32 [offsets[-1]]; offsets are [B+1]."""
    counts = torch.tensor(np.diff(offsets))
    return torch.repeat_interleave(torch.arange(len(counts)), counts).to(device, torch.int32)
