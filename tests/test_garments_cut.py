"""Parametric garments and the surface operations they are made with."""

from __future__ import annotations

import igl
import numpy as np
import pytest
from data_bodies import rest_body

from warpgarment.training.garments import CATEGORIES, make_garment, sampled_pattern
from warpgarment.training.mesh_cutting import boundary_loops, cut_below_zero, without_short_edges

LOOPS = {"tshirt": 4, "top": 4, "dress": 4, "jumpsuit": 5, "trousers": 3, "skirt": 2}


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_garment_is_a_clean_sheet_around_the_body(category):
    """If this fails, the teacher starts from a garment that has holes, the wrong size, or lies inside the body."""
    body = rest_body()
    pattern = sampled_pattern(category, np.random.default_rng(7), 700)
    garment, edge = make_garment(body, pattern)  # Garment itself refuses what is not an oriented manifold
    assert len(boundary_loops(garment.faces)) == LOOPS[category]
    assert 0.7 < len(garment.faces) / pattern.faces < 1.3
    lengths = np.linalg.norm(garment.vertices[garment.edges[:, 0]] - garment.vertices[garment.edges[:, 1]], axis=1)
    assert lengths.min() > 0.2 * edge
    assert lengths.max() < 2.5 * edge
    distance = igl.signed_distance(
        garment.vertices.astype(float), body.vertices, body.faces.astype(np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]  # fmt: skip
    assert distance.min() > 0.004  # made with 11 mm; the last smoothing step may take some back
    assert bool(len(garment.pins)) == (category in ("trousers", "skirt"))


def test_patterns_are_a_function_of_the_seed():
    """If this fails, a sequence cannot be made again from its seed."""
    a, b = (sampled_pattern("dress", np.random.default_rng(3), 900) for _ in range(2))
    assert a == b
    with pytest.raises(ValueError, match="unknown garment category 'cape'"):
        sampled_pattern("cape", np.random.default_rng(0), 900)


def test_cutting_keeps_the_positive_side():
    """If this fails, hems are not where the field says. Twin: the area of a plane cut at a known line."""
    vertices, faces = igl.triangulated_grid(21, 21)[:2]
    vertices = np.concatenate([np.asarray(vertices, float), np.zeros((len(vertices), 1))], axis=1)
    cut, kept = cut_below_zero(vertices, np.asarray(faces, np.int64), 0.633 - vertices[:, 0])
    area = 0.5 * np.asarray(igl.doublearea(cut, kept.astype(np.int64))).sum()
    assert area == pytest.approx(0.633, abs=1e-9)
    assert cut[:, 0].max() == pytest.approx(0.633, abs=1e-12)
    normals = np.cross(cut[kept[:, 1]] - cut[kept[:, 0]], cut[kept[:, 2]] - cut[kept[:, 0]])
    whole = np.cross(*(vertices[faces[0, k]] - vertices[faces[0, 0]] for k in (1, 2)))
    assert (normals @ whole > 0).all()


def test_collapsing_short_edges_keeps_a_manifold_with_its_boundary():
    """If this fails, remeshing leaves slivers, or tears the sheet."""
    vertices, faces = igl.triangulated_grid(9, 9)[:2]
    vertices = np.concatenate([np.asarray(vertices, float), np.zeros((len(vertices), 1))], axis=1)
    inner = 40
    neighbour = next(v for v in faces[(faces == inner).any(1)].ravel() if v != inner)
    vertices[inner] = vertices[neighbour] + 1e-3 * (vertices[inner] - vertices[neighbour])
    done, kept = without_short_edges(vertices, np.asarray(faces), 0.05)
    edges = igl.edges(kept.astype(np.int64))
    assert np.linalg.norm(done[edges[:, 0]] - done[edges[:, 1]], axis=1).min() > 0.05
    assert len(done) - len(edges) + len(kept) == 1  # a disc
    assert 0.5 * np.asarray(igl.doublearea(done, kept.astype(np.int64))).sum() == pytest.approx(1.0, abs=1e-9)
