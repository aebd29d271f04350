"""If these failed, large garments would train and move with other weights than the manifold heads' formula says."""

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix
from scipy.sparse import random as random_matrix
from support.surfaces import MESHES, exact_distances, flat, skirt

from warpgarment.geometry.geodesics import face_geodesics
from warpgarment.geometry.pooled_geodesics import NEAR, PooledGeodesics, _furthest_points, pooled_geodesics
from warpgarment.nn.attention import ManifoldAwareAttention, geodesic_weights
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.layout import Bags, bag_product, dense_weights, pooled_weights
from warpgarment.nn.rows import padded_views
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

CPU = torch.device("cpu")


def softmax(distances, radius, power):
    """Equation 1, dense, in float64."""
    kernel = np.exp(-((distances.astype(np.float64) / radius) ** power))
    return kernel / kernel.sum(axis=1, keepdims=True)


def interpolation(garment: PooledGeodesics) -> np.ndarray:
    """P as a dense matrix, float64."""
    result = np.zeros((len(garment.nearest), len(garment.distances)))
    np.add.at(result, (np.arange(len(result))[:, None], garment.nearest), garment.weight.astype(np.float64))
    return result


@pytest.fixture(scope="module")
def cloth():
    """A rippled skirt of 1,920 faces with all its centres' distances, and the dense matrix."""
    vertices, faces = skirt(60, 16, None, 0.03)
    return vertices, faces, pooled_geodesics(vertices, faces, 600), face_geodesics(vertices, faces)


def test_operator_is_the_product_and_its_gradient_the_transposed_one():
    """Values would go to other faces than the weights say, or learn from others. Float64, against SciPy: 1e-12."""
    rng = np.random.default_rng(0)
    matrix = csr_matrix(random_matrix(40, 15, 0.2, random_state=1, dtype=np.float64))
    matrix.data[matrix.indptr[3] : matrix.indptr[4]] = 0.0  # a padded row
    matrix.eliminate_zeros()
    x = torch.tensor(rng.standard_normal((15, 7)), requires_grad=True)
    bags, transposed = Bags.of(matrix, CPU), Bags.of(matrix.T.tocsr(), CPU)
    y = bag_product(x, bags, transposed)
    np.testing.assert_allclose(y.detach().numpy(), matrix @ x.detach().numpy(), atol=1e-12)
    assert (y[3] == 0).all()
    towards = torch.tensor(rng.standard_normal((40, 7)))
    (gradient,) = torch.autograd.grad(y, x, towards)
    np.testing.assert_allclose(gradient.numpy(), matrix.T @ towards.numpy(), atol=1e-12)
    assert torch.autograd.gradcheck(lambda v: bag_product(v, bags, transposed), (x,))


def test_spread_is_the_formula(cloth):
    """Rows of a batch would mix: two garments and two subsets, padded, against dense float64 matrices.

    Both sides use the same P and D_c; the kernel is taken in float32, like the distances: 2e-6.
    """
    _, _, garment, _ = cloth
    other = pooled_geodesics(*flat(9, 8), 60)
    rows = [(garment, np.arange(0, 1920, 5)), (other, np.arange(144)), (garment, np.arange(2, 1920, 7))]
    weights = pooled_weights(rows, 0.2, 2.0, CPU, torch.float64)
    value = torch.tensor(np.random.default_rng(0).standard_normal((3, 384, 4)), requires_grad=True)
    result = weights.spread(value)
    for i, (pooled, subset) in enumerate(rows):
        p = interpolation(pooled)[subset]
        kernel = p @ np.exp(-((pooled.distances / np.float32(0.2)).astype(np.float64) ** 2)) @ p.T
        expected = kernel / kernel.sum(axis=1, keepdims=True) @ value[i, : len(subset)].detach().numpy()
        np.testing.assert_allclose(result[i, : len(subset)].detach().numpy(), expected, atol=2e-6)
        assert (result[i, len(subset) :] == 0).all()
    small = pooled_weights([(other, np.arange(0, 144, 9))], 0.2, 2.0, CPU, torch.float64)
    assert torch.autograd.gradcheck(small.spread, (value[:1, :16].detach().requires_grad_(),))


def test_one_garment_many_times(cloth):
    """A batch that shares a garment would go another way than one row at a time. 1e-5: float32, another order."""
    _, _, garment, _ = cloth
    weights = pooled_weights([(garment, np.arange(1920))], 0.15, 2.0, CPU)
    value = torch.randn(3, 1920, 8, generator=torch.Generator().manual_seed(0))
    together = weights.spread(value)
    for i in range(3):
        torch.testing.assert_close(together[i : i + 1], weights.spread(value[i : i + 1]), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("radius", "power"), [(0.15, 2.0), (1.0, 20.0)])
def test_comes_closer_to_the_dense_softmax_with_more_centres(cloth, radius, power):
    """Pooled weights would not be the manifold heads', however many centres there are.

    Row-wise L1 against the dense softmax in float64. Interpolation of a smooth kernel by quadratics errs with the third
    power of the spacing, where two ways around a tube are equally long with the second; so four times as many centres
    (half the spacing) must bring the mean down to a quarter. How close 4,096 come is a measurement, not a test.
    """
    vertices, faces, _, dense = cloth
    error = []
    for count in (200, 800):
        found = dense_weights(pooled_geodesics(vertices, faces, count), np.arange(1920), radius, power, CPU).numpy()
        error.append(np.abs(found - softmax(dense, radius, power)).sum(axis=1).mean())
    assert error[1] < error[0] / 4


@pytest.mark.parametrize(("name", "count"), [("rippled skirt", 60), ("irregular", 60), ("bumpy", 70), ("sphere", 80)])
def test_distances_between_centres_are_near_exact_ones(name, count):
    """Chains over centres would be off by more than 5 %, or shorter than any way (relative 1e-5: float32 sums).

    Exact geodesics by pygeodesic, from every sixth centre to all.
    """
    vertices, faces = MESHES[name]()
    centroids = vertices.astype(np.float32).astype(np.float64)[faces].mean(axis=1)
    centres, _ = _furthest_points(centroids, faces, count)
    assert len(centres) == count
    exact = exact_distances(vertices, faces, centres[::6])[:, centres]
    found = pooled_geodesics(vertices, faces, count).distances[::6]
    others = np.arange(count)[None] != np.arange(0, count, 6)[:, None]
    assert (found[~others] == 0).all()
    ratio = found[others] / exact[others]
    assert ratio.min() > 1 - 1e-5
    assert ratio.max() < 1.05


def test_every_row_of_the_interpolation_sums_to_one_and_pieces_stay_apart():
    """A face would be lost, or one piece would listen to another."""
    vertices, faces = skirt(30, 8, None, 0.03)
    count = len(faces)
    both = pooled_geodesics(np.concatenate([vertices, vertices]), np.concatenate([faces, faces + len(vertices)]), 150)
    assert both.nearest.shape == (2 * count, NEAR)
    np.testing.assert_allclose(both.weight.sum(axis=1), 1.0, atol=1e-5)
    weights = dense_weights(both, np.arange(2 * count), 0.5, 2.0, CPU)
    assert (weights[:count, count:] == 0).all()
    assert (weights[count:, :count] == 0).all()
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(2 * count), atol=1e-4, rtol=0)


def test_views_pool_large_garments_and_leave_small_ones_as_they_are(monkeypatch):
    """A large garment would still make a matrix of F x F, or a small one lose its exact weights; and splits of a pooled
    garment would meet the wrong faces."""
    monkeypatch.setattr("warpgarment.objects.garment.POOLED", 300)
    large, small = Garment(*skirt(24, 8, None, 0.03)), Garment(*skirt(16, 6, None))
    packed = PackedGarments.pack([large, small, large], CPU)
    config = NetworkConfig.small()
    for splits in (1, 3):
        views = padded_views(packed, [large, small, large], config, splits)
        dense = [view for view in views if isinstance(view.weights, torch.Tensor)]
        pooled = [view for view in views if not isinstance(view.weights, torch.Tensor)]
        assert sum(view.face_index.shape[0] for view in pooled) == 2 * splits
        assert "geodesics" not in vars(large)
        for view in dense:
            faces = view.face_index[0] - packed.face_offsets[1]
            exact = torch.from_numpy(small.geodesics)[faces][:, faces]
            assert torch.equal(view.weights[0], geodesic_weights(exact, 0.15, 2.0))
        for view in pooled:
            value = torch.randn(*view.face_index.shape, 3, generator=torch.Generator().manual_seed(0))
            result = view.weights.spread(value)
            for row in range(len(value)):
                real = slice(None) if view.face_mask is None else view.face_mask[row]
                faces = view.face_index[row][real].numpy() % len(large.faces)
                if view.face_index[row][real][0] >= packed.face_offsets[2]:
                    faces = view.face_index[row][real].numpy() - packed.face_offsets[2]
                expected = dense_weights(large.pooled_geodesics, faces, 0.15, 2.0, CPU) @ value[row][real]
                torch.testing.assert_close(result[row][real], expected, atol=1e-5, rtol=1e-4)


def test_attention_takes_pooled_weights(cloth):
    """The manifold heads would treat pooled weights differently, or let no gradient through: output and gradient are
    those of the same weights as a matrix, to float32 rounding."""
    _, _, garment, _ = cloth
    torch.manual_seed(0)
    layer = ManifoldAwareAttention(16, 4, 2, 0.0)
    subset = np.arange(0, 1920, 6)
    matrix = dense_weights(garment, subset, 0.15, 2.0, CPU)[None]
    pooled = pooled_weights([(garment, subset)], 0.15, 2.0, CPU)
    x = torch.randn(1, len(subset) + 1, 16)
    found = []
    for weights in (matrix, pooled):
        tokens = x.clone().requires_grad_()
        output = layer(tokens, weights, None)
        found.append((output, *torch.autograd.grad(output.square().sum(), [tokens, layer.qkv.weight])))
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, atol=2e-4, rtol=1e-4)
