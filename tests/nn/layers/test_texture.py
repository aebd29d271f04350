"""Patches by texture coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import tube

from warpgarment.io.surface.record import Coordinates, Surface
from warpgarment.nn.layers.cloth import cloth_patches
from warpgarment.nn.layers.texture import texture_cells
from warpgarment.objects.garment import Garment


def sheet(side: int = 8, edge: float = 0.05, *, quads: bool, scale: float = 1.0, split: bool = False) -> Garment:
    """A flat sheet of squares with texture coordinates, which are `scale` for a metre of cloth; with `split` the right
    half is a part of its own, whose coordinates lie over those of the left one."""
    line = np.arange(side + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    vertices = np.stack([x.ravel() * edge, y.ravel() * edge, 0.0 * x.ravel()], 1).astype(np.float32)
    corner = lambda i, j: i * (side + 1) + j  # noqa: E731
    squares = np.array(
        [[corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)] for i in line[:-1] for j in line[:-1]]
    )
    polygons = squares if quads else np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
    where, right = scale * vertices[:, :2], vertices[polygons][:, :, 0].mean(axis=1) > side * edge / 2
    index = polygons + len(vertices) * (right[:, None] & split)
    values = np.concatenate([where, where - scale * np.float32([side * edge / 2, 0.0])]).astype(np.float32)
    surface = Surface(
        np.full(len(polygons), polygons.shape[1]), polygons.ravel(), (Coordinates("", values, index.ravel()),)
    )
    faces = np.concatenate([polygons[:, [0, 1, 2]], polygons[:, [0, 2, 3]]], 1).reshape(-1, 3) if quads else polygons
    return Garment(vertices, faces, surface=surface)


@pytest.mark.parametrize("quads", [True, False])
@pytest.mark.parametrize("scale", [1.0, 3.7])
def test_cells_have_their_side_on_the_cloth(quads, scale):
    """Cells would be as large as the texture happens to be scaled, or quads lose theirs. Exact, by centroids on the
    cloth, a tenth of an edge away from the borders of cells."""
    garment = sheet(quads=quads, scale=scale)
    found = texture_cells(garment, 0.1)
    centroid = garment.vertices[garment.faces].astype(float).mean(axis=1)[:, :2]
    expected = np.floor(centroid / 0.1) @ [100, 1]
    assert len(np.unique(found)) == 16
    assert len(np.unique(np.stack([found, expected]), axis=1).T) == 16  # the same division


def test_parts_that_lie_over_each_other():
    """Two panels in one place of the texture would share patches."""
    garment = sheet(quads=True, split=True)
    found = texture_cells(garment, 0.1)
    right = garment.vertices[garment.faces][:, :, 0].mean(axis=1) > 0.2
    assert set(found[right]).isdisjoint(found[~right])
    assert len(np.unique(found)) == 16


def test_without_texture():
    """A garment without texture coordinates, or with a face that has none, would be refused or divided by nonsense."""
    plain = Garment(*tube(12, 8, bottom=-0.2, top=0.2))
    assert texture_cells(plain, 0.1) is None
    garment = sheet(quads=False)
    surface = garment.surface
    corners = np.array(surface.coordinates[0].corners)
    corners[5] = -1
    holed = Surface(surface.counts, surface.corners, (Coordinates("", surface.coordinates[0].values, corners),))
    holed = Garment(garment.vertices, garment.faces, surface=holed)
    assert texture_cells(holed, 0.1) is None
    flat = Coordinates("", 0.0 * surface.coordinates[0].values, surface.coordinates[0].corners)
    flat = Garment(garment.vertices, garment.faces, surface=Surface(surface.counts, surface.corners, (flat,)))
    assert texture_cells(flat, 0.1) is None
    for one in (plain, holed, flat):
        np.testing.assert_array_equal(cloth_patches(one, 0.1, "texture").own, cloth_patches(one, 0.1).own)
    assert cloth_patches(garment, 0.1, "texture").patches == 16
