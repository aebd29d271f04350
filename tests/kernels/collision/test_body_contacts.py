"""The side from which vertices went into a body: contacts and carried positions against float64 twins, and a limb that
goes through a sheet in a few frames."""

import numpy as np
import pytest
import torch
from reference import collision as reference
from reference.body_contacts import length_of_way
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels.collision.body_contacts import contacts
from warpgarment.kernels.collision.solver import CollisionSolver
from warpgarment.kernels.deformation.face_means import FaceMeans
from warpgarment.kernels.deformation.gradients import inverse_rest_frames
from warpgarment.kernels.features.carry import carried, face_at_each_vertex
from warpgarment.kernels.features.channels import LAYOUT
from warpgarment.kernels.features.frame import frame_features
from warpgarment.kernels.sdf.bodies import BodyMeshes

EPSILON = 0.004


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


def posed(count: int = 600) -> tuple[meshes.Mesh, np.ndarray, np.ndarray]:
    """A body of overlapping limbs, ends of ways in and around it, and their origins, mostly outside.

    It is a little irregular, so that no ray meets an edge.
    """
    body, rng = meshes.posed_body(), np.random.default_rng(0)
    body = meshes.Mesh(body.vertices + rng.normal(0.0, 1e-4, body.vertices.shape).astype(np.float32), body.faces)
    start = body.vertices[rng.integers(0, len(body.vertices), count)]
    end = (start + rng.normal(0.0, 0.03, (count, 3))).astype(np.float32)
    return body, end, (end + rng.normal(0.0, 0.08, (count, 3))).astype(np.float32)


def is_inside(points: np.ndarray, mesh: meshes.Mesh) -> np.ndarray:
    bodies = BodyMeshes(torch.tensor(mesh.vertices), torch.tensor(mesh.faces))
    return bodies.query(torch.tensor(points)).distance.numpy() < 0


def found(vertices: np.ndarray, bodies: BodyMeshes, owner: np.ndarray, origin: np.ndarray | None):
    points, owner = torch.tensor(vertices), torch.tensor(owner, dtype=torch.int32)
    query = bodies.query(points, owner)
    options = {"body_of_vertex": owner, "origin": None if origin is None else torch.tensor(origin)}
    normal, closest, *_ = contacts(points, query.distance, query.face, bodies, EPSILON, **options)
    return closest.numpy(), normal.numpy()


def test_vertices_past_the_middle_are_led_back_to_where_they_went_in():
    """Contacts would be with a wrong face, side, body or point.

    Against tests of all segments with all faces; two bodies.
    """
    body, end, origin = posed()
    other = meshes.Mesh(body.vertices + np.float32([0.1, 0.0, 0.05]), body.faces)
    both = meshes.joined(body, other)
    vertex_offsets, face_offsets = meshes.offsets(body, other)
    bodies = BodyMeshes(torch.tensor(both.vertices), torch.tensor(both.faces), vertex_offsets, face_offsets)
    owner = np.arange(len(end)) % 2
    closest, normal = found(end, bodies, owner, origin)
    nearest, outward = found(end, bodies, owner, None)
    redirected = 0
    for number, mesh in enumerate((body, other)):
        mine = owner == number
        point, face_normal = reference.entry(origin[mine], end[mine], mesh.vertices, mesh.faces)
        corners, ends = mesh.vertices.astype(np.float64)[mesh.faces], end[mine].astype(np.float64)
        _, surface, plain = reference.contacts(ends, mesh.vertices, mesh.faces, np.inf)
        far = is_inside(end[mine], mesh) & ((face_normal * plain).sum(1) < 0)
        plane = ends - ((ends - point) * face_normal).sum(1)[:, None] * face_normal
        starts, ways = np.where(far[:, None], plane, surface), np.where(far[:, None], face_normal, plain)
        clear = [length_of_way(u + 1e-4 * n, n, corners) is None for u, n in zip(starts, ways, strict=True)]
        same, far = clear & ~far, clear & far  # ways into another limb are the twin's matter, in test_contact_set.py
        assert np.array_equal(normal[mine][same], outward[mine][same])
        assert np.array_equal(closest[mine][same], nearest[mine][same])
        np.testing.assert_allclose(normal[mine][far], face_normal[far], atol=1e-7)
        np.testing.assert_allclose(((closest[mine] - point) * face_normal)[far].sum(1), 0.0, atol=1e-7)
        across = np.cross(closest[mine] - end[mine], face_normal)
        np.testing.assert_allclose(across[far], 0.0, atol=1e-7)
        redirected += far.sum()
    assert redirected > 20


def test_an_unknown_or_useless_origin_changes_nothing():
    """Origins that are NaN, the vertex itself or inside the body would change contacts.

    Bit for bit those without origins.
    """
    ball = meshes.icosphere(3, 0.3)
    bodies, owner = BodyMeshes(torch.tensor(ball.vertices), torch.tensor(ball.faces)), np.zeros(200)
    points = np.random.default_rng(0).uniform(-0.35, 0.35, (200, 3)).astype(np.float32)
    expected = found(points, bodies, owner, None)
    assert 20 < is_inside(points, ball).sum() < 180
    for origin in (np.full_like(points, np.nan), points, np.full_like(points, 0.01)):
        result = found(points, bodies, owner, origin)
        assert all(np.array_equal(one, two) for one, two in zip(result, expected, strict=True))
    beyond = found(points, bodies, owner, -points * 2 / np.linalg.norm(points, axis=1, keepdims=True))
    assert not np.array_equal(beyond[1], expected[1])


def features_of(garment: meshes.Mesh, bodies: BodyMeshes, next_vertices: torch.Tensor) -> torch.Tensor:
    vertices, faces = torch.tensor(garment.vertices), torch.tensor(garment.faces)
    owner = torch.zeros(len(faces), dtype=torch.int32)
    mean = FaceMeans(faces, owner, 1, len(vertices))(vertices)
    return frame_features(
        inverse_rest_frames(vertices, faces), vertices, faces, owner, mean, None, bodies, next_vertices
    )


def test_carried_is_the_motion_of_a_rigid_body():
    """A feature would be transposed or misplaced: vertices must move with a rigid body, at any nearest face."""
    skirt, body = meshes.skirt(24, 8), meshes.icosphere(3, 0.3, (0.05, 0.8, 0.0))
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.2], [0.3, 0.0, -0.1], [-0.2, 0.1, 0.0]]))
    bodies = BodyMeshes(torch.tensor(body.vertices), torch.tensor(body.faces))
    shift = torch.tensor([0.02, -0.01, 0.03])
    features = features_of(skirt, bodies, bodies.vertices @ turn.T + shift)
    vertices, faces = torch.tensor(skirt.vertices), torch.tensor(skirt.faces)
    result = carried(vertices, faces, face_at_each_vertex(faces, len(vertices)), features)
    # the velocity is that of the body face's centroid, not of the nearest point on it: a third of an edge, turned; and
    # vertices are lifted
    edge = np.linalg.norm(body.vertices[body.faces[:, 0]] - body.vertices[body.faces[:, 1]], axis=1).max()
    assert (result - (vertices @ turn.T + shift)).abs().max() < 0.4 * edge + 0.005
    assert (result - vertices).abs().max() > 0.1


def test_carried_is_its_formula():
    """Positions would not be those of the formula.

    Against float64 NumPy on a moving body; NaN for a vertex without faces.
    """
    skirt, body, later = meshes.skirt(24, 8), meshes.posed_body(0.0), meshes.posed_body(0.2)
    bodies = BodyMeshes(torch.tensor(body.vertices), torch.tensor(body.faces))
    features = features_of(skirt, bodies, torch.tensor(later.vertices))
    lone = torch.tensor(np.concatenate([skirt.vertices, [[0.0, 0.0, 0.0]]]).astype(np.float32))
    faces = torch.tensor(skirt.faces)
    face = face_at_each_vertex(faces, len(lone))
    result = carried(lone, faces, face, features).numpy()
    assert np.isnan(result[-1]).all()
    assert face[-1] == -1
    for vertex in range(len(skirt.vertices)):
        lowest = np.flatnonzero((skirt.faces == vertex).any(1))[0]
        assert face[vertex] == lowest
        row = {name: features[lowest, where].numpy().astype(np.float64) for name, where in LAYOUT.items()}
        centroid = skirt.vertices[skirt.faces[lowest]].astype(np.float64).mean(0)
        nearest = centroid + np.abs(row["signed_distance"]) * row["direction_to_body"]
        lifted = skirt.vertices[vertex] - 0.005 * np.sign(row["signed_distance"]) * row["direction_to_body"]
        away = row["body_deformation"].reshape(3, 3) @ (lifted - nearest)
        np.testing.assert_allclose(result[vertex], nearest + row["body_velocity"] + away, atol=2e-6)


@pytest.mark.parametrize("remembers", [True, False])
def test_a_limb_does_not_go_through_a_sheet(remembers):
    """The sheet would end below the limb, which is 8 cm thick and rises 5 cm per frame from 1 cm below the sheet.

    With the nearest points alone it does; with the sides on which vertices entered, it is lifted.
    """
    rest, limb = meshes.sheet_and_limb()
    bodies = BodyMeshes(torch.tensor(limb.vertices), torch.tensor(limb.faces))
    solver = CollisionSolver(torch.tensor(rest.vertices), torch.tensor(rest.faces))
    faces = torch.tensor(rest.faces)
    face, now = face_at_each_vertex(faces, len(rest.vertices)), rest
    for _ in range(3):
        later = bodies.vertices + torch.tensor([0.0, 0.05, 0.0])
        origin = carried(torch.tensor(now.vertices), faces, face, features_of(now, bodies, later))
        bodies.update(later.clone())
        options = {"origin": origin} if remembers else {}
        result = solver.refine(torch.tensor(now.vertices), bodies, epsilon=EPSILON, passes=3, **options)
        now = meshes.Mesh(result.numpy(), rest.faces)
    above = now.vertices[np.abs(now.vertices[:, 2]) < 0.02][:, 1] > bodies.vertices[:, 1].mean().item()
    assert above.all() if remembers else not above.any()
    if remembers:
        assert bodies.query(result).distance.min() > -1e-3


def two_limbs(overlap: float) -> meshes.Mesh:
    """Two upright bars side by side along x, 11 x 60 x 12 cm and 3 x 60 x 8 cm, that overlap by so much [m]."""
    corner = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - np.float32(
        [0, 0.5, 0.5]
    )
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ]
    faces = np.array([*faces, [1, 5, 7], [1, 7, 3]], np.int32)
    thigh = meshes.Mesh(corner * np.float32([0.11, 0.6, 0.12]) - np.float32([0.11, 0, 0]), faces)
    hand = meshes.Mesh(corner * np.float32([0.03, 0.6, 0.08]) - np.float32([overlap, 0.003, 0.002]), faces)
    return meshes.joined(thigh, hand)


def contacts_at(points: list[list[float]], body: meshes.Mesh, epsilon: float) -> list[np.ndarray]:
    """Normals, anchors and distances of contacts with a body at points [m]."""
    bodies, vertices = BodyMeshes(torch.tensor(body.vertices), torch.tensor(body.faces)), torch.tensor(points)
    query = bodies.query(vertices)
    return [part.numpy() for part in contacts(vertices, query.distance, query.face, bodies, epsilon)[:3]]


def test_a_contact_leads_out_of_all_parts_of_a_body():
    """Cloth between a thigh and a hand that reaches into it would be pushed from the one into the other.

    The hand is 30 mm thick and 12 mm deep in the thigh: from 2 mm below the thigh's surface the way out is through the
    hand, 20 mm. From the middle of the thigh all ways are longer than 5 cm: the contact is with the nearest surface.
    """
    body = two_limbs(0.012)
    normal, anchor, _ = contacts_at([[-0.002, 0.05, 0.01], [-0.057, 0.05, -0.001]], body, 0.004)
    np.testing.assert_allclose(normal[0], [1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(anchor[0], [0.018, 0.05, 0.01], atol=1e-5)
    np.testing.assert_allclose(anchor[1], [-0.012, 0.05, -0.001], atol=1e-5)
    bodies = BodyMeshes(torch.tensor(body.vertices), torch.tensor(body.faces))
    assert bodies.query(torch.tensor(anchor[:1] + 1e-3 * normal[:1], dtype=torch.float32)).distance[0] > 0


def test_half_of_the_room_between_two_limbs_is_kept():
    """Cloth between two limbs 6 mm apart that is to keep 4 mm from both would be pushed into the other.

    1 mm from the one it is led to the middle; next to a limb alone it keeps 4 mm.
    """
    body = two_limbs(-0.006)
    normal, anchor, kept = contacts_at([[0.001, 0.0, 0.0], [-0.111, 0.0, 0.001]], body, 0.004)
    np.testing.assert_allclose(normal, [[1, 0, 0], [-1, 0, 0]], atol=1e-5)
    np.testing.assert_allclose(kept, [0.003, 0.004], atol=1e-6)
    np.testing.assert_allclose(anchor[0], [0, 0, 0], atol=1e-6)
