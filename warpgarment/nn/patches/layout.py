"""Patches of cloth, into which the faces of a garment are pooled, by distance along the surface.

Centres are faces, chosen by farthest point sampling with geodesic distances until every face is within `spacing` of
one. So they are more than `spacing` apart, and every connected piece has at least one. A face belongs to its `SHARES`
nearest centres c on its own piece, with the shares

    s_fc = softmax_c(-(D_fc / (spacing/2))^2)                sums to 1 over c

and a patch is the mean of its faces with weights p_cf = s_fc area_f / sum_f s_fc area_f. As the spacing is a length,
the number of patches hardly depends on how finely a garment is meshed. Patches are computed once per garment, by one
run of Dijkstra's algorithm for each centre, without an array of F x F.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch

from warpgarment.geometry.geodesics import distances_from, surface_graph
from warpgarment.kernels.mesh.laplacian import components
from warpgarment.nn.attention import geodesic_weights
from warpgarment.objects.garment import Garment

SHARES = 4  # number of patches to which a face belongs

_known: WeakKeyDictionary[Garment, dict[float, Patches]] = WeakKeyDictionary()


class Patches(NamedTuple):
    """Patches of one garment of F faces."""

    centres: np.ndarray  # int64 [P], indices of faces
    patch: np.ndarray  # int64 [F, SHARES], nearest first
    share: np.ndarray  # float32 [F, SHARES], rows sum to one; 0 if a piece has fewer patches
    member: np.ndarray  # int64 [F * SHARES], indices of faces, sorted by patch
    member_weight: np.ndarray  # float32 [F * SHARES], sums to one over each patch
    start: np.ndarray  # int64 [P], position of the first member of each patch
    neighbours: np.ndarray | None  # int64 [F,3], face across each edge, itself at the border; None in a subset
    distances: np.ndarray  # float32 [P,P], geodesic distances between centres [m]
    pieces: np.ndarray  # float32 [C,P], share of each patch in the area of each piece, rows sum to one
    piece: np.ndarray  # int64 [P], the piece each patch is on
    area: np.ndarray  # float64 [F], of the faces [m^2]

    def subset(self, faces: np.ndarray) -> Patches:
        """The same patches with only some of the faces, int64 [N]; without neighbours, and patches may be empty."""
        patch, share, area = self.patch[faces], self.share[faces], self.area[faces]
        return self._replace(
            patch=patch, share=share, area=area, neighbours=None, **_pools(patch, share, area, self.piece)
        )


class PatchLayout(NamedTuple):
    """Patches of a batch of B garments, padded to N faces and P patches. B may be 1 for a batch that repeats one
    garment."""

    patch: torch.Tensor  # int64 [B,N,SHARES]
    share: torch.Tensor  # [B,N,SHARES], 0 where padded
    member: torch.Tensor  # int64 [B,N*SHARES]
    member_weight: torch.Tensor  # [B,N*SHARES], 0 where padded
    start: torch.Tensor  # int64 [B,P]
    neighbours: torch.Tensor | None  # int64 [B,N,3]; None for subsets of faces
    pieces: torch.Tensor  # [B,C,P], 0 where padded
    weights: torch.Tensor  # [B,P,P] geodesic weights between patches, 0 where padded
    mask: torch.Tensor | None  # bool [B,P]; None where all are real and have faces


def garment_patches(garment: Garment, spacing: float) -> Patches:
    """The patches of a garment, computed once and kept; geodesic distances are reused if the garment has them.

    Args:
        garment: The garment.
        spacing: Least distance between centres, and largest distance from a face to its nearest centre [m].
    """
    mine = _known.setdefault(garment, {})
    if spacing not in mine:
        mine[spacing] = patches(garment.vertices, garment.faces, spacing, _distances(garment))
    return mine[spacing]


def _distances(garment: Garment) -> Callable[[int], np.ndarray]:
    """A function from a face to its geodesic distances to all faces, known already or found by a search."""
    known = garment.__dict__.get("geodesics")  # a cached property
    if known is not None:
        return known.__getitem__
    graph, count = surface_graph(garment.vertices, garment.faces), len(garment.faces)
    return lambda face: distances_from(graph, np.array([face]), count)[0]


def patches(vertices: np.ndarray, faces: np.ndarray, spacing: float, distances: Callable[[int], np.ndarray]) -> Patches:
    """Divides a mesh into patches.

    Args:
        vertices: Rest positions [m], shape [V,3].
        faces: Vertex indices, shape [F,3].
        spacing: Spacing of the centres [m], as in `garment_patches`.
        distances: Function that returns the geodesic distances [m] from a face to all, shape [F]; inf across pieces.
    """
    corners = np.asarray(vertices, np.float64)[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    centres, rows = _farthest_points(corners.mean(axis=1), spacing, distances)
    count, face_count = len(centres), len(faces)

    kept = min(SHARES, count)
    nearest = np.argsort(rows, axis=0, kind="stable")[:kept]  # [kept,F]
    near = np.take_along_axis(rows, nearest, axis=0)
    score = np.where(np.isinf(near), -np.inf, -((near / (0.5 * spacing)) ** 2))
    share = np.exp(score - score[0])
    share /= share.sum(axis=0)
    patch = np.zeros((face_count, SHARES), np.int64)
    padded = np.zeros((face_count, SHARES))
    patch[:, :kept], padded[:, :kept] = np.where(np.isinf(near), nearest[0], nearest).T, share.T

    between, piece = rows[:, centres], np.asarray(components(len(vertices), faces)[1])[centres].astype(np.int64)
    return Patches(
        centres=centres,
        patch=patch,
        share=padded.astype(np.float32),
        **_pools(patch, padded, area, piece),
        neighbours=edge_neighbours(faces),
        distances=np.minimum(between, between.T).astype(np.float32),
        piece=piece,
        area=area,
    )


def _pools(patch: np.ndarray, share: np.ndarray, area: np.ndarray, piece: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of `Patches` with the weights of faces in patches, and of patches in pieces."""
    owner, count = patch.ravel(), len(piece)
    order = np.argsort(owner, kind="stable")
    weight = (share * area[:, None]).ravel()
    total = np.bincount(owner, weights=weight, minlength=count)
    members = np.bincount(owner, minlength=count)
    weight = np.divide(weight, total[owner], out=np.zeros_like(weight), where=total[owner] > 0.0)
    pieces = np.where(np.arange(piece.max() + 1)[:, None] == piece, total, 0.0)
    pieces /= np.maximum(pieces.sum(axis=1, keepdims=True), 1e-30)
    return {
        "pieces": pieces.astype(np.float32),
        "member": order // SHARES,
        "member_weight": weight[order].astype(np.float32),
        "start": np.cumsum(members) - members,
    }


def _farthest_points(
    centroids: np.ndarray, spacing: float, distances: Callable[[int], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Centres [P] and their distances to all faces, float64 [P,F]."""
    nearest = np.full(len(centroids), np.inf)
    centres: list[int] = []
    rows: list[np.ndarray] = []
    while True:
        face = int(np.argmax(nearest))
        if nearest[face] <= spacing:
            return np.array(centres), np.array(rows)
        if np.isinf(nearest[face]):  # a piece without a centre: its first one is the face farthest from its middle
            piece = np.isfinite(distances(face))
            out = np.linalg.norm(centroids - centroids[piece].mean(axis=0), axis=1)
            face = int(np.argmax(np.where(piece, out, -1.0)))
        row = np.array(distances(face), np.float64)
        row[face] = 0.0
        centres.append(face)
        rows.append(row)
        nearest = np.minimum(nearest, row)


def edge_neighbours(faces: np.ndarray) -> np.ndarray:
    """Index of the face across each edge of a face, of the face itself at the border, int64 [F,3]."""
    faces = np.asarray(faces, np.int64)
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    key = ends[:, 0] * (int(faces.max()) + 1) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    pair = np.nonzero(key[order][1:] == key[order][:-1])[0]
    a, b = order[pair], order[pair + 1]
    result = np.arange(len(key)) // 3
    result[a], result[b] = b // 3, a // 3
    return result.reshape(-1, 3)


def patch_layout(
    garments: Sequence[Patches],
    radius: float,
    power: float,
    device: torch.device | str = "cpu",
    scale: Sequence[float] | np.ndarray | None = None,
) -> PatchLayout:
    """Arranges the patches of several garments in padded rows.

    Args:
        garments: Patches of each garment, one row each.
        radius: Radius of the geodesic weights between patches [m], see `attention.geodesic_weights`.
        power: Power of these weights, without unit.
        device: Device of the tensors.
        scale: Factor for the lengths of each garment, shape [B]; None for 1.
    """
    rows, faces = len(garments), max(len(p.patch) for p in garments)
    count = max(len(p.centres) for p in garments)
    patch = np.zeros((rows, faces, SHARES), np.int64)
    share = np.zeros((rows, faces, SHARES), np.float32)
    member = np.zeros((rows, faces * SHARES), np.int64)
    member_weight = np.zeros((rows, faces * SHARES), np.float32)
    start = np.zeros((rows, count), np.int64)
    whole = garments[0].neighbours is not None
    neighbours = np.broadcast_to(np.arange(faces)[None, :, None], (rows, faces, 3)).copy()
    distances = np.full((rows, count, count), np.inf, np.float32)
    pieces = np.zeros((rows, max(len(p.pieces) for p in garments), count), np.float32)
    real = np.zeros((rows, count), bool)
    for r, mine in enumerate(garments):
        f, p = mine.patch.shape[0], len(mine.centres)
        patch[r, :f], share[r, :f] = mine.patch, mine.share
        if mine.neighbours is not None:
            neighbours[r, :f] = mine.neighbours
        member[r, : f * SHARES], member_weight[r, : f * SHARES] = mine.member, mine.member_weight
        start[r, :p], start[r, p:] = mine.start, f * SHARES
        pieces[r, : len(mine.pieces), :p] = mine.pieces
        real[r, :p] = np.diff(mine.start, append=f * SHARES) > 0
        distances[r, :p, :p] = mine.distances * (1.0 if scale is None else scale[r])

    def send(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array).to(device)

    return PatchLayout(
        patch=send(patch),
        share=send(share),
        member=send(member),
        member_weight=send(member_weight),
        start=send(start),
        neighbours=send(neighbours) if whole else None,
        pieces=send(pieces),
        weights=geodesic_weights(send(distances), radius, power),
        mask=None if real.all() else send(real),
    )
