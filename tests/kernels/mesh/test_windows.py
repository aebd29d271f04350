"""If these failed, faces would be at other distances than their straight segments say, or garments take minutes."""

import numpy as np
import pytest
from reference.windows import segments as all_segments
from support.surfaces import cone, flat, skirt, sphere

import warpgarment as wg
from warpgarment.geometry import geodesics
from warpgarment.kernels.mesh import windows


def bundled(name):
    garment = wg.demo.assets().garments[name].garment
    return garment.vertices, garment.faces


MESHES = {
    "tshirt": lambda: bundled("tshirt"),
    "dress": lambda: bundled("dress"),
    "slit skirt": lambda: skirt(16, 6, 1.9 * np.pi),
    "rippled skirt": lambda: skirt(24, 4, None, 0.05),
    "cone": lambda: cone(40, 1.0),
    "sphere": sphere,
    "one face": lambda: flat(1, 1),
}


@pytest.mark.parametrize("name", MESHES)
def test_same_distances_as_all_windows_without_the_rules(name, monkeypatch):
    """Distances on ordinary garments would change, bit for bit, by rules that are for slender faces and thin tubes."""
    vertices, faces = geodesics.checked_mesh(*MESHES[name]())
    graph = geodesics.surface_graph(vertices, faces)
    monkeypatch.setattr(geodesics, "segments", all_segments)
    expected = geodesics.surface_graph(vertices, faces)
    np.testing.assert_array_equal(graph.indptr, expected.indptr)
    np.testing.assert_array_equal(graph.indices, expected.indices)
    np.testing.assert_array_equal(graph.data, expected.data)


def test_launches_join_without_a_gap(monkeypatch):
    """Sources at the end of a launch would lose their segments, or have them twice."""
    vertices, faces = geodesics.checked_mesh(*skirt(24, 8, None, 0.05))
    whole = geodesics.surface_graph(vertices, faces)
    monkeypatch.setattr(windows, "ROOM", 1)
    monkeypatch.setattr(windows, "MOST", 400)
    parts = geodesics.surface_graph(vertices, faces)
    assert (whole != parts).nnz == 0
    assert whole.nnz == parts.nnz


def test_segments_are_never_shorter_than_exact_and_thinned_where_faces_are_slender():
    """A slender sheet would have a graph of all pairs, or a chain of segments that cuts corners.

    On a flat sheet the exact length is the distance of the points, up to rounding (relative 1e-12).
    """
    vertices, faces = flat(100, 4)
    mesh = geodesics._Unfolding(vertices.astype(np.float64), faces.astype(np.int64))
    source, seen, length = mesh.spread(mesh.from_centroids())
    points = np.concatenate([vertices[faces].mean(axis=1), vertices[mesh.node_of_vertex >= 0]])
    np.testing.assert_allclose(length, np.linalg.norm(points[source] - points[seen], axis=1), rtol=1e-12)
    most = 3 * windows.SECTORS * windows.KEPT + 3
    assert np.bincount(source).max() <= most
    assert len(faces) * 0.25 > most / 3  # so that the rule was needed
