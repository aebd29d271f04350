"""If these failed, distances along garments would be wrong, or change with the number of cores."""

import numpy as np
import pytest
from reference.shortest_paths import distances
from scipy.sparse import coo_matrix
from support.surfaces import flat, irregular, skirt

from warpgarment.geometry.geodesics import checked_mesh, face_geodesics, local_geodesics, surface_graph
from warpgarment.kernels.mesh import shortest_paths
from warpgarment.kernels.mesh.shortest_paths import Paths


def pieces():
    """Two skirts, one with a hole, and a face that touches nothing."""
    vertices, faces = skirt(24, 8, 1.9 * np.pi)
    far = vertices + [0, 2, 0]
    lone = np.array([[9, 0, 0], [9, 1, 0], [9, 0, 1]])
    cut = np.delete(faces, np.r_[100:108], axis=0)
    count = len(vertices)
    return np.concatenate([vertices, far, lone]), np.concatenate(
        [faces, cut + count, [[2 * count + k for k in range(3)]]]
    )


MESHES = {
    "pieces": pieces,
    "slivers": lambda: flat(2, 60),
    "irregular": lambda: irregular(300, 3, bumps=0.01),
    "graded": lambda: irregular(200, 1, grading=3),
    "one face": lambda: flat(1, 1),
}


def graph_of(name):
    vertices, faces = checked_mesh(*MESHES[name]())
    return surface_graph(vertices, faces), len(faces)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("share", [0.1, 0.5, np.inf])
def test_same_lengths_as_scipy(name, share):
    """Paths would be missed, or end before the limit, which lies between two distances. With lengths that are rounded
    to units before, only the rounding to float32 is left (relative 6e-8)."""
    graph, count = graph_of(name)
    unit = shortest_paths.unit_of(graph)
    graph.data = unit * np.rint(graph.data / unit)
    sources = np.random.default_rng(0).permutation(count)[:70]
    whole = distances(graph, sources)[:, :count]
    limit = np.inf
    if share < 1:
        levels = np.unique(whole[np.isfinite(whole)].round(6))
        start = min(int(share * len(levels)), len(levels) - 2)
        gap = start + np.argmax(np.diff(levels[start : start + 50]))
        limit = float(levels[gap : gap + 2].mean())
    expected = distances(graph, sources, limit)[:, :count]
    found = Paths(graph, np.arange(count)).distances(sources, limit)
    np.testing.assert_array_equal(np.isinf(found), np.isinf(expected))
    np.testing.assert_allclose(found, expected, rtol=6.1e-8)


@pytest.mark.parametrize("name", MESHES)
def test_rounding_to_units_is_lost_in_that_to_float32(name):
    """Distances would be coarser than promised: half a unit an edge, where the longest path has at least 2^28 units.

    SciPy's sums in float64 are the reference. No path here has more than a hundred edges; on average roundings of
    edges cancel, and less is left than the rounding of float32.
    """
    graph, count = graph_of(name)
    unit = shortest_paths.unit_of(graph)
    expected = distances(graph, np.arange(count))[:, :count]
    reached = np.isfinite(expected)
    if name != "one face":
        assert 2.0**28 < expected[reached].max() / unit < 2.0**30
    found = Paths(graph, np.arange(count)).distances(np.arange(count))
    np.testing.assert_allclose(found, expected, rtol=6.1e-8, atol=50 * unit)
    assert np.abs(found[reached] - expected[reached]).mean() <= 3e-8 * expected[reached].mean()


def test_the_order_of_nodes_changes_no_bit(monkeypatch):
    """Nodes would be lost where the short edges, which the order follows, do not reach them."""
    graph, count = graph_of("pieces")
    every = np.arange(count)
    whole = Paths(graph, every).distances(every)
    for share in (0.0, 0.3):
        monkeypatch.setattr(shortest_paths, "SHORT", share)
        np.testing.assert_array_equal(Paths(graph, every).distances(every), whole)


def test_random_graphs_far_from_a_surface():
    """The order of nodes would matter: sources anywhere, edges that do not follow any geometry, some of no length."""
    random = np.random.default_rng(5)
    a, b = random.integers(0, 500, (2, 900))
    length = np.where(random.random(900) < 0.1, 0.0, random.random(900) ** 8)
    a, b, length = a[a < b], b[a < b], length[a < b]
    _, first = np.unique(500 * a + b, return_index=True)
    a, b, length = a[first], b[first], length[first]
    graph = coo_matrix((np.r_[length, length], (np.r_[a, b], np.r_[b, a])), shape=(500, 500)).tocsr()
    expected = distances(graph, np.arange(500))
    assert np.isinf(expected).any()
    found = Paths(graph, np.arange(500)).distances(np.arange(500))
    np.testing.assert_allclose(found, expected, rtol=6.1e-8, atol=50 * shortest_paths.unit_of(graph))


def test_sources_threads_and_blocks_change_no_bit(monkeypatch):
    """A cache on disk would depend on the machine that made it."""
    graph, count = graph_of("pieces")
    every = np.arange(count)
    once = Paths(graph, every).distances(every, threads=1)
    np.testing.assert_array_equal(once, once.T)
    np.testing.assert_array_equal(Paths(graph, every).distances(every, threads=3), once)
    np.testing.assert_array_equal(Paths(graph, every).distances(every[::-7]), once[::-7])
    vertices, faces = MESHES["pieces"]()
    np.testing.assert_array_equal(face_geodesics(vertices, faces), once)
    local = local_geodesics(vertices, faces, 0.4).toarray()
    np.testing.assert_array_equal(local, np.where(once <= 0.4, once, 0.0))
    monkeypatch.setattr("warpgarment.geometry.geodesics.BLOCK", 50)
    monkeypatch.setattr(shortest_paths, "LANDMARKS", 1)
    np.testing.assert_array_equal(local_geodesics(vertices, faces, 0.4).toarray(), local)


def test_lengths_that_are_none_are_refused():
    """A negative length would be walked around for ever."""
    graph, count = graph_of("slivers")
    for bad in (-1.0, np.nan, np.inf):
        graph.data[3] = bad
        with pytest.raises(ValueError, match="finite and not negative"):
            Paths(graph, np.arange(count))
