"""Which garments of a batch share a call of the network, and how their faces are taken."""

import numpy as np
import torch
from support import meshes

import warpgarment as wg
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.rows import TOKENS_ON_CPU, first_equal, padded_views, row_groups
from warpgarment.objects.pack import PackedGarments


def grid() -> wg.Garment:
    """A garment of 882 faces, more than share a view with other shapes."""
    return wg.Garment(*meshes.irregular_grid(columns=21, rows=21))


def other() -> wg.Garment:
    """One of as many faces that is twice as high."""
    one = grid()
    return wg.Garment(one.vertices * np.array([1.0, 2.0, 1.0]), one.faces)


def test_garments_of_the_same_mesh_are_found():
    """Copies of a garment would be called one by one, or garments of other shapes share one layout."""
    one = grid()
    turned = wg.Garment(one.vertices, one.faces[:, [1, 2, 0]])
    assert first_equal([one, other(), grid(), one, turned]) == [0, 1, 0, 0, 4]


def test_faces_of_rows_that_follow_each_other():
    """Rows would be taken from the wrong garment, or from the faces of another one between them."""
    for garments, begins in (([grid(), grid(), other()], [0, 1764]), ([grid(), other(), grid()], [None, 882])):
        packed = PackedGarments.pack(garments, torch.device("cpu"))
        views = padded_views(packed, garments, NetworkConfig.fast())
        assert [view.begin for view in views] == begins
        values = torch.arange(2646.0)[:, None] * torch.ones(5)
        for view in views:
            assert torch.equal(view.faces(values), values[view.face_index])


def test_calls_on_a_cpu_are_bounded():
    """Activations of a large batch of one garment would take more memory than is predicted for calls."""
    groups = row_groups([grid()] * 100, NetworkConfig.fast(), 1, cpu=True)
    assert sorted(row[0] for group in groups for row in group) == list(range(100))
    assert all(len(group) * 882 <= TOKENS_ON_CPU for group in groups)
    assert len(groups) == 3
