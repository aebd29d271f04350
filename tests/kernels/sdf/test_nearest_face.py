"""Which face is named nearest, against a search of all vertices, edges and faces one by one in float64."""

import numpy as np
import pytest
import torch
import warp as wp
from reference.nearest_face import nearest_face
from support import meshes
from support.bodies import points_around
from support.poison import poison_outputs

from warpgarment.kernels import features, sdf
from warpgarment.kernels.sdf import closest
from warpgarment.kernels.sdf import nearest_face as kernel
from warpgarment.kernels.sdf.model import Bodies


def three_on_an_edge() -> meshes.Mesh:
    """A sphere with a fin on one of its edges."""
    ball = meshes.icosphere(1)
    a, b, _ = ball.faces[0]
    fin = meshes.Mesh(np.float32([[0.0, 1.2, 0.3]]), np.int32([[b, a, len(ball.vertices)]]))
    return meshes.Mesh(np.concatenate([ball.vertices, fin.vertices]), np.concatenate([ball.faces, fin.faces]))


def sieve() -> meshes.Mesh:
    """A sphere with more holes than are closed one by one."""
    ball = meshes.icosphere(3)
    return meshes.Mesh(ball.vertices, ball.faces[np.random.default_rng(0).random(len(ball.faces)) < 0.5])


# Bent where they had quadrilaterals: which way float32 vertices fold the two halves of a flat one is chance.
BODIES = {
    "tetrahedron": meshes.tetrahedron(),
    "icosphere": meshes.icosphere(2),
    "posed_body": meshes.moved(meshes.posed_body(1.0), 1),
    "open_skirt": meshes.moved(meshes.skirt(), 2),
    "open_tetrahedron": meshes.Mesh(meshes.tetrahedron().vertices, meshes.tetrahedron().faces[1:]),
    "three_on_an_edge": three_on_an_edge(),
    "sieve": sieve(),
}


def shuffled(mesh: meshes.Mesh, seed: int = 0) -> meshes.Mesh:
    """The same faces in another order, so that neighbours have no neighbouring indices."""
    return meshes.Mesh(mesh.vertices, mesh.faces[np.random.default_rng(seed).permutation(len(mesh.faces))])


def points_over(mesh: meshes.Mesh, count: int, seed: int = 0) -> np.ndarray:
    """Points around a mesh, and as many each over its edges and its vertices, outside where it is convex."""
    rng = np.random.default_rng(seed)
    vertices = mesh.vertices.astype(float)
    size = np.ptp(vertices, axis=0).max()
    a, b, c = vertices[mesh.faces.T]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    outward = np.zeros_like(vertices)
    np.add.at(outward, mesh.faces, np.repeat(normal[:, None], 3, axis=1))
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    anywhere = rng.uniform(vertices.min(0) - 0.1 * size, vertices.max(0) + 0.1 * size, (count, 3))
    height, along = rng.uniform(0.0, 0.1 * size, (2, count, 1)), rng.random((count, 1))
    at = mesh.faces[rng.integers(0, len(mesh.faces), count)]
    on_edge = along * vertices[at[:, 0]] + (1.0 - along) * vertices[at[:, 1]]
    over_edge = on_edge + height[0] * (outward[at[:, 0]] + outward[at[:, 1]])
    over_vertex = vertices[at[:, 2]] + height[1] * outward[at[:, 2]]
    return np.concatenate([anywhere, over_edge, over_vertex]).astype(np.float32)


def asked(mesh: meshes.Mesh, points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distance, closest point, face and barycentric coordinates."""
    bodies = sdf.BodyMeshes(torch.tensor(mesh.vertices), torch.tensor(mesh.faces))
    body, within = torch.zeros(len(points), dtype=torch.int32), torch.full((1,), float("inf"))
    return tuple(t.numpy() for t in closest.query_bodies(bodies.argument, torch.tensor(points), body, within))


@pytest.mark.parametrize("name", BODIES)
def test_the_smallest_of_equally_near_faces_is_named(name, monkeypatch):
    """Rounding would decide which of two faces carries the cloth over their edge.

    All points count, but for those as near to somewhere else on the body, to float32 rounding.
    """
    mesh = shuffled(BODIES[name])
    points = points_over(mesh, 150)
    expected = nearest_face(points, mesh.vertices, mesh.faces)
    poisoned = poison_outputs(monkeypatch)
    _distance, position, face, weights = asked(mesh, points)
    assert len(poisoned) == 2 + 4  # the tree, and the results
    counts = expected.rival > 1e-6
    assert counts.mean() > 0.9
    np.testing.assert_array_equal(face[counts], expected.face[counts])
    assert (expected.corners[counts] == 1).sum() > 20
    assert (expected.corners[counts] == 2).sum() > 50

    assert (weights > -1e-4).all()  # as in the tests of distances
    rebuilt = np.einsum("nk,nkj->nj", weights.astype(float), mesh.vertices[mesh.faces[face]])
    away = np.abs(rebuilt - position).max(axis=1)
    assert away.max() < 1e-3
    # A search in float32 comes back with a point on another face where that is only nearly as near.
    assert (away < 1e-6).mean() > 0.95


@wp.kernel(enable_backward=False)
def name_faces(
    bodies: wp.array[Bodies],
    found: wp.array[wp.int32],
    points: wp.array[wp.vec3],
    named: wp.array[wp.int32],
):
    """What the rule makes of a face that was found."""
    i = wp.tid()
    named[i] = kernel.named_face(bodies, 0, found[i], points[i])


def test_it_does_not_matter_which_neighbour_was_found():
    """A float32 search returns any of the faces next to the nearest point; close to where a face, an edge and a vertex
    meet, the rule would be applied to the wrong one of them. From all faces that touch the nearest one."""
    mesh = shuffled(meshes.icosphere(1))
    rng = np.random.default_rng(1)
    pick = rng.integers(0, len(mesh.vertices), 60)
    off = rng.normal(size=(60, 3)) * 10.0 ** rng.uniform(-7.0, -2.0, (60, 1))  # to either side of these borders
    over = mesh.vertices[pick] * (1.0 + rng.uniform(0.02, 0.3, (60, 1))) + off
    points = np.concatenate([over, points_over(mesh, 40)])
    points = points[np.linalg.norm(points, axis=1) > 0.51].astype(np.float32)
    expected = nearest_face(points, mesh.vertices, mesh.faces).face
    touching = (mesh.faces[:, None, :, None] == mesh.faces[None, :, None, :]).any(axis=(2, 3))
    found, which = touching[:, expected].nonzero()
    assert len(found) > 10 * len(points)
    bodies = sdf.BodyMeshes(torch.tensor(mesh.vertices), torch.tensor(mesh.faces))
    named = wp.full(len(found), -99, dtype=wp.int32)
    inputs = [bodies.argument, wp.array(found.astype(np.int32)), wp.array(points[which], dtype=wp.vec3)]
    wp.launch(name_faces, dim=len(found), inputs=inputs, outputs=[named])
    np.testing.assert_array_equal(named.numpy(), expected[which])


def test_batched_and_alone_the_same_faces_are_named():
    """A rollout would depend on the batch it is in: its garments differ by rounding from those alone, and so does the
    tree of a body that was built at another time. On bodies that walk, so that the wrong face moves otherwise.

    Bit for bit, points moved by a unit in their last place included.
    """
    walks = [[shuffled(meshes.moved(meshes.posed_body(p + 0.2 * t), 1), 2) for t in range(4)] for p in (0.3, 1.7)]
    joined = [meshes.joined(*pair) for pair in zip(*walks, strict=True)]
    offsets = [o.tolist() for o in meshes.offsets(walks[0][0], walks[1][0])]
    packed = sdf.BodyMeshes(torch.tensor(joined[0].vertices), torch.tensor(joined[0].faces), *offsets)
    rng = np.random.default_rng(3)
    for t in range(1, 3):
        packed.update(torch.tensor(joined[t].vertices))
        points = [points_around(walk[t], 3000, seed=t) for walk in walks]
        body = torch.arange(2, dtype=torch.int32).repeat_interleave(3000)
        after = torch.tensor(joined[t + 1].vertices)
        together = features.body_interaction(torch.tensor(np.concatenate(points)), body, packed, after)
        for b, walk in enumerate(walks):
            weights = asked(walk[t], points[b])[3]
            assert (weights.min(axis=1) < 1e-6).sum() > 500  # many points are over edges and vertices
            alone = sdf.BodyMeshes(torch.tensor(walk[t].vertices), torch.tensor(walk[t].faces))
            nudged = np.nextafter(points[b], rng.choice([-np.inf, np.inf], points[b].shape).astype(np.float32))
            found = features.body_interaction(torch.tensor(nudged), None, alone, torch.tensor(walk[t + 1].vertices))
            mine = body == b
            assert torch.equal(together.face[mine] - offsets[1][b], found.face)
            assert torch.equal(together.deformation[mine], found.deformation)
            assert torch.equal(together.velocity[mine], found.velocity)


def test_slivers_are_not_named():
    """A face without area has no motion to speak of; here two come first, along an edge."""
    body = meshes.tetrahedron()
    a, b, _ = body.faces[1]
    middle = 0.5 * (body.vertices[[a]] + body.vertices[[b]])  # exactly on the edge
    mesh = meshes.Mesh(
        np.concatenate([body.vertices, middle]), np.concatenate([np.int32([[a, 4, b], [a, a, b]]), body.faces])
    )
    points = np.concatenate([middle * 1.5, body.vertices[[a, b]] * np.float32(1.5)])
    expected = nearest_face(points, mesh.vertices, mesh.faces)
    assert expected.face.min() > 1
    np.testing.assert_array_equal(asked(mesh, points)[2], expected.face)


def test_bodies_of_the_same_faces_share_their_rings():
    """Two hundred bodies would take the memory of two hundred, or a body get the rings of one with other faces."""
    parts = [meshes.posed_body(0.3), shuffled(meshes.posed_body(0.3), 1), meshes.posed_body(1.1)]
    joined = meshes.joined(*parts)
    bodies = sdf.BodyMeshes(
        torch.tensor(joined.vertices), torch.tensor(joined.faces), *[o.tolist() for o in meshes.offsets(*parts)]
    )
    count = len(parts[0].faces)
    assert bodies.model.ring_offsets.numpy().tolist() == [0, count, 0]
    expected = np.concatenate([kernel.rings_of(part.faces) for part in parts[:2]])
    np.testing.assert_array_equal(bodies.model.rings.numpy(), expected)
