"""Nearest points and separating directions of triangles, beside the twin in float64 and ipctk."""

import ipctk
import numpy as np
import pytest
import warp as wp

from tests.reference import cloth as reference
from warpgarment.kernels.cloth.triangles import nearest_points, separating


@wp.kernel(enable_backward=False)
def measure(
    p: wp.array[wp.mat33],
    q: wp.array[wp.mat33],
    squared: wp.array[wp.float32],
    weights: wp.array2d[wp.vec3],
    normal: wp.array[wp.vec3],
):
    i = wp.tid()
    found = nearest_points(p[i], q[i])
    squared[i] = wp.float32(found.squared)
    weights[i, 0] = wp.vec3(found.weights_p)
    weights[i, 1] = wp.vec3(found.weights_q)
    normal[i] = separating(p[i], q[i])


def measured(p, q):
    count = len(p)
    squared = wp.full(count, np.nan, dtype=wp.float32, device="cpu")
    weights, normal = wp.empty((count, 2), dtype=wp.vec3, device="cpu"), wp.empty(count, dtype=wp.vec3, device="cpu")
    given = [wp.array(t.astype(np.float32), dtype=wp.mat33, device="cpu") for t in (p, q)]
    wp.launch(measure, count, inputs=[*given, squared, weights, normal], device="cpu")
    return squared.numpy(), weights.numpy(), normal.numpy()


def random_pairs(count, apart, seed):
    rng = np.random.default_rng(seed)
    p, q = rng.normal(0, 0.02, (2, count, 3, 3))
    return p.astype(np.float32), (q + apart * rng.normal(0, 1, (count, 1, 3))).astype(np.float32)


@pytest.mark.parametrize("apart", [0.01, 0.05])
def test_distance_is_that_of_ipctk(apart):
    """A bound would be larger than the distance it stands for. ipctk's vertex-face and edge-edge distances in float64;
    0.5 um, float32 at a few centimetres."""
    p, q = random_pairs(500, apart, 0)
    squared, weights, _ = measured(p, q)
    for k, (a, b) in enumerate(zip(p.astype(float), q.astype(float), strict=True)):
        least = min(
            *(ipctk.point_triangle_distance(a[i], *b) for i in range(3)),
            *(ipctk.point_triangle_distance(b[i], *a) for i in range(3)),
            *(ipctk.edge_edge_distance(a[i], a[i - 1], b[j], b[j - 1]) for i in range(3) for j in range(3)),
        )
        assert np.sqrt(squared[k]) == pytest.approx(np.sqrt(least), abs=5e-7)
        between = np.linalg.norm(weights[k, 0] @ a - weights[k, 1] @ b)
        assert between == pytest.approx(np.sqrt(least), abs=5e-7)
    assert weights.min() >= 0.0
    assert np.abs(weights.sum(2) - 1).max() < 1e-5


def test_disjoint_triangles_are_separated_and_crossing_ones_are_not():
    """A crossing would not be counted, or a free pair held. The twin in float64 and a test of edges against faces agree
    with it, but for pairs within 10 um."""
    p, q = random_pairs(2000, 0.02, 1)
    normal = measured(p, q)[2].astype(float)
    p, q = p.astype(float), q.astype(float)
    crossing = np.array([reference.crosses(a, b) for a, b in zip(p, q, strict=True)])
    twin = reference.separating(p, q)
    near = (np.linalg.norm(np.subtract(*reference.nearest(p, q)), axis=1) < 1e-5) & ~crossing
    assert 200 < crossing.sum() < 1800
    assert (normal.any(1) == ~crossing)[~near].all()
    assert (twin.any(1) == ~crossing)[~near].all()
    free = ~crossing & ~near
    assert (reference.gap(p, q, normal)[free] > 0).all()
    assert np.abs(reference.gap(p, q, normal) - reference.gap(p, q, twin))[free].max() < 2e-6


def test_degenerate_triangles_give_no_number_that_is_not_finite():
    """A face without area would make a whole outfit NaN."""
    flat = np.zeros((3, 3, 3), np.float32)
    flat[1] = [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    other = flat + np.float32([0, 0.5, 0])
    squared, _, normal = measured(flat, other)
    assert np.isfinite(squared).all()
    assert np.isfinite(normal).all()
    assert squared == pytest.approx(0.25)
