"""Signed distances against libigl in float64: exact distances, exact winding numbers."""

import numpy as np
import pytest
import torch
import trimesh
from reference import signed_distance as reference
from reference.finite_differences import numeric_gradient
from support import meshes
from support.poison import poison_outputs

from tests.support.bodies import points_around
from warpgarment.kernels import sdf

BODIES = meshes.bodies()


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def tensors(mesh: meshes.Mesh) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and faces."""
    return torch.tensor(mesh.vertices), torch.tensor(mesh.faces)


@pytest.mark.parametrize("scale", meshes.SCALES)
@pytest.mark.parametrize("name", BODIES)
def test_agrees_with_libigl(name, scale, poisoned):
    """Cloth would be told it is outside when it is inside, or pushed to a point that is not the nearest."""
    body = BODIES[name].scaled(scale)
    points = points_around(body)
    size = np.linalg.norm(np.ptp(body.vertices, axis=0))
    distance, closest, face = (t.numpy() for t in sdf.signed_distance(torch.tensor(points), *tensors(body)))
    assert len(poisoned) == 2 + 4  # the tree, and the results

    # Positions are float32: half a unit in the last place of coordinates up to 1.3 times the size, a few times over.
    tolerance = 4e-7 * size
    unsigned = reference.unsigned_distance(points, body.vertices, body.faces)
    assert np.abs(np.abs(distance) - unsigned).max() <= tolerance
    assert np.abs(np.linalg.norm(points - closest.astype(float), axis=1) - unsigned).max() <= tolerance

    winding = reference.winding_number(points, body.vertices, body.faces)
    # Only a body with holes has points between 0 and 1; what its holes take away is summed in float64. On the surface,
    # the sign is a matter of rounding.
    certain = (np.abs(winding - 0.5) > 1e-5) & (unsigned > tolerance)
    assert certain.mean() > 0.98
    assert np.array_equal(np.sign(distance[certain]), np.where(winding > 0.5, -1.0, 1.0)[certain])

    weights = reference.barycentric(closest, body.vertices[body.faces[face]])
    assert (weights > -1e-4).all()  # in the reported face: its edge is up to 1e4 roundings long at these sizes
    rebuilt = np.einsum("nk,nkj->nj", weights, body.vertices[body.faces[face]].astype(float))
    assert np.abs(rebuilt - closest).max() <= tolerance


def test_sign_where_surfaces_overlap():
    """Limbs of posed bodies overlap; a sign by normals is wrong there, and this test would not notice if it were
    easy."""
    body = BODIES["overlapping_spheres"]
    points = points_around(body, 6000, seed=1)
    exact = reference.signed_distance(points, body.vertices, body.faces)
    by_normals = reference.pseudonormal_distance(points, body.vertices, body.faces)
    assert (np.sign(by_normals) != np.sign(exact)).sum() > 20
    distance, _, _ = sdf.signed_distance(torch.tensor(points), *tensors(body))
    assert np.array_equal(np.sign(distance.numpy()), np.sign(exact))


@pytest.mark.parametrize("name", ["tetrahedron", "overlapping_spheres", "open_skirt"])
def test_gradient_in_points_agrees_with_finite_differences(name):
    """Collision losses would push cloth along the surface or into it."""
    body = BODIES[name]
    vertices, faces = tensors(body)
    points = points_around(body, 300, seed=2)
    weight = np.random.default_rng(0).normal(size=len(points))
    p = torch.tensor(points, requires_grad=True)
    distance, _, _ = sdf.signed_distance(p, vertices, faces)
    (distance * torch.tensor(weight, dtype=torch.float32)).sum().backward()

    step = 1e-5
    expected = np.zeros_like(points, dtype=float)
    smooth = np.ones(len(points), bool)
    before = np.sign(distance.detach().numpy())
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, behind = (
            before * reference.unsigned_distance(points + s, body.vertices, body.faces) for s in (shift, -shift)
        )
        expected[:, axis] = weight * (ahead - behind) / (2 * step)
        centre = before * reference.unsigned_distance(points, body.vertices, body.faces)
        smooth &= np.abs(ahead + behind - 2 * centre) < 1e-3 * step  # not on the medial axis, nor at the surface
    assert smooth.mean() > 0.9
    # float32 output, and a second difference of 1e-3 leaves as much error in the first
    np.testing.assert_allclose(p.grad.numpy()[smooth], expected[smooth], atol=2e-3 * np.abs(weight).max())


def test_gradient_in_body_vertices_agrees_with_finite_differences():
    """Moving the body would pull the distance the wrong way: here, every corner of a tetrahedron, inside and
    outside."""
    body = BODIES["tetrahedron"]
    points = points_around(body, 40, seed=3)
    weight = np.random.default_rng(1).normal(size=len(points))
    vertices, faces = tensors(body)
    vertices.requires_grad_()
    distance, _, _ = sdf.signed_distance(torch.tensor(points), vertices, faces)
    (distance * torch.tensor(weight, dtype=torch.float32)).sum().backward()
    expected = numeric_gradient(
        lambda v: (reference.signed_distance(points, v, body.faces) * weight).sum(), body.vertices, 1e-6
    )
    # gradients are summed in float32; differences of 1e-6 are as exact
    assert np.abs(vertices.grad.numpy() - expected).max() < 1e-6 * np.abs(expected).max()


def large_and_slender() -> dict[str, meshes.Mesh]:
    """Convex bodies, outside of which every point has one nearest point: large faces, needles, many small faces."""
    bodies = {
        "box": trimesh.creation.box((1.0, 1.6, 0.6)),
        "cylinder": trimesh.creation.cylinder(0.2, 2.0, sections=256),  # sides 5 mm wide and 2 m long
        "cone": trimesh.creation.cone(0.4, 1.5, sections=128),
        "sphere": trimesh.creation.icosphere(5, 0.5),
    }
    return {n: meshes.Mesh(m.vertices.astype(np.float32), m.faces.astype(np.int32)) for n, m in bodies.items()}


@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize("name", large_and_slender())
def test_closest_points_are_exact(name, scale):
    """Cloth is pushed off along a wrong direction: distances are flat around their minimum, and a point that is right
    to 1e-7 m in distance may be 0.5 mm off along the surface. Against libigl in float64, for points outside at
    distances of 0.001 to 1 sizes. 2e-7 of the size: rounding of float32 coordinates up to 1.6 sizes."""
    body = large_and_slender()[name].scaled(scale)
    size = np.linalg.norm(np.ptp(body.vertices, axis=0))
    rng = np.random.default_rng(5)
    middle = body.vertices.mean(0)
    corners = body.vertices[body.faces[rng.integers(0, len(body.faces), 6000)]].astype(float)
    on = np.einsum("nk,nkj->nj", rng.dirichlet(np.ones(3), len(corners)), corners)
    away = (on - middle) + 0.3 * size * rng.normal(size=on.shape)
    points = on + size * 10.0 ** rng.uniform(-3, 0, (len(on), 1)) * away / np.linalg.norm(away, axis=1, keepdims=True)
    points = points.astype(np.float32)
    points = points[reference.winding_number(points, body.vertices, body.faces) < 0.5]
    assert len(points) > 3000
    distance, closest, face = (t.numpy() for t in sdf.signed_distance(torch.tensor(points), *tensors(body)))
    expected = reference.closest_point(points, body.vertices, body.faces)
    assert np.linalg.norm(closest - expected, axis=1).max() < 2e-7 * size
    assert np.abs(distance - np.linalg.norm(points - expected, axis=1)).max() < 2e-7 * size
    for k in range(0, len(points), 40):  # it is on the face that is named, too
        on_named = reference.closest_point(points[k : k + 1], body.vertices, body.faces[face[k : k + 1]])
        assert np.linalg.norm(closest[k] - on_named) < 2e-7 * size


def test_gradients_close_to_large_faces_are_exact():
    """Coordinates in float32 of a point on a large face are 1e-7 of its size off, which turns the direction to a point
    that is 1e-4 of it away by a thousandth, and the force on cloth with it. Against float64; 1e-5: gradients are
    float32, and sums over some forty points."""
    body = large_and_slender()["cylinder"]
    vertices, faces = tensors(body)
    vertices.requires_grad_()
    rng = np.random.default_rng(6)
    sides = np.flatnonzero(np.ptp(body.vertices[body.faces][..., 2], axis=1) > 1.0)
    chosen = body.faces[rng.choice(sides, 3000)]
    corners = body.vertices[chosen].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    weights = rng.dirichlet(np.ones(3), len(corners))
    points = (np.einsum("nk,nkj->nj", weights, corners) + 2e-4 * normal).astype(np.float32)
    p = torch.tensor(points, requires_grad=True)
    distance, _, face = sdf.signed_distance(p, vertices, faces)
    distance.sum().backward()
    exact = reference.closest_point(points, body.vertices, body.faces)
    outward = points - exact
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.abs(p.grad.numpy() - outward).max() < 1e-5
    named = body.faces[face.numpy()]
    pull = np.zeros_like(body.vertices, dtype=float)
    np.add.at(pull, named, -reference.barycentric(exact, body.vertices[named])[:, :, None] * outward[:, None, :])
    assert np.abs(vertices.grad.numpy() - pull).max() < 1e-5 * np.abs(pull).max()


def test_gradient_of_closest_points():
    """Closest points ride on their faces: the gradient is the transpose of barycentric interpolation."""
    body = BODIES["posed_body"]
    points = points_around(body, 200, seed=4)
    weight = np.random.default_rng(2).normal(size=(len(points), 3))
    vertices, faces = tensors(body)
    vertices.requires_grad_()
    p = torch.tensor(points, requires_grad=True)
    _, closest, face = sdf.signed_distance(p, vertices, faces)
    (closest * torch.tensor(weight, dtype=torch.float32)).sum().backward()
    corners = body.faces[face.numpy()]
    b = reference.barycentric(closest.detach().numpy(), body.vertices[corners])
    expected = np.zeros_like(body.vertices, dtype=float)
    np.add.at(expected, corners, b[:, :, None] * weight[:, None, :])
    # b from float32 points: 1e-7 over edges of some 0.02
    assert np.abs(vertices.grad.numpy() - expected).max() < 2e-5 * np.abs(expected).max()
    assert torch.count_nonzero(p.grad) == 0


def test_gradient_on_the_surface_is_the_normal():
    """A vertex lying on the body would get no push, or NaN."""
    body = BODIES["tetrahedron"]
    points = torch.tensor(body.vertices[body.faces].mean(1), requires_grad=True)
    distance, _, face = sdf.signed_distance(points, *tensors(body))
    distance.sum().backward()
    corners = body.vertices[body.faces[face.numpy()]].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(points.grad.numpy(), normals, atol=1e-6)


def test_packed_bodies_do_not_see_each_other():
    """A garment would collide with the body of another one in its batch."""
    parts = [BODIES["posed_body"], BODIES["tetrahedron"], BODIES["overlapping_spheres"]]  # all around the origin
    vertices, faces = tensors(meshes.joined(*parts))
    vertex_offsets, face_offsets = meshes.offsets(*parts)
    bodies = sdf.BodyMeshes(vertices, faces, torch.tensor(vertex_offsets), face_offsets.tolist())
    assert bodies.count == 3
    points = torch.tensor(points_around(meshes.joined(*parts), 600))
    body = torch.tensor(np.random.default_rng(0).integers(0, 3, 600), dtype=torch.int32)
    packed = bodies.query(points, body)
    for b, part in enumerate(parts):
        mine = body == b
        alone = sdf.BodyMeshes(*tensors(part)).query(points[mine])
        assert torch.equal(packed.distance[mine], alone.distance)
        assert torch.equal(packed.closest[mine], alone.closest)
        assert torch.equal(packed.face[mine] - face_offsets[b], alone.face)


def test_update_follows_a_moving_body():
    """A walking body would be collided with where it stood in the first frame."""
    bodies = sdf.BodyMeshes(*tensors(meshes.posed_body(0.0)))
    for phase in (0.5, 1.5, 3.0):
        moved = meshes.posed_body(phase)
        bodies.update(torch.tensor(moved.vertices))
        assert torch.equal(bodies.vertices, torch.tensor(moved.vertices))
        points = points_around(moved, 800, seed=5)
        exact = reference.signed_distance(points, moved.vertices, moved.faces)
        assert np.abs(bodies.query(torch.tensor(points)).distance.numpy() - exact).max() < 1e-6  # float32 at 2 m


def test_bodies_own_their_vertices():
    """Changing the caller's array would move the body without a refit."""
    vertices, faces = tensors(BODIES["tetrahedron"])
    bodies = sdf.BodyMeshes(vertices, faces)
    before = bodies.query(torch.zeros(1, 3)).distance.item()
    vertices += 5.0
    faces.zero_()
    assert bodies.query(torch.zeros(1, 3)).distance.item() == before
    assert before == pytest.approx(-0.5 / 3**0.5, abs=1e-6)


def test_points_that_are_nowhere_say_so():
    """A vertex that blew up, or whose body is not there, must read as NaN and -1, and spoil nobody else's gradient."""
    vertices, faces = tensors(BODIES["tetrahedron"])
    points = torch.tensor([[float("nan"), 0.0, 0.0], [0.0, 2.0, 0.0]], requires_grad=True)
    vertices.requires_grad_()
    distance, closest, face = sdf.signed_distance(points, vertices, faces)
    assert torch.isnan(distance[0])
    assert torch.isnan(closest[0]).all()
    assert face[0] == -1
    distance[1].backward()
    assert torch.isfinite(points.grad).all()
    assert torch.isfinite(vertices.grad).all()
    stray = sdf.BodyMeshes(vertices, faces).query(torch.zeros(2, 3), torch.tensor([-1, 1], dtype=torch.int32))
    assert torch.isnan(stray.distance).all()
    assert (stray.face == -1).all()


def test_a_face_without_area_hides_nothing():
    """One collapsed face in a body must not make points near it lose their answer."""
    body = BODIES["overlapping_spheres"]
    vertices, faces = tensors(body)
    collapsed = torch.cat([faces, torch.tensor([[7, 7, 8], [3, 3, 3]], dtype=torch.int32)])
    points = torch.tensor(points_around(body, 400))
    plain, with_collapsed = (sdf.BodyMeshes(vertices, f).query(points) for f in (faces, collapsed))
    # The hierarchy groups faces differently: positions round differently.
    assert torch.allclose(plain.distance, with_collapsed.distance, atol=4e-7)


def test_nothing_asked_nothing_answered():
    """Without points the query would fail, or the body get a gradient that is not zero."""
    vertices, faces = tensors(BODIES["tetrahedron"])
    points = torch.zeros(0, 3, requires_grad=True)
    vertices.requires_grad_()
    distance, closest, face = sdf.signed_distance(points, vertices, faces)
    assert distance.shape == face.shape == (0,)
    assert closest.shape == (0, 3)
    distance.sum().backward()
    assert points.grad.shape == (0, 3)
    assert torch.count_nonzero(vertices.grad) == 0
    assert sdf.BodyMeshes(vertices, faces).query(points).distance.shape == (0,)


def _bad(change_vertices=None, change_faces=None):
    vertices, faces = tensors(BODIES["tetrahedron"])
    return (
        change_vertices(vertices) if change_vertices else vertices,
        change_faces(faces) if change_faces else faces,
    )


@pytest.mark.parametrize(
    ("vertices", "faces", "error", "message"),
    [
        (None, lambda f: f + 1, ValueError, r"3 of 4 body faces .*first: face 1.*0 to 3"),
        (None, lambda f: f - 1, ValueError, r"3 of 4 body faces .*first: face 0"),
        (None, lambda f: f[:0], ValueError, "no faces"),
        (lambda v: v.index_fill(0, torch.tensor([2]), float("nan")), None, ValueError, r"1 of 4 .*first: vertex 2"),
        (lambda v: v.index_fill(0, torch.tensor([1, 3]), float("inf")), None, ValueError, r"2 of 4 .*first: vertex 1"),
        (lambda v: v[:, :2], None, ValueError, "shape"),
        (lambda v: v.double(), None, TypeError, "float32"),
        (None, lambda f: f.long(), TypeError, "int32"),
    ],
)
def test_bad_bodies_are_refused(vertices, faces, error, message):
    """`wp.Mesh` takes anything: indices out of range read foreign memory, an empty mesh corrupts it."""
    body = _bad(vertices, faces)
    with pytest.raises(error, match=message):
        sdf.BodyMeshes(*body)
    with pytest.raises(error, match=message):
        sdf.signed_distance(torch.zeros(3, 3), *body)


@pytest.mark.parametrize(
    ("vertex_offsets", "face_offsets", "message"),
    [
        ([0, 4, 8], None, "both"),
        ([0, 4, 8], [0, 8], "bodies"),
        ([0, 4, 7], [0, 4, 8], "vertex_offsets must rise"),
        ([0, 4, 8], [0, 5, 4, 8], "face_offsets must rise"),
        ([0, 4, 8], [0, 0, 8], "1 of 2 bodies have no faces"),
        ([0, 4, 8], [0, 3, 8], "1 of 8 body faces .*first: face 3"),
    ],
)
def test_bad_offsets_are_refused(vertex_offsets, face_offsets, message):
    """A face of one body would be taken for another's."""
    vertices, faces = tensors(meshes.joined(BODIES["tetrahedron"], BODIES["tetrahedron"]))
    with pytest.raises(ValueError, match=message):
        sdf.BodyMeshes(vertices, faces, vertex_offsets, face_offsets)


def test_bad_questions_are_refused():
    """Wrong shapes and dtypes of points and body indices must not reach a kernel."""
    bodies = sdf.BodyMeshes(*tensors(BODIES["tetrahedron"]))
    with pytest.raises(TypeError, match="points"):
        bodies.query(torch.zeros(3, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="points"):
        bodies.query(torch.zeros(3))
    with pytest.raises(TypeError, match="int32"):
        bodies.query(torch.zeros(3, 3), torch.zeros(3, dtype=torch.int64))
    with pytest.raises(ValueError, match="body"):
        bodies.query(torch.zeros(3, 3), torch.zeros(2, dtype=torch.int32))
    with pytest.raises(ValueError, match="body vertices"):
        bodies.update(torch.zeros(3, 3))
    two = meshes.joined(BODIES["tetrahedron"], BODIES["tetrahedron"])
    bodies = sdf.BodyMeshes(*tensors(two), [0, 4, 8], [0, 4, 8])
    with pytest.raises(ValueError, match="2 bodies"):
        bodies.query(torch.zeros(3, 3))


def test_operators_keep_torch_contracts():
    """Operators would break under torch.compile, export or autograd (schema, fake shapes, backward registration)."""
    vertices, faces = tensors(BODIES["tetrahedron"])
    points = torch.tensor(points_around(BODIES["tetrahedron"], 20))
    operators = torch.ops.warpgarment
    torch.library.opcheck(
        operators.signed_distance.default, (points.requires_grad_(), vertices.requires_grad_(), faces)
    )
