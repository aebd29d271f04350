"""If these failed, published figures would be wrong: other units, other means, or insides counted as outsides."""

import igl
import numpy as np
import pytest
import torch
import trimesh

from warpgarment import metrics

RANDOM = np.random.default_rng(0)


def ball(subdivisions=2, radius=1.0):
    mesh = trimesh.creation.icosphere(subdivisions)
    return np.array(mesh.vertices) * radius, np.array(mesh.faces)


def tube(radius, low, high, around=24, rows=8):
    """An open cylinder about the y axis, outside facing away from it."""
    angle = np.arange(around) * 2 * np.pi / around
    ring = np.stack([radius * np.cos(angle), 0 * angle, -radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([ring + [0, y, 0] for y in np.linspace(low, high, rows + 1)])
    k, i = np.divmod(np.arange(rows * around), around)
    a, b = k * around + i, k * around + (i + 1) % around
    return vertices, np.concatenate([np.stack([a, b, b + around], 1), np.stack([a, b + around, a + around], 1)])


@pytest.mark.parametrize("kind", [np.asarray, torch.tensor])
def test_mean_vertex_error_is_in_centimetres(kind):
    """Figures would be off by a hundred, or be a root of mean squares. By hand: distances 0, 1, 2 and 5 cm."""
    truth = np.zeros((2, 2, 3))
    pred = np.array([[[0, 0, 0], [0.01, 0, 0]], [[0, 0.02, 0], [0.03, 0, 0.04]]])
    assert metrics.mean_vertex_error(kind(pred), kind(truth)) == pytest.approx((0 + 1 + 2 + 5) / 4)
    assert metrics.mean_vertex_error(kind(pred[1]), kind(truth[1])) == pytest.approx(3.5)
    with pytest.raises(ValueError, match="truth"):
        metrics.mean_vertex_error(pred, truth[:1])


def test_chamfer_distance_is_the_mean_of_both_directed_means_of_squares():
    """A sum instead of a mean, or distances instead of squares, doubles or changes the figure: brute force, float64."""
    a, b = RANDOM.normal(size=(3, 40, 3)), RANDOM.normal(size=(3, 55, 3))
    squares = ((a[:, :, None] - b[:, None]) ** 2).sum(axis=-1)
    expected = [0.5 * (s.min(axis=1).mean() + s.min(axis=0).mean()) for s in squares]
    assert metrics.chamfer_distance(a[0], torch.tensor(b[0])) == pytest.approx(expected[0], rel=1e-12)
    assert metrics.chamfer_distance(a, b) == pytest.approx(np.mean(expected), rel=1e-12)
    assert metrics.chamfer_distance([[0, 0, 0], [1, 0, 0]], [[0, 0, 2]]) == pytest.approx(0.5 * ((4 + 5) / 2 + 4))


def test_geodesic_distortion_of_a_stretched_sheet():
    """Distortion would be of straight distances, or of other units. For a sheet stretched in x it is known by hand."""
    x, y = np.meshgrid(np.arange(9.0), np.arange(7.0), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1) * 0.1
    a = (np.arange(8)[:, None] * 7 + np.arange(6)).ravel()
    faces = np.concatenate([np.stack([a, a + 7, a + 8], 1), np.stack([a, a + 8, a + 1], 1)])
    stretched = vertices * [1.2, 1, 1]
    centroids, moved = vertices[faces].mean(axis=1), stretched[faces].mean(axis=1)
    d, e = (np.linalg.norm(c[:, None] - c[None], axis=-1) for c in (centroids, moved))
    expected = np.abs(e - d).sum() / (len(faces) * (len(faces) - 1))
    # Distances are up to 1 % too long; both have nearly the same excess, so 2 % of the figure is left.
    assert metrics.geodesic_distortion(stretched, vertices, faces, sources=96) == pytest.approx(expected, rel=0.02)
    assert metrics.geodesic_distortion(vertices, vertices, faces) == 0.0
    rolled = np.stack([np.sin(vertices[:, 0]), vertices[:, 1], np.cos(vertices[:, 0])], axis=1)
    assert metrics.geodesic_distortion(rolled, vertices, faces) < 0.002  # rolled up, not stretched: chords of 0.1 rad
    few = [metrics.geodesic_distortion(stretched, vertices, faces, sources=8, seed=s) for s in (0, 0, 1)]
    assert few[0] == few[1] != few[2]
    both = metrics.geodesic_distortion(np.stack([stretched, vertices]), np.stack([vertices] * 2), faces, sources=96)
    assert both == pytest.approx(expected / 2, rel=0.02)


def test_geodesic_distortion_copes_with_collapsed_faces_and_separate_pieces():
    """A bad prediction would give inf or nan instead of a large figure."""
    vertices, faces = ball(1)
    two, two_faces = np.concatenate([vertices, vertices + 5]), np.concatenate([faces, faces + len(vertices)])
    flat = two.copy()
    flat[: len(vertices)] = 0
    flat[len(vertices) :, 1:] = 0
    assert 0.5 < metrics.geodesic_distortion(flat, two, two_faces) < 10
    assert np.isnan(metrics.geodesic_distortion(two * np.nan, two, two_faces))


def test_body_collision_and_depth_agree_with_libigl():
    """Shares and depths would be of another sign rule: overlapping balls, whose common part is inside."""
    (v1, f1), (v2, f2) = ball(2, 0.5), ball(2, 0.4)
    body, faces = np.concatenate([v1, v2 + [0.3, 0, 0]]), np.concatenate([f1, f2 + len(v1)])
    points = RANDOM.uniform(-1, 1, (800, 3))
    winding = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_WINDING_NUMBER
    signed = igl.signed_distance(points, body, faces.astype(np.int64), winding)[0]
    length = np.sqrt(igl.point_mesh_squared_distance(points, body, faces.astype(np.int64))[0])
    signed = length * np.sign(signed)  # libigl multiplies by 1 - 2 winding number, which is -3 where the balls overlap
    assert np.abs(signed).min() > 1e-5  # no point so near the surface that float32 could decide its side
    assert metrics.body_collision(points, body, faces) == np.mean(signed < 0)
    assert metrics.max_penetration(points, body, faces) == pytest.approx(-signed.min(), abs=1e-6)  # float32 positions
    sequence = torch.tensor(np.stack([points, points + 10]), dtype=torch.float32)
    assert metrics.body_collision(sequence, body, faces) == pytest.approx(np.mean(signed < 0) / 2)
    moved = np.stack([body, body + 10])
    assert metrics.body_collision(sequence, moved, faces) == pytest.approx(np.mean(signed < 0), abs=2 / 800)
    assert metrics.max_penetration(points + 10, body, faces) == 0.0
    with pytest.raises(ValueError, match="frames"):
        metrics.body_collision(np.stack([points] * 3), moved, faces)


def test_layer_collision_counts_what_is_behind_an_open_garment():
    """An open inner garment has no inside: points behind it must count, points past its hem must not."""
    inner, faces = tube(0.3, 0, 1)
    angle, height = RANDOM.uniform(0, 2 * np.pi, 600), RANDOM.uniform(-0.8, 1.8, 600)
    radius = RANDOM.uniform(0.15, 0.5, 600)
    points = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)
    sagitta = 0.3 * (1 - np.cos(np.pi / 24))  # how far the facets lie inside the circle
    sure = (np.abs(radius - 0.3) > sagitta) & (np.abs(height) > 1e-3) & (np.abs(height - 1) > 1e-3)
    points, radius, height = points[sure], radius[sure], height[sure]
    expected = np.mean((radius < 0.3) & (height > 0) & (height < 1))
    assert 0.1 < expected < 0.5
    assert metrics.layer_collision(points, inner, faces) == expected
    outer, _ = tube(0.32, -0.5, 1.5)
    assert metrics.layer_collision(outer, inner, faces) == 0.0
    assert metrics.layer_collision(np.stack([points, points + 9]), inner, faces) == pytest.approx(expected / 2)


def test_layer_collision_agrees_with_winding_numbers_where_there_is_an_inside():
    """For a closed inner mesh both rules must say the same."""
    inner, faces = ball(2, 0.5)
    points = RANDOM.uniform(-0.8, 0.8, (500, 3))
    inside = igl.winding_number(inner, faces.astype(np.int64), points) > 0.5
    assert metrics.layer_collision(points, inner, faces) == inside.mean()


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_positions_that_are_not_finite_give_nan(broken):
    """A rollout that exploded would score well on the vertices that are left."""
    vertices, faces = ball(1)
    bad = vertices.copy()
    bad[3] = broken
    assert np.isnan(metrics.body_collision(bad, vertices, faces))
    assert np.isnan(metrics.max_penetration(bad, vertices, faces))
    assert np.isnan(metrics.layer_collision(bad, vertices, faces))
    assert np.isnan(metrics.chamfer_distance(bad, vertices))
    assert not np.isfinite(metrics.mean_vertex_error(bad, vertices))
    for wrong in (vertices[:, :2], vertices[None, None], vertices[:0]):
        with pytest.raises(ValueError, match="shape"):
            metrics.chamfer_distance(wrong, vertices)
