"""If these failed, manifold-aware attention would reach across gaps, or distances would be off more than promised."""

import time

import numpy as np
import pytest

import warpgarment as wg
from tests.support.surfaces import MESHES, SLENDER, exact_distances, flat, irregular, skirt, tube
from warpgarment.geometry.geodesics import face_geodesics, local_geodesics


@pytest.mark.parametrize("name", MESHES)
def test_within_two_percent_of_exact_distances(name):
    """Attention would reach too far or not far enough. The promise is 5 %; 2 % is what these meshes leave room for.

    Sources are every tenth face and all faces are targets, adjacent ones too. Distances are lengths of real paths, so
    they are never shorter than exact, up to float32 rounding of the sum (relative 1e-6).
    """
    vertices, faces = MESHES[name]()
    sources = np.arange(0, len(faces), 10)
    exact = exact_distances(vertices, faces, sources)
    distances = face_geodesics(vertices, faces)
    assert distances.dtype == np.float32
    assert distances.shape == (len(faces), len(faces))
    np.testing.assert_array_equal(distances, distances.T)
    np.testing.assert_array_equal(np.diag(distances), 0)
    others = exact > 0
    others[np.arange(len(sources)), sources] = False
    ratio = distances[sources][others] / exact[others]
    assert ratio.min() > 1 - 1e-6
    assert ratio.max() < 1.02


@pytest.mark.parametrize("name", SLENDER)
def test_within_five_percent_of_exact_distances_on_slender_faces(name):
    """Attention along straps, cords and stretched sheets would reach too far or not far enough.

    Sources are twenty faces, all faces are targets. 5 % is what is promised; the mean is held to 1 %.
    """
    vertices, faces = SLENDER[name]()
    sources = np.random.default_rng(0).choice(len(faces), 20, replace=False)
    exact = exact_distances(vertices, faces, sources)
    others = exact > 0
    others[np.arange(len(sources)), sources] = False
    ratio = face_geodesics(vertices, faces)[sources][others] / exact[others]
    assert ratio.min() > 1 - 1e-6
    assert ratio.max() < 1.05
    assert ratio.mean() < 1.01


@pytest.mark.parametrize("name", ["drawstring", "finer drawstring", "cord with rings", "strap", "sheet, sides 1:20"])
def test_slender_faces_take_the_time_of_even_ones(name):
    """Straps and cords would take minutes: at most three times as long as a wide tube of as many faces.

    Processor time of all threads, the least of several turns of each, so that other work on the machine counts little.
    """
    vertices, faces = SLENDER[name]()
    rings = round(np.sqrt(len(faces) / 4.4))
    even = tube(0.3, 0.7, round(len(faces) / 2 / rings), rings)
    assert abs(len(even[1]) / len(faces) - 1) < 0.05
    face_geodesics(*even)  # kernels are loaded
    slender, wide = [], []
    for _ in range(6):
        for mesh, times in ((even, wide), ((vertices, faces), slender)):
            begin = time.process_time()
            face_geodesics(*mesh)
            times.append(time.process_time() - begin)
        if len(wide) >= 3 and min(slender) < 3 * min(wide):
            break
    assert min(slender) < 3 * min(wide)


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("share", [0.2, np.inf])
def test_local_distances_are_the_dense_ones_up_to_the_radius(name, share):
    """A pair near the cut-off would be lost, or its path cut short by the border of its block.

    The radius lies between two distances, so that no rounding decides. Values may differ in the last bit (relative
    1.2e-7), since the dense matrix takes the smaller of the sums from both ends.
    """
    vertices, faces = MESHES[name]()
    dense = face_geodesics(vertices, faces)
    levels = np.unique(dense[np.isfinite(dense)].round(6))
    radius = np.inf
    if share < 1:
        start = int(share * len(levels))
        gap = start + np.argmax(np.diff(levels[start : start + 50]))
        radius = float(levels[gap : gap + 2].mean())
    local = local_geodesics(vertices, faces, radius)
    assert local.dtype == np.float32
    assert local.has_sorted_indices
    stored = np.zeros(dense.shape, bool)
    row = np.repeat(np.arange(len(faces)), np.diff(local.indptr))
    stored[row, local.indices] = True
    np.testing.assert_array_equal(stored, dense <= radius)
    found = local.toarray()
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(found[stored], dense[stored], rtol=1.2e-7)
    np.testing.assert_array_equal(np.diag(found), 0)


def test_blocks_of_local_distances_make_no_difference(monkeypatch):
    """A block's surroundings would be too small for the shortest paths of its faces."""
    vertices, faces = skirt(24, 4, None, 0.05)
    whole = local_geodesics(vertices, faces, 0.3)
    monkeypatch.setattr("warpgarment.geometry.geodesics.BLOCK", 7)
    np.testing.assert_allclose(local_geodesics(vertices, faces, 0.3).toarray(), whole.toarray(), rtol=1e-6)


def test_local_distances_refuse_a_bad_radius_and_too_many_pairs(monkeypatch):
    """An infinite radius on a large garment would fill the memory without a word."""
    vertices, faces = flat(4, 4)
    for radius in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="radius must be positive"):
            local_geodesics(vertices, faces, radius)
    monkeypatch.setattr("warpgarment.geometry.geodesics.MEMORY_BUDGET", 4000)
    with pytest.raises(wg.MeshError, match="lower the radius"):
        local_geodesics(vertices, faces, 10.0)


def test_flat_neighbours_are_straight():
    """On a convex flat sheet distances are Euclidean: exact to neighbours, within 1 % afar, whatever the triangles."""
    vertices, faces = flat(12, 9)
    centroids = vertices[faces].mean(axis=1)
    straight = np.linalg.norm(centroids[:, None] - centroids[None], axis=-1)
    distances = face_geodesics(vertices, faces)
    near = straight < 0.2
    np.testing.assert_allclose(distances[near], straight[near], rtol=1e-5, atol=1e-7)  # float32 vertices
    np.testing.assert_allclose(distances, straight, rtol=0.01)


def test_pieces_are_infinitely_far_apart_and_slits_are_walked_around():
    """Attention would leak between garments, or across the two sides of a cut."""
    vertices, faces = skirt(20, 6, 1.97 * np.pi)
    both = face_geodesics(np.concatenate([vertices, vertices]), np.concatenate([faces, faces + len(vertices)]))
    count = len(faces)
    assert np.isinf(both[:count, count:]).all()
    assert np.isfinite(both[:count, :count]).all()
    np.testing.assert_array_equal(both[:count, :count], both[count:, count:])
    centroids = vertices[faces].mean(axis=1)
    gap = np.linalg.norm(centroids[:, None] - centroids[None], axis=-1)
    hem = np.nonzero(centroids[:, 1] < centroids[:, 1].min() + 0.11)[0]
    angle = np.arctan2(centroids[hem, 2], centroids[hem, 0]) % (2 * np.pi)
    first, last = hem[np.argmin(angle)], hem[np.argmax(angle)]
    assert gap[first, last] < 0.2
    assert both[first, last] > 1.0


def test_scale_and_renumbering_change_nothing():
    """Distances would depend on the unit or on the order of faces."""
    vertices, faces = irregular(80, 4)
    base = face_geodesics(vertices, faces)
    np.testing.assert_allclose(face_geodesics(vertices * 1000, faces), base * 1000, rtol=1e-5)  # float32 vertices
    order = np.random.default_rng(0).permutation(len(faces))
    np.testing.assert_allclose(
        face_geodesics(vertices, np.roll(faces, 1, axis=1)[order]), base[np.ix_(order, order)], rtol=1e-6
    )


def test_patches_that_touch_in_a_vertex_are_connected_through_it():
    """A bow tie would be torn apart, although cloth holds together there."""
    vertices = np.array([[0, 0, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]], dtype=float)
    distances = face_geodesics(vertices, [[0, 1, 2], [0, 3, 4]])
    np.testing.assert_allclose(distances[0, 1], 4 / 3, rtol=1e-6)


def test_bad_meshes_and_too_large_ones_are_refused(monkeypatch):
    """A 200,000-face garment would ask for 160 GB without a word."""
    vertices, faces = flat(4, 4)
    with pytest.raises(wg.MeshError, match="more than two faces"):
        face_geodesics(np.r_[vertices, [[0, 0, 1]]], np.r_[faces, [[0, 6, 25]]])
    with pytest.raises(wg.MeshError, match="no area"):
        face_geodesics(vertices, np.r_[faces, [[0, 1, 2]]])
    with pytest.raises(wg.MeshError, match="do not exist"):
        face_geodesics(vertices, faces + 20)
    monkeypatch.setattr("warpgarment.geometry.geodesics.MEMORY_BUDGET", 4000)
    with pytest.raises(wg.MeshError, match="MEMORY_BUDGET"):
        face_geodesics(vertices, faces)


def test_garment_caches_its_geodesics():
    """They would be computed again for every rollout."""
    garment = wg.Garment(*flat(4, 4))
    assert garment.geodesics is garment.geodesics
    np.testing.assert_array_equal(garment.geodesics, face_geodesics(garment.vertices, garment.faces))
