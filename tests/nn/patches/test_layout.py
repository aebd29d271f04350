"""Patches of cloth against what defines them, computed plainly in NumPy from all-pairs geodesic distances."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.meshes import irregular_grid, joined, moved, skirt, two_components

from warpgarment.nn.patches.layout import SHARES, edge_neighbours, garment_patches, patch_layout
from warpgarment.objects.garment import Garment

SPACING = 0.1


def garment(name: str) -> Garment:
    """A skirt, a skirt and a sheet, or a skirt and three pieces smaller than a patch."""
    if name == "skirt":
        return Garment(*skirt(24, 12))
    if name == "two pieces":
        return Garment(*two_components())
    crumb = irregular_grid(2, 1, 0.03, 0.02)
    crumbs = [crumb._replace(vertices=crumb.vertices + np.float32([k, 2.0, 0.0])) for k in range(3)]
    return Garment(*joined(crumbs[0], skirt(24, 8), *crumbs[1:]))


@pytest.mark.parametrize("name", ["skirt", "two pieces", "crumbs"])
def test_patches_cover_the_cloth(name):
    """A face would be left out, belong to another piece, count twice, or patches be denser than asked for.

    Against all-pairs distances; 1e-6 for float32 sums, and distances that may be summed from either end.
    """
    worn = garment(name)
    found, distances = garment_patches(worn, SPACING), worn.geodesics.astype(np.float64)
    centres, count = found.centres, len(found.centres)
    to_centres = distances[:, centres]
    assert to_centres.min(axis=1).max() <= SPACING * (1 + 1e-6)
    assert (to_centres[centres] + np.eye(count)).min() > SPACING * (1 - 1e-6)  # also: no centre twice
    np.testing.assert_allclose(found.distances, to_centres[centres], rtol=1e-6, atol=1e-7)
    piece = worn.components[1]
    assert set(piece[centres]) == set(piece)
    real = found.share > 0.0
    assert real[:, 0].all()
    assert (piece[centres[found.patch]] == piece[:, None])[real].all()
    np.testing.assert_allclose(found.share.sum(axis=1), 1.0, atol=1e-6)
    nearest = np.sort(to_centres, axis=1)[:, : min(SHARES, count)]
    expected = np.exp(-((nearest / (0.5 * SPACING)) ** 2))
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(found.share[:, : nearest.shape[1]], expected, atol=1e-5)


def dense(found, faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Shares [F,P], and pooling weights [P,F] read from the lists of members."""
    share, pooled = np.zeros((faces, len(found.centres))), np.zeros((len(found.centres), faces))
    np.add.at(share, (np.arange(faces)[:, None], found.patch), found.share)
    for p, members in enumerate(np.split(np.arange(len(found.member)), found.start[1:])):
        np.add.at(pooled[p], found.member[members], found.member_weight[members])
    return share, pooled


@pytest.mark.parametrize("name", ["skirt", "two pieces", "crumbs"])
def test_pooling_is_the_area_weighted_mean(name):
    """Small faces would count as much as large ones, or a patch's mean not be one; 1e-6 for float32."""
    worn = garment(name)
    found = garment_patches(worn, SPACING)
    share, pooled = dense(found, len(worn.faces))
    corners = worn.vertices[worn.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    expected = (share * area[:, None]).T
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(pooled, expected, atol=1e-6)
    np.testing.assert_allclose(pooled.sum(axis=1), 1.0, atol=1e-6)


def test_patches_are_deterministic_and_follow_the_faces():
    """The same garment would have other patches in another process, or in another order of its faces."""
    shape = moved(irregular_grid())
    worn = Garment(shape.vertices, shape.faces)
    first = garment_patches(worn, SPACING)
    again = garment_patches(Garment(shape.vertices, shape.faces), SPACING)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert garment_patches(worn, SPACING) is first
    order = np.random.default_rng(0).permutation(len(shape.faces))
    permuted = garment_patches(Garment(shape.vertices, shape.faces[order]), SPACING)
    assert np.array_equal(order[permuted.centres], first.centres)
    assert np.array_equal(permuted.patch, first.patch[order])


def test_patches_do_not_depend_on_the_resolution():
    """A finely meshed garment would have more patches, and the network mean something else on it.

    3,072 and 6,912 faces of one skirt of 0.97 m^2, 2.5 and 1.7 cm apart: within a tenth. (Centres lie at faces, so that
    with faces 5 cm apart there are a fifth fewer.)
    """
    counts = [len(garment_patches(Garment(*skirt(24 * k, 16 * k)), SPACING).centres) for k in (2, 3)]
    assert abs(counts[1] - counts[0]) <= counts[0] / 10


def test_neighbours():
    """A face would be averaged with faces with which it shares no edge. Compared with a search of all pairs."""
    faces = two_components().faces
    found = edge_neighbours(faces)
    edges = [{frozenset(e) for e in zip(f, np.roll(f, -1), strict=True)} for f in faces.tolist()]
    for f, mine in enumerate(edges):
        across = {g for g, other in enumerate(edges) if g != f and mine & other}
        assert set(found[f]) - {f} == across
        assert np.count_nonzero(found[f] == f) == 3 - len(across)


def test_subset_pools_the_same_places():
    """A training sample's patches would be other places than the garment's.

    Shares stay; pooling weights are those of the faces that are left, rescaled to one; an empty patch is masked.
    """
    worn = garment("two pieces")
    found = garment_patches(worn, SPACING)
    share, pooled = dense(found, len(worn.faces))
    chosen = np.sort(np.random.default_rng(0).permutation(len(worn.faces))[: len(worn.faces) // 8])
    part = found.subset(chosen)
    part_share, part_pooled = dense(part, len(chosen))
    np.testing.assert_array_equal(part_share, share[chosen])
    total = pooled[:, chosen].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(part_pooled, pooled[:, chosen] / np.maximum(total, 1e-12), atol=1e-5)
    layout = patch_layout([part, part], 0.15, 2.0)
    empty = (total == 0.0).ravel()
    assert empty.any()
    assert layout.mask is not None
    assert np.array_equal(layout.mask.numpy(), np.stack([~empty, ~empty]))
    assert layout.neighbours is None


def test_layout_pads():
    """Padding would have weight in a pool, a share, or a neighbour."""
    small, large = (garment_patches(garment(name), SPACING) for name in ("two pieces", "skirt"))
    layout = patch_layout([small, large], 0.15, 2.0)
    faces, patches = len(small.patch), len(small.centres)
    assert patches < len(large.centres)
    assert faces < len(large.patch)
    assert not layout.share[0, faces:].any()
    assert not layout.member_weight[0, faces * SHARES :].any()
    assert not layout.weights[0, patches:].any()
    assert not layout.weights[0, :, patches:].any()
    assert layout.mask is not None
    assert layout.mask.sum(dim=1).tolist() == [patches, len(large.centres)]
    assert torch.equal(layout.neighbours[0, faces:, 0], torch.arange(faces, len(large.patch)))
