"""Measures of folds and errors: shapes made by hand, whose figures are known, and other ways to compute them."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import scipy.linalg
from scipy.spatial.transform import Rotation
from support import sequences as synthetic

from warpgarment.objects.garment import Garment
from warpgarment.training.evaluate.shape import QUARTERS, WAVELENGTH, Shape, moving_mean


def sheet(columns: int = 12, rows: int = 20, width: float = 0.4, height: float = 0.8) -> Garment:
    """An upright sheet in the plane z = 0, of `columns` x `rows` squares in two triangles each."""
    x, y = np.meshgrid(np.linspace(0, width, columns + 1), np.linspace(0, height, rows + 1))
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    up = corner + columns + 1
    faces = np.concatenate([np.stack([corner, corner + 1, up + 1], 1), np.stack([corner, up + 1, up], 1)])
    return Garment(vertices.astype(np.float32), faces)


def tube() -> Garment:
    content = synthetic.arrays(frames=2)
    return Garment(content["garment_rest_vertices"], content["garment_faces"])


def test_a_shift_is_distance_low_slow_and_bias_alone():
    """A part of a constant error is counted as folds or jitter. A shift by (1, 2, 2) mm has length 3 mm everywhere;
    1e-6 cm: rounding of the factorisation."""
    garment = tube()
    recorded = np.repeat(garment.vertices[None].astype(np.float64), 40, axis=0)
    moved = recorded + np.array([0.001, 0.002, 0.002])
    shape = Shape(garment)
    found = shape.differences(moved, recorded)
    for name in ("distance", *QUARTERS, "low", "slow"):
        np.testing.assert_allclose(found[name], 0.3, atol=1e-6, err_msg=name)
    for name in ("high", "fast"):
        np.testing.assert_allclose(found[name], 0.0, atol=1e-6, err_msg=name)
    assert shape.bias(moved, recorded) == pytest.approx(0.3, abs=1e-6)


def test_smoothing_agrees_with_the_eigenfunctions():
    """Low and high parts are divided elsewhere than is said: against a dense generalised eigendecomposition of libigl's
    Laplacian and lumped areas, each eigenfunction of which keeps 1 / (1 + (s k)^4). 1e-9 m on millimetres."""
    garment = sheet(8, 10)
    vertices, faces = garment.vertices.astype(np.float64), garment.faces.astype(np.int64)
    stiffness = -igl.cotmatrix(vertices, faces).toarray()
    mass = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).toarray()
    squared, modes = scipy.linalg.eigh(stiffness, mass)
    difference = np.random.default_rng(0).normal(0, 0.01, (3, len(vertices), 3))
    kept = 1.0 / (1.0 + (WAVELENGTH / (2 * np.pi)) ** 4 * squared**2)
    expected = np.stack([modes @ (kept[:, None] * (modes.T @ mass @ d)) for d in difference])
    np.testing.assert_allclose(Shape(garment).smoothed(difference), expected, atol=1e-9)


@pytest.mark.parametrize(("waves", "share"), [(1, 256 / 257), (4, 0.5), (16, 1 / 257)])
def test_waves_keep_the_share_that_is_said(waves, share):
    """The wavelength that divides low from high is another. Cosines with free ends along a sheet of 0.8 m; 3 % of the
    amplitude: the mesh's own wave numbers."""
    garment = sheet(4, 160)
    y = garment.vertices[:, 1].astype(np.float64)
    difference = np.zeros((1, len(y), 3))
    difference[0, :, 2] = 0.01 * np.cos(2 * np.pi * waves * y / 0.8)
    kept = Shape(garment).smoothed(difference)[0, :, 2] @ difference[0, :, 2] / (difference[0, :, 2] ** 2).sum()
    assert kept == pytest.approx(share, abs=0.03)


def test_jitter_is_fast_and_a_bias_turns_with_its_garment():
    """What stays behind a turning wearer is taken for jitter, or jitter for bias. The garment turns once about the
    upright axis, with an offset of 2 cm in its own axes and one of 1 cm that changes sign every frame. A mean over 31
    frames holds 16 of one sign and 15 of the other, and so -1/31 of the middle one; 1e-5 cm."""
    garment = sheet()
    rest, frames = garment.vertices.astype(np.float64), 90
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 2 * np.pi, frames), [0, 1, 0])).as_matrix()
    recorded = np.einsum("tij,vj->tvi", turns, rest)
    own = np.zeros((frames, len(rest), 3))
    own[..., 2] = 0.02
    own[..., 0] = np.where(np.arange(frames) % 2, 0.01, -0.01)[:, None]
    moved = recorded + np.einsum("tij,tvj->tvi", turns, own)
    shape = Shape(garment)
    found = shape.differences(moved, recorded)
    assert shape.bias(moved, recorded) == pytest.approx(2.0, abs=1e-5)
    middle = slice(15, 75)
    np.testing.assert_allclose(found["slow"][middle], np.hypot(2.0, 1 / 31), atol=1e-5)
    np.testing.assert_allclose(found["fast"][middle], 1.0 + 1 / 31, atol=1e-5)
    np.testing.assert_allclose(found["distance"], np.hypot(2.0, 1.0), atol=1e-5)
    still = np.linalg.norm((moved - recorded).mean(axis=0), axis=-1).mean()
    assert 100 * still < 0.1  # in the axes of the world the bias would have vanished


def test_means_over_time_take_the_frames_that_exist():
    """Ends are padded with zeros or repeated. Against a loop; 1e-12."""
    values = np.random.default_rng(1).normal(size=(23, 4, 3))
    for width in (1, 7, 31):
        half = width // 2
        expected = [values[max(t - half, 0) : t + half + 1].mean(axis=0) for t in range(23)]
        np.testing.assert_allclose(moving_mean(values, width), expected, atol=1e-12)


def test_quarters_are_of_each_garments_own_height():
    """Quarters are of the outfit's height, upside down, or divide vertices evenly. Two sheets one above the other, each
    moved by 1, 2, 3 and 4 cm from its hem upwards; no row lies on a border. 1e-6: float32 rest."""
    one = two = sheet(4, 21)
    count = len(one.vertices)
    both = Garment(
        np.concatenate([one.vertices, two.vertices + np.float32([0, 0.5, 1])]),
        np.concatenate([one.faces, two.faces + count]),
    )
    centimetres = 1 + np.digitize(one.vertices[:, 1], [0.2, 0.4, 0.6])
    recorded = both.vertices[None].astype(np.float64)
    moved = recorded.copy()
    moved[0, :, 2] += 0.01 * np.tile(centimetres, 2)
    shape = Shape(both, [slice(0, count), slice(count, 2 * count)])
    found = shape.differences(moved, recorded)
    assert [found[name][0] for name in QUARTERS] == pytest.approx([1, 2, 3, 4], abs=1e-6)
    assert found["distance"][0] == pytest.approx(centimetres.mean(), abs=1e-6)


@pytest.mark.parametrize("angle", [0.3, -1.0, 2.5])
def test_a_fold_has_its_angle(angle):
    """Bending is of another edge, in degrees, or blind to large angles. A sheet folded along one row by a known angle:
    only that row's edges bend, each by the angle; relative 1e-6, float32 rest."""
    garment = sheet(6, 10)
    rest = garment.vertices.astype(np.float64)
    folded = rest.copy()
    above = rest[:, 1] > 0.4 + 1e-6
    turn = Rotation.from_euler("x", angle).as_matrix()
    folded[above] = (rest[above] - [0, 0.4, 0]) @ turn.T + [0, 0.4, 0]
    inner = 3 * 6 * 10 - 6 - 10  # edges of the grid, without its border
    found = Shape(garment).looks(np.stack([rest, folded]))
    assert found["bending"][0] == pytest.approx(0.0, abs=1e-12)
    assert found["bending"][1] == pytest.approx(6 * angle**2 / inner, rel=1e-6)
    np.testing.assert_allclose(found["strain_1"], 0.0, atol=1e-6)


def test_bending_agrees_with_trimesh():
    """Angles or pairs of faces are wrong on a curved mesh at random: against trimesh's face adjacency, unsigned angles
    of a rest mesh that is flat. 1e-9 relative."""
    import trimesh

    garment = sheet(7, 9)
    moved = garment.vertices + np.random.default_rng(2).normal(0, 0.01, garment.vertices.shape)
    angles = trimesh.Trimesh(moved, garment.faces, process=False).face_adjacency_angles
    assert Shape(garment).looks(moved[None])["bending"][0] == pytest.approx((angles**2).mean(), rel=1e-9)


def test_strain_and_acceleration_of_known_motions():
    """Strain is squared or of faces, acceleration per frame instead of per second. Everything 5 % larger: both
    percentiles are 0.05; free fall: 9.81 m/s^2 in all frames but the ends. 1e-6: float32 rest; 1e-9."""
    garment = tube()
    rest = garment.vertices.astype(np.float64)
    time = np.arange(8) / 25.0
    falling = 1.05 * rest[None] - 0.5 * 9.81 * (time**2)[:, None, None] * np.array([0.0, 1.0, 0.0])
    found = Shape(garment, fps=25.0).looks(falling)
    np.testing.assert_allclose(found["strain_1"], 0.05, atol=1e-6)
    np.testing.assert_allclose(found["strain_99"], 0.05, atol=1e-6)
    np.testing.assert_allclose(found["acceleration"][1:-1], 9.81, rtol=1e-9)
    assert np.isnan(found["acceleration"][[0, -1]]).all()


def test_percentiles_are_of_edges():
    """One edge in twenty that is 20 % short is invisible at the 1st percentile. Against sorted edges, by hand."""
    garment = sheet(6, 10)
    moved = garment.vertices.astype(np.float64) + np.random.default_rng(3).normal(0, 0.003, garment.vertices.shape)
    ends, rest = garment.edges, garment.vertices.astype(np.float64)
    strain = [np.linalg.norm(moved[b] - moved[a]) / np.linalg.norm(rest[b] - rest[a]) - 1 for a, b in ends]
    ordered = np.sort(strain)
    found = Shape(garment).looks(moved[None])
    for name, share in (("strain_1", 0.01), ("strain_99", 0.99)):
        place = share * (len(ordered) - 1)
        below = int(place)
        expected = ordered[below] + (place - below) * (ordered[below + 1] - ordered[below])
        assert found[name][0] == pytest.approx(expected, abs=1e-12)
