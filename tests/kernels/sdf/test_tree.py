"""The trees that a CPU searches: their shape, refits, and what is found, against brute force and Warp's trees."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from reference import signed_distance as reference
from support import meshes
from support.poison import poison_outputs

from tests.support.bodies import points_around
from warpgarment.kernels import sdf
from warpgarment.kernels.sdf import tree


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def both_ways(mesh: meshes.Mesh) -> list[sdf.BodyMeshes]:
    """The body with a tree of its own, and with Warp's."""
    return [sdf.BodyMeshes(torch.tensor(mesh.vertices), torch.tensor(mesh.faces), wide=wide) for wide in (True, False)]


@pytest.mark.parametrize("sizes", [[1], [8], [9], [64, 65], [3, 700, 1, 100], [5000, 12, 513]])
def test_every_face_is_in_one_leaf(sizes):
    """A face that is in no leaf would be missing from the body; one in another body's leaf would be found by others."""
    starts = np.append(0, np.cumsum(sizes))
    shape = tree.shape_of(np.random.default_rng(0).normal(size=(starts[-1], 3)), starts.tolist())
    assert shape.nodes[0] == 0
    assert shape.nodes[-1] == len(shape.children)
    assert np.array_equal(np.nonzero(shape.node_places < 0)[0], shape.nodes[:-1])  # a root for each body, first
    found = [[] for _ in sizes]
    for leaf, faces in enumerate(shape.faces):
        node = shape.leaf_places[leaf] // tree.LANES
        assert ~shape.children[node] + shape.leaf_places[leaf] % tree.LANES == leaf
        depth = 1
        while shape.node_places[node] >= 0:
            above, lane = divmod(shape.node_places[node], tree.LANES)
            assert shape.children[above] + lane == node > above
            node, depth = above, depth + 1
        body = np.searchsorted(shape.nodes, node)
        assert shape.nodes[body] == node
        assert shape.first_face[leaf] == starts[body]
        assert tree.LANES ** (depth - 1) < max(2, -(-sizes[body] // tree.LANES)) <= tree.LANES**depth
        found[body] += faces[faces >= 0].tolist()
    assert [sorted(faces) for faces in found] == [list(range(a, b)) for a, b in pairwise(starts)]
    places = np.append(shape.leaf_places, shape.node_places[shape.node_places >= 0])
    assert len(np.unique(places)) == len(places) == len(shape.leaf_places) + len(shape.children) - len(sizes)


@pytest.mark.parametrize("name", meshes.bodies())
def test_the_same_faces_as_in_warps_trees(name):
    """On a GPU the same garment would be told another distance, or another face, than on a CPU. Bit by bit; what Warp's
    trees find is compared with libigl here, since other tests see the trees of the CPU only."""
    body = meshes.bodies()[name]
    points = points_around(body)
    unsigned = reference.unsigned_distance(points, body.vertices, body.faces)
    size = np.linalg.norm(np.ptp(body.vertices, axis=0))
    for within in (float("inf"), 0.05, 0.0):
        own, warps = (bodies.query(torch.tensor(points), within=within) for bodies in both_ways(body))
        for mine, theirs in zip(own, warps, strict=True):
            assert torch.equal(torch.nan_to_num(mine, nan=-9.0), torch.nan_to_num(theirs, nan=-9.0))
        known = np.isfinite(own.distance.numpy())
        assert np.abs(np.abs(own.distance.numpy()) - unsigned)[known].max(initial=0.0) <= 4e-7 * size


def test_a_refit_follows_each_body():
    """After a frame, points would be compared with where the body was, or with another body of the batch.

    Against brute force in float64; the tolerance is rounding of float32 at lengths of one metre.
    """
    walks = [[meshes.posed_body(p + 0.5 * t) for t in range(3)] for p in (0.0, 1.4)] + [[meshes.tetrahedron()] * 3]
    offsets = [o.tolist() for o in meshes.offsets(*(walk[0] for walk in walks))]
    packed = [meshes.joined(*poses) for poses in zip(*walks, strict=True)]
    bodies = sdf.BodyMeshes(torch.tensor(packed[0].vertices), torch.tensor(packed[0].faces), *offsets)
    for t in range(3):
        bodies.update(torch.tensor(packed[t].vertices))
        for b, walk in enumerate(walks):
            points = points_around(walk[t], 300)
            which = torch.full((300,), b, dtype=torch.int32)
            found = bodies.query(torch.tensor(points), which).distance.numpy()
            exact = reference.signed_distance(points, walk[t].vertices, walk[t].faces)
            np.testing.assert_allclose(found, exact, rtol=0, atol=1e-6)


def test_faces_that_are_not_finite_are_not_found():
    """One broken vertex of a body would hide the rest of it, or be the nearest of all."""
    ball = meshes.icosphere(2)
    bodies = sdf.BodyMeshes(torch.tensor(ball.vertices), torch.tensor(ball.faces))
    for value in (np.nan, np.inf, -np.inf):
        broken = ball.vertices.copy()
        broken[7, 1] = value
        bodies.update(torch.tensor(broken))
        points = points_around(ball, 400)
        left = ~(ball.faces == 7).any(axis=1)
        exact = reference.unsigned_distance(points, ball.vertices, ball.faces[left])
        found = bodies.query(torch.tensor(points))
        assert left[found.face.numpy()].all()
        np.testing.assert_allclose(found.distance.abs().numpy(), exact, rtol=0, atol=1e-6)


def test_slender_triangles_have_right_distances():
    """The axes of a triangle are as bad as its shape is slender: distances from it would be those from another plane.

    Triangles down to the limit of what is searched, of heights of a hundred-thousandth of their length, one by one, in
    float64 by libigl; the tolerance is 5e-7 of the distance.
    """
    rng = np.random.default_rng(2)
    points = rng.normal(size=(200, 3)).astype(np.float32)
    for height in (1e-2, 1e-3, 1e-4, 1e-5):
        for _ in range(10):
            turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [rng.uniform(-0.5, 1.5), height, 0.0]])
            corners = (rng.permutation(corners) @ turned + rng.normal(size=3)).astype(np.float32)
            faces = np.int32([[0, 1, 2]])
            found = sdf.BodyMeshes(torch.tensor(corners), torch.tensor(faces))
            exact = reference.unsigned_distance(points, corners, faces)
            frames = found.model.tree.frames.numpy().astype(float)[0, :, 0]
            assert np.isfinite(frames).all()
            origin, axes = frames[:3], frames[3:12].reshape(3, 3)
            np.testing.assert_allclose(axes @ axes.T, np.eye(3), rtol=0, atol=5e-7)
            flat = np.array([[0.0, 0.0, 0.0], [frames[12], 0.0, 0.0], [frames[13], frames[14], 0.0]])
            np.testing.assert_allclose((corners - origin) @ axes.T, flat, rtol=0, atol=2e-6)
            mine = reference.unsigned_distance((points - origin) @ axes.T, flat, faces)
            np.testing.assert_allclose(mine, exact, rtol=5e-7, atol=2e-6)
