"""Inside or outside by rays and caps, against libigl's exact winding numbers."""

import numpy as np
import pytest
import torch
import warp as wp
from reference import signed_distance as reference
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels import sdf
from warpgarment.kernels.mesh.caps import caps_of
from warpgarment.kernels.sdf import inside

OPEN_TETRAHEDRON = meshes.Mesh(meshes.tetrahedron().vertices, meshes.tetrahedron().faces[1:])


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


@wp.kernel(enable_backward=False)
def count_crossings(
    mesh: wp.uint64, points: wp.array[wp.vec3], axis: wp.int32, side: wp.float32, out: wp.array[wp.int32]
):
    """One ray per point."""
    i = wp.tid()
    out[i] = inside.crossings(mesh, points[i], axis, side)


def pierced_body() -> meshes.Mesh:
    """The posed figure without a patch of each of its parts, as colliders are without hands."""
    body = meshes.posed_body(1.0)
    low = body.vertices[body.faces, 1].mean(1)
    keep = np.ones(len(body.faces), bool)
    keep[np.argsort(low)[:10]] = False
    keep[np.argsort(low)[-10:]] = False
    keep[200:206] = False
    return meshes.Mesh(body.vertices, body.faces[keep])


def soup(count: int = 900) -> meshes.Mesh:
    """A closed sphere, no two of whose triangles share a vertex: more caps than are searched one by one."""
    ball = meshes.icosphere(3, 0.5)
    assert count < len(ball.faces)
    corners = ball.vertices[ball.faces[:count]].reshape(-1, 3)
    return meshes.Mesh(corners, np.arange(3 * count, dtype=np.int32).reshape(-1, 3))


def three_on_an_edge() -> meshes.Mesh:
    """A sphere with a fin: an edge with three faces, another orientation of some of them."""
    ball = meshes.icosphere(1, 0.5)
    a, b, _ = ball.faces[0]
    fin = np.float32([[0.0, 1.2, 0.3]])
    faces = np.concatenate([ball.faces, [[b, a, len(ball.vertices)]], ball.faces[5:8, ::-1]])
    return meshes.Mesh(np.concatenate([ball.vertices, fin]), faces.astype(np.int32))


BODIES = {
    **meshes.bodies(),
    "open_tetrahedron": OPEN_TETRAHEDRON,
    "pierced_body": pierced_body(),
    "three_on_an_edge": three_on_an_edge(),
    "inside_out": meshes.Mesh(meshes.icosphere(2).vertices, meshes.icosphere(2).faces[:, ::-1].copy()),
}


def aligned_points(mesh: meshes.Mesh, count: int, seed: int) -> np.ndarray:
    """Points whose rays go through vertices and along edges and faces: coordinates of vertices, mixed."""
    rng = np.random.default_rng(seed)
    points = mesh.vertices[rng.integers(0, len(mesh.vertices), count)].copy()
    axis = rng.integers(0, 3, count)
    low, high = mesh.vertices.min(0) - 0.2, mesh.vertices.max(0) + 0.2
    points[np.arange(count), axis] = rng.uniform(low[axis], high[axis])
    return points.astype(np.float32)


def random_points(mesh: meshes.Mesh, count: int, seed: int) -> np.ndarray:
    """Points in a box around the mesh."""
    rng = np.random.default_rng(seed)
    return rng.uniform(mesh.vertices.min(0) - 0.2, mesh.vertices.max(0) + 0.2, (count, 3)).astype(np.float32)


@pytest.mark.parametrize("name", ["tetrahedron", "overlapping_spheres", "posed_body", "two_spheres", "inside_out"])
def test_every_ray_counts_the_winding_number(name):
    """A ray that slips through an edge, or meets a vertex twice, would put a point on the wrong side."""
    body = BODIES[name]
    points = np.concatenate([random_points(body, 400, 0), aligned_points(body, 600, 1)])
    far = reference.unsigned_distance(points, body.vertices, body.faces) > 1e-6  # nearer, rounding decides
    points = points[far]
    exact = np.rint(reference.winding_number(points, body.vertices, body.faces))
    mesh = wp.Mesh(wp.array(body.vertices, dtype=wp.vec3), wp.array(body.faces.ravel(), dtype=wp.int32))
    at, out = wp.array(points, dtype=wp.vec3), wp.empty(len(points), dtype=wp.int32)
    for axis in range(3):
        for side in (1.0, -1.0):
            out.fill_(-99)
            wp.launch(count_crossings, dim=len(points), inputs=[mesh.id, at, axis, side], outputs=[out])
            assert np.array_equal(out.numpy(), exact), (axis, side)


@pytest.mark.parametrize("name", BODIES)
def test_caps_close_bodies(name):
    """A hole left open would turn the crossing number of a ray through it into nonsense."""
    body = BODIES[name]
    caps = caps_of(body.faces, len(body.vertices))
    together = np.concatenate([body.faces, caps.triangles])
    net = np.zeros((len(body.vertices),) * 2, int)
    for k in range(3):
        np.add.at(net, (together[:, k], together[:, (k + 1) % 3]), 1)
    assert np.array_equal(net, net.T)
    assert caps.loops[-1] == len(caps.triangles)
    assert caps.bodies.tolist() == [0, len(caps.loops) - 1]
    closed = name in ("tetrahedron", "overlapping_spheres", "posed_body", "two_spheres", "inside_out")
    assert (len(caps.triangles) == 0) == closed


@pytest.mark.parametrize("name", [*BODIES, "soup"])
def test_signs_are_those_of_winding_numbers(name):
    """Cloth at the mouth of a sleeve, or where limbs overlap, would be pushed to the wrong side."""
    body = soup() if name == "soup" else BODIES[name]
    points = np.concatenate([random_points(body, 1500, 2), aligned_points(body, 500, 3)])
    winding = reference.winding_number(points, body.vertices, body.faces)
    bodies = sdf.BodyMeshes(torch.tensor(body.vertices), torch.tensor(body.faces))
    distance = bodies.query(torch.tensor(points)).distance
    unsigned = reference.unsigned_distance(points, body.vertices, body.faces)
    # Caps are summed in float64, but of float32 points; Warp sums the soup's faces in groups, in float32.
    margin = 0.005 if name == "soup" else 1e-5
    certain = (np.abs(winding - 0.5) > margin) & (unsigned > 1e-6)
    assert certain.mean() > 0.9
    wrong = np.sign(distance.numpy()) != np.where(winding > 0.5, -1.0, 1.0)
    assert not wrong[certain].any()


def test_bodies_in_pieces_keep_summing():
    """The test above would not see the second way if the soup went the first."""
    body = soup()
    caps = caps_of(body.faces, len(body.vertices))
    assert len(caps.triangles) > inside.MOST_CAPS
    bodies = sdf.BodyMeshes(torch.tensor(body.vertices), torch.tensor(body.faces))
    assert bodies.model.scattered.numpy().tolist() == [1]


def test_packed_bodies_have_their_own_caps():
    """A hole in one body of a batch would be closed in another."""
    parts = [BODIES["open_tetrahedron"], BODIES["posed_body"], BODIES["pierced_body"], BODIES["open_skirt"], soup()]
    joined = meshes.joined(*parts)
    vertex_offsets, face_offsets = meshes.offsets(*parts)
    bodies = sdf.BodyMeshes(
        torch.tensor(joined.vertices), torch.tensor(joined.faces), vertex_offsets.tolist(), face_offsets.tolist()
    )
    points = torch.tensor(random_points(joined, 1000, 4))
    body = torch.arange(1000, dtype=torch.int32) % len(parts)
    packed = bodies.query(points, body)
    for b, part in enumerate(parts):
        mine = body == b
        alone = sdf.BodyMeshes(torch.tensor(part.vertices), torch.tensor(part.faces)).query(points[mine])
        assert torch.equal(packed.distance[mine], alone.distance)


@pytest.mark.parametrize("name", ["posed_body", "pierced_body", "soup"])
def test_a_body_that_jumps_is_found_where_it_is(name):
    """Holes would be closed where the body was, and answers depend on where it came from."""
    body = soup() if name == "soup" else BODIES[name]
    vertices, faces = torch.tensor(body.vertices), torch.tensor(body.faces)
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    jumped = (1.3 * body.vertices @ (turn * np.sign(np.linalg.det(turn))) + rng.normal(size=3)).astype(np.float32)
    bodies = sdf.BodyMeshes(vertices, faces)
    points = random_points(meshes.Mesh(jumped, body.faces), 800, 6)
    first = bodies.query(torch.tensor(points)).distance
    bodies.update(torch.tensor(jumped))
    distance = bodies.query(torch.tensor(points)).distance.numpy()
    winding = reference.winding_number(points, jumped, body.faces)
    unsigned = reference.unsigned_distance(points, jumped, body.faces)
    assert np.abs(np.abs(distance) - unsigned).max() < 1e-6  # float32 at 3 m
    certain = (np.abs(winding - 0.5) > 0.005) & (unsigned > 1e-6)
    assert np.array_equal((distance < 0)[certain], (winding > 0.5)[certain])
    bodies.update(vertices)
    assert torch.equal(bodies.query(torch.tensor(points)).distance, first)


@pytest.mark.parametrize("name", ["overlapping_spheres", "posed_body", "pierced_body", "open_skirt", "soup"])
def test_looking_no_further_changes_nothing_near(name, poisoned):
    """A contact would be missed, or found elsewhere, because the search was kept short."""
    body = soup() if name == "soup" else BODIES[name]
    bodies = sdf.BodyMeshes(torch.tensor(body.vertices), torch.tensor(body.faces))
    points = torch.tensor(np.concatenate([random_points(body, 700, 7), body.vertices[:300] * np.float32(1.01)]))
    full = bodies.query(points)
    each = torch.tensor(np.random.default_rng(8).uniform(0.0, 0.1, len(points)).astype(np.float32))
    for within in (0.0, 0.004, 0.05, float("inf"), each):
        poisoned.clear()
        found = bodies.query(points, within=within)
        assert len(poisoned) == 4
        near = full.distance < within
        assert torch.equal(found.distance[near], full.distance[near])
        assert torch.equal(found.closest[near], full.closest[near])
        assert torch.equal(found.face[near], full.face[near])
        assert (found.distance[~near] == float("inf")).all()
        assert (found.face[~near] == -1).all()
        assert torch.isnan(found.closest[~near]).all()
        assert near.any()
    nowhere = bodies.query(torch.full((1, 3), float("nan")), within=0.1)
    assert torch.isnan(nowhere.distance).all()
    with pytest.raises(ValueError, match="within"):
        bodies.query(points, within=each[1:])
