"""Patches of cloth for LayersNet, and what a packed batch of them holds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.outfits import CPU, inner, outer
from support.scenes import outfit, skirt

from warpgarment.nn.layers.cloth import cloth_layout, cloth_patches, divided
from warpgarment.nn.patches.layout import garment_patches
from warpgarment.objects.garment import Garment


@pytest.mark.parametrize("make", [inner, outer, outfit, skirt])
def test_memberships(make):
    """A vertex would lack a patch whose faces it touches, have one that it does not touch, or an own one of others."""
    garment = make()
    of_face = garment_patches(garment, 0.12).patch[:, 0]
    found = cloth_patches(garment, 0.12)
    wanted = {(int(v), int(np.unique(of_face).searchsorted(p))) for f, p in zip(garment.faces, of_face, strict=True)
              for v in f}  # fmt: skip
    assert set(zip(found.vertex.tolist(), found.patch.tolist(), strict=True)) == wanted
    assert len(found.vertex) == len(wanted)
    assert all((v, p) in wanted for v, p in enumerate(found.own.tolist()))
    assert found.patches == len(np.unique(of_face)) > 2


def test_mesh_edges():
    """Patches that no mesh edge joins would be neighbours, or others not; a patch would not see itself."""
    # a strip of four squares, two faces each, one patch each: 0-1-2-3 touch in a row
    x = np.repeat(np.arange(5.0), 2)
    vertices = np.stack([x, np.tile([0.0, 1.0], 5), np.zeros(10)], axis=1)
    faces = np.array([[2 * k + i for i in f] for k in range(4) for f in ((0, 2, 1), (1, 2, 3))])
    found = divided(vertices, faces, np.repeat([5, 6, 9, 11], 2))
    joined = {tuple(edge) for edge in found.edge.tolist()}
    # neighbours share an edge; those two apart are joined by the edges of the square between them
    assert joined == {(a, b) for a in range(4) for b in range(4) if abs(a - b) <= 2}
    apart = divided(vertices, faces[[0, 1, 6, 7]], np.array([0, 0, 1, 1]))
    assert {tuple(edge) for edge in apart.edge.tolist()} == {(0, 0), (1, 1)}


def test_gradient():
    """The heading would not be that of the deformation: of an affine map it is the map times the area. 1e-5."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], float)
    found = divided(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.array([0, 0]))
    affine = np.random.default_rng(0).normal(size=(3, 3))
    total = (vertices @ affine.T).T @ found.gradient
    np.testing.assert_allclose(total[:, :2], 2.0 * affine[:, :2], atol=1e-5)
    np.testing.assert_allclose(total[:, 2], 0.0, atol=1e-5)


def test_a_packed_batch():
    """Patches or vertices of one garment would become those of another. Means within 1e-6 of NumPy's."""
    garments = [inner(), outfit(), outer()]
    each = [cloth_patches(garment, 0.12) for garment in garments]
    packed = cloth_layout(each, CPU)
    values = np.concatenate([garment.vertices for garment in garments])
    means, start, first = packed.means(torch.from_numpy(values)).numpy(), 0, 0
    for number, (garment, patches) in enumerate(zip(garments, each, strict=True)):
        for p in range(patches.patches):
            mine = garment.vertices[patches.vertex[patches.patch == p]].mean(axis=0)
            assert np.abs(means[start + p] - mine).max() < 1e-6
            row = packed.mesh[start + p]
            assert sorted(row[row >= 0].tolist()) == [start + b for a, b in patches.edge.tolist() if a == p]
        assert (packed.garment_of_patch[start : start + patches.patches] == number).all()
        own = packed.own[first : first + len(garment.vertices)].numpy()
        np.testing.assert_array_equal(own, patches.own + start)
        start, first = start + patches.patches, first + len(garment.vertices)


def test_patches_are_computed_once():
    """Every simulation would search distances anew; or a garment would get the patches of another spacing."""
    garment = inner()
    assert cloth_patches(garment, 0.12) is cloth_patches(garment, 0.12)
    assert cloth_patches(garment, 0.12).patches != cloth_patches(garment, 0.2).patches
    assert cloth_patches(Garment(garment.vertices, garment.faces), 0.12).patches == cloth_patches(garment, 0.12).patches
