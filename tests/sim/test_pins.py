"""Pinned garments: what the predicted velocity does to them."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve
from support import meshes

from warpgarment.objects.garment import Garment
from warpgarment.sim.pins import mean_response


def test_moving_the_mean_of_a_pinned_garment_is_the_constrained_minimiser():
    """The velocity of a garment with pins would be lost, or would tear it off them.

    Twin: the quadratic program with the mean as a constraint, one KKT system in float64 with libigl's Laplacian.
    1e-6 m on a skirt of 1 m: the response is stored in float32.
    """
    mesh = meshes.skirt(24, 8)
    garment = Garment(mesh.vertices, mesh.faces)
    rest, faces = garment.vertices.astype(np.float64), garment.faces.astype(np.int64)
    pins = np.flatnonzero(rest[:, 1] > rest[:, 1].max() - 1e-3)
    laplacian = -igl.cotmatrix(rest, faces)
    diagonal = laplacian.diagonal()
    weight = np.zeros(len(rest))
    weight[pins] = 1e3 * diagonal.mean()
    held = (laplacian + sp.diags(weight)).tocsc()
    share = np.bincount(faces.ravel(), minlength=len(rest)) / faces.size

    target = rest + 0.05 * np.sin(7 * rest[:, [2, 0, 1]])
    right = laplacian @ target + weight[:, None] * target
    pinned = spsolve(held, right)
    mean = share @ pinned + [0.03, -0.02, 0.01]
    kkt = sp.bmat([[held, share[:, None]], [share[None], None]]).tocsc()
    exact = spsolve(kkt, np.vstack([right, mean]))[:-1]

    response = mean_response(garment.vertices, garment.faces, pins, garment.components[1])
    result = pinned + response[:, None].astype(np.float64) * (mean - share @ pinned)
    assert np.abs(result - exact).max() < 1e-6
    assert np.abs(result[pins] - pinned[pins]).max() < 1e-3 * np.abs(result - pinned).max()


def test_pieces_without_pins_do_not_respond():
    """A free piece would be moved twice: by the solve, which sets its mean, and again."""
    skirt, grid = meshes.skirt(12, 4), meshes.irregular_grid(5, 4)
    vertices = np.concatenate([skirt.vertices, grid.vertices + [5.0, 0, 0]]).astype(np.float32)
    garment = Garment(vertices, np.concatenate([skirt.faces, grid.faces + len(skirt.vertices)]))
    response = mean_response(garment.vertices, garment.faces, np.array([0, 1, 2]), garment.components[1])
    assert (response[len(skirt.vertices) :] == 0).all()
    assert np.abs(response[: len(skirt.vertices)]).max() > 0.5


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_the_response_has_unit_mean_at_any_scale(scale):
    """A garment in other units would move by another distance."""
    mesh = meshes.skirt(24, 8)
    garment = Garment(mesh.vertices * scale, mesh.faces)
    pins = np.flatnonzero(garment.vertices[:, 1] > garment.vertices[:, 1].max() - 1e-3 * scale)
    response = mean_response(garment.vertices, garment.faces, pins, garment.components[1])
    assert response[garment.faces].mean() == pytest.approx(1.0, abs=1e-5)
