"""Patches of a garment as LayersNet has them: clusters of faces, and the vertices that these touch.

The faces are divided by their nearest centre of the project's geodesic patches (`nn/patches/layout.py`), which are 7
to 8 cm wide with a spacing of 5.5 cm, and 11 cm with one of 8 cm; or, as in the publication, by cells in texture space
(texture.py) if the garment has texture coordinates. A vertex belongs to every patch whose faces it
touches; its own is the one with the nearest mean in the rest pose. A patch's state is the mean of its vertices. Mesh
edges join patches that share a vertex, or two of whose vertices are joined by an edge of the mesh; a patch is joined to
itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import scipy.sparse as sp
import torch

from warpgarment.nn.patches.layout import garment_patches
from warpgarment.objects.garment import Garment

from .texture import texture_cells

_known: WeakKeyDictionary[Garment, dict[tuple[str, float], ClothPatches]] = WeakKeyDictionary()


class ClothPatches(NamedTuple):
    """Patches of one garment of V vertices."""

    vertex: np.ndarray  # int64 [N], vertex of each membership, sorted by vertex
    patch: np.ndarray  # int64 [N], its patch
    own: np.ndarray  # int64 [V], the own patch of each vertex
    edge: np.ndarray  # int64 [E,2], mesh edges between patches in both directions, with (p,p), sorted
    gradient: np.ndarray  # float32 [V,3], w with sum_v x_v w_v^T = integral of the deformation gradient [m]
    patches: int  # number of patches P


class ClothLayout(NamedTuple):
    """Patches of a packed batch of B garments, on the device. Indices are those of packed vertices and patches."""

    vertex: torch.Tensor  # int64 [N]
    patch: torch.Tensor  # int64 [N]
    share: torch.Tensor  # [N], one over the number of vertices of the patch
    own: torch.Tensor  # int64 [V]
    mesh: torch.Tensor  # int32 [P,M], patches that mesh edges join, itself included, padded with -1
    gradient: torch.Tensor  # [V,3]
    garment_of_patch: torch.Tensor  # int64 [P]
    garment_of_vertex: torch.Tensor  # int64 [V]

    @property
    def patches(self) -> int:
        """Number of patches P."""
        return len(self.garment_of_patch)

    def means(self, values: torch.Tensor) -> torch.Tensor:
        """Mean over the vertices of each patch, [V,K] -> [P,K]."""
        sums = values.new_zeros((self.patches, values.shape[1]))
        return sums.index_add(0, self.patch, values[self.vertex] * self.share[:, None].to(values.dtype))


def cloth_patches(garment: Garment, spacing: float, by: str = "geodesics") -> ClothPatches:
    """The patches of a garment, computed once and kept.

    Args:
        garment: The garment.
        spacing: Spacing of the centres, as in `garment_patches`, or side of the cells [m].
        by: "geodesics", or "texture" for cells in texture space where the garment has texture coordinates.
    """
    mine = _known.setdefault(garment, {})
    if (by, spacing) not in mine:
        of_face = texture_cells(garment, spacing) if by == "texture" else None
        if of_face is None:
            of_face = garment_patches(garment, spacing).patch[:, 0]
        mine[by, spacing] = divided(garment.vertices, garment.faces, of_face)
    return mine[by, spacing]


def divided(vertices: np.ndarray, faces: np.ndarray, of_face: np.ndarray) -> ClothPatches:
    """Patches from a division of the faces.

    Args:
        vertices: Rest positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
        of_face: Cluster of each face, integer, shape [F]; clusters without faces vanish.
    """
    points, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    _, of_face = np.unique(of_face, return_inverse=True)
    count, total = int(of_face.max()) + 1, len(points)
    pairs = np.unique(np.stack([faces.ravel(), np.repeat(of_face, 3)], axis=1), axis=0)
    vertex, patch = pairs.T
    number = np.bincount(patch, minlength=count)
    means = np.stack([np.bincount(patch, points[vertex, k], count) for k in range(3)], axis=1) / number[:, None]

    distance = np.linalg.norm(points[vertex] - means[patch], axis=1)
    order = np.lexsort((patch, *means[patch].round(6).T, distance.round(6), vertex))  # ties: not by a patch's number
    first = np.concatenate([[True], np.diff(vertex[order]) > 0])
    own = np.array([np.argmin(np.linalg.norm(means - point, axis=1)) for point in points])  # of vertices without faces
    own[vertex[order][first]] = patch[order][first]

    member = sp.csr_matrix((np.ones(len(pairs)), (vertex, patch)), shape=(total, count))
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    near = sp.coo_matrix((np.ones(len(ends)), ends.T), shape=(total, total)).tocsr()
    joined = sp.coo_matrix(member.T @ (near + near.T + sp.identity(total)) @ member)
    edge = np.unique(np.stack([joined.row, joined.col], axis=1), axis=0).astype(np.int64)
    return ClothPatches(vertex, patch, own, edge, _gradient(points, faces), count)


def _gradient(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted gradients of the hat functions, summed at the vertices: n x (opposite edge) / 2, float32 [V,3]."""
    corners = points[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-30)
    summed = np.zeros_like(points)
    for k in range(3):
        opposite = corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3]
        np.add.at(summed, faces[:, k], 0.5 * np.cross(normal, opposite))
    return summed.astype(np.float32)


def cloth_layout(patches: Sequence[ClothPatches], device: torch.device) -> ClothLayout:
    """The patches of several garments, end to end, as tensors on a device."""
    vertices = np.cumsum([0] + [len(p.own) for p in patches])
    starts = np.cumsum([0] + [p.patches for p in patches])
    total = int(starts[-1])
    patch = np.concatenate([p.patch + s for p, s in zip(patches, starts, strict=False)])
    edge = np.concatenate([p.edge + s for p, s in zip(patches, starts, strict=False)])
    degree = np.bincount(edge[:, 0], minlength=total)
    mesh = np.full((total, int(degree.max())), -1, np.int32)
    mesh[edge[:, 0], np.arange(len(edge)) - np.repeat(np.cumsum(degree) - degree, degree)] = edge[:, 1]

    def send(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    return ClothLayout(
        vertex=send(np.concatenate([p.vertex + s for p, s in zip(patches, vertices, strict=False)])),
        patch=send(patch),
        share=send((1.0 / np.bincount(patch, minlength=total)[patch]).astype(np.float32)),
        own=send(np.concatenate([p.own + s for p, s in zip(patches, starts, strict=False)])),
        mesh=send(mesh),
        gradient=send(np.concatenate([p.gradient for p in patches])),
        garment_of_patch=send(np.repeat(np.arange(len(patches)), np.diff(starts))),
        garment_of_vertex=send(np.repeat(np.arange(len(patches)), np.diff(vertices))),
    )
