"""The 34 features of a face, and what it knows of its nearest body face, against float64 NumPy and libigl."""

import numpy as np
import pytest
import torch
from reference import deformation as reference_deformation
from reference import features as reference
from reference import signed_distance as reference_distance
from reference.finite_differences import numeric_gradient
from support import meshes
from support.poison import poison_outputs

from warpgarment.kernels import deformation, features, sdf
from warpgarment.kernels.features.frame import frame_features

GARMENTS = meshes.garments()


@pytest.fixture(autouse=True)
def poisoned(monkeypatch):
    """Every output starts as NaN."""
    return poison_outputs(monkeypatch)


class Scene:
    """A garment on a moving body, as tensors."""

    def __init__(self, name: str, scale: float = 1.0) -> None:
        rest = GARMENTS[name].scaled(scale)
        self.rest, self.faces = torch.tensor(rest.vertices), torch.tensor(rest.faces)
        self.vertices = torch.tensor(meshes.moved(rest).vertices)
        self.body, self.next_body = meshes.posed_body(1.0).scaled(scale), meshes.posed_body(1.3).scaled(scale)
        self.bodies = sdf.BodyMeshes(torch.tensor(self.body.vertices), torch.tensor(self.body.faces))
        self.inverse_rest = deformation.inverse_rest_frames(self.rest, self.faces)
        self.centroids = deformation.face_centroids(self.vertices, self.faces)
        half = len(self.faces) // 2
        self.garment_of_face = (torch.arange(len(self.faces)) >= half).to(torch.int32)
        self.garment_mean = deformation.segment_mean(self.centroids, self.garment_of_face, 2)

    def interaction(self) -> features.BodyInteraction:
        """The interaction with the body at t and t+1."""
        return features.body_interaction(self.centroids, None, self.bodies, torch.tensor(self.next_body.vertices))

    def features(self, vertices, garment_mean, interaction):
        """Features by the kernel."""
        return features.face_features(
            self.inverse_rest, vertices, self.faces, self.garment_of_face, garment_mean, interaction
        )

    def twin(self, vertices, garment_mean, interaction):
        """Features by the float64 twin."""
        i = features.BodyInteraction(*(t.numpy() for t in interaction))
        arguments = (self.rest.numpy(), vertices, self.faces.numpy(), self.garment_of_face.numpy(), garment_mean)
        return reference.face_features(*arguments, i.closest, i.sign, i.deformation, i.velocity)


def test_layout_covers_every_column_once():
    """Columns would overlap or be left out when features are picked by name."""
    columns = [k for part in features.LAYOUT.values() for k in range(part.start, part.stop)]
    assert columns == list(range(features.FEATURES))
    assert list(features.LAYOUT)[:8] == [  # those of networks that are there
        "deformation_gradient", "normal", "centroid", "signed_distance", "direction_to_body",
        "body_deformation", "body_velocity", "singular_values",
    ]  # fmt: skip


@pytest.mark.parametrize("scale", meshes.SCALES)
@pytest.mark.parametrize("name", GARMENTS)
def test_interaction_agrees_with_libigl(name, scale, poisoned):
    """Cloth would follow the motion of the wrong patch of skin."""
    scene = Scene(name, scale)
    poisoned.clear()
    found = scene.interaction()
    assert len(poisoned) == 5
    body, points = scene.body, scene.centroids.numpy()
    size = np.linalg.norm(np.ptp(body.vertices, axis=0))
    tolerance = 5e-7 * size  # positions are float32, a few roundings
    exact = reference_distance.signed_distance(points, body.vertices, body.faces)
    reach = np.linalg.norm(points - found.closest.numpy().astype(float), axis=1)
    assert np.abs(reach * found.sign.numpy() - exact).max() <= tolerance
    # The face is the one the closest point lies in; where faces share it, any of them may be meant.
    face = found.face.numpy()
    weights = reference_distance.barycentric(found.closest.numpy(), body.vertices[body.faces[face]])
    assert (weights > -1e-4).all()
    gradient, velocity = reference.body_motion(body.vertices, scene.next_body.vertices, body.faces)
    np.testing.assert_allclose(found.deformation.numpy(), gradient[face], atol=1e-6)  # float64, rounded once
    np.testing.assert_allclose(found.velocity.numpy(), velocity[face], atol=2e-7 * size)


@pytest.mark.parametrize("scale", meshes.SCALES)
@pytest.mark.parametrize("name", GARMENTS)
def test_features_agree_with_numpy(name, scale, poisoned):
    """The network would be fed something else than it was trained on."""
    scene = Scene(name, scale)
    interaction = scene.interaction()
    poisoned.clear()
    ours = scene.features(scene.vertices, scene.garment_mean, interaction).numpy()
    assert len(poisoned) == 1
    expected = scene.twin(scene.vertices.numpy(), scene.garment_mean.numpy(), interaction)
    reach = np.abs(expected[:, features.LAYOUT["signed_distance"]])
    rounding = 3e-7 * np.abs(scene.body.vertices).max()  # a few float32 roundings of the longest coordinate
    tolerance = {"centroid": rounding, "signed_distance": rounding, "body_velocity": rounding}
    tolerance["direction_to_body"] = 3e-7 + rounding / reach  # a difference of positions, over its length
    for column, part in features.LAYOUT.items():
        # 3e-6: float32 roundings times the aspect ratio of the thinnest face, about 10
        assert (np.abs(ours[:, part] - expected[:, part]) <= tolerance.get(column, 3e-6)).all(), column


@pytest.mark.parametrize("name", GARMENTS)
def test_one_launch_is_the_same_as_two(name, poisoned):
    """A network trained on features made in two steps would be run on others; and twice must give the same bits."""
    scene = Scene(name)
    scene.garment_of_face[-1] = 7  # dangling
    scene.vertices[scene.faces[0, 0]] = float("nan")
    scene.centroids = deformation.face_centroids(scene.vertices, scene.faces)
    after = torch.tensor(scene.next_body.vertices)
    two = scene.features(scene.vertices, scene.garment_mean, scene.interaction())
    poisoned.clear()
    arguments = (scene.inverse_rest, scene.vertices, scene.faces, scene.garment_of_face, scene.garment_mean)
    one = frame_features(*arguments, None, scene.bodies, after)
    assert len(poisoned) == 1
    again = frame_features(*arguments, None, scene.bodies, after)
    assert torch.equal(one.view(torch.int32), again.view(torch.int32))
    np.testing.assert_array_equal(one.numpy(), two.numpy())
    assert torch.isfinite(one).all(1).any() or name == "tetrahedron"


def test_one_launch_refuses_what_two_refuse():
    """Wrong shapes and dtypes must not reach the kernel."""
    scene = Scene("tetrahedron")
    after, nothing = torch.tensor(scene.next_body.vertices), torch.zeros(4, dtype=torch.int32)
    arguments = [scene.inverse_rest, scene.vertices, scene.faces, scene.garment_of_face, scene.garment_mean]
    arguments += [nothing, scene.bodies, after]
    wrong = [
        (0, scene.inverse_rest[1:], ValueError, "inverse_rest"),
        (1, scene.vertices.double(), TypeError, "vertices"),
        (2, scene.faces.long(), TypeError, "faces"),
        (3, scene.garment_of_face[1:], ValueError, "garment_of_face"),
        (4, scene.garment_mean[0], ValueError, "garment_mean"),
        (5, nothing[1:], ValueError, "body_of_face"),
        (7, after[1:], ValueError, "next_vertices"),
    ]
    for position, value, error, word in wrong:
        with pytest.raises(error, match=word):
            frame_features(*arguments[:position], value, *arguments[position + 1 :])
    empty = [scene.inverse_rest[:0], scene.vertices, scene.faces[:0], nothing[:0], scene.garment_mean, nothing[:0]]
    assert frame_features(*empty, scene.bodies, after).shape == (0, features.FEATURES)


@pytest.mark.parametrize("name", GARMENTS)
def test_feature_gradients_agree_with_finite_differences(name):
    """Training through a rollout would follow wrong gradients."""
    scene = Scene(name)
    interaction = scene.interaction()
    weight = np.random.default_rng(0).normal(size=(len(scene.faces), features.FEATURES))
    # Direction turns by 1/distance: where cloth nearly touches, float32 positions say little about it.
    weight[reference_distance.unsigned_distance(scene.centroids.numpy(), *scene.body) < 0.02, 16:19] = 0.0
    vertices, mean = scene.vertices.clone().requires_grad_(), scene.garment_mean.clone().requires_grad_()
    (scene.features(vertices, mean, interaction) * torch.tensor(weight, dtype=torch.float32)).sum().backward()
    v, m = scene.vertices.numpy(), scene.garment_mean.numpy()
    in_vertices = numeric_gradient(lambda x: (scene.twin(x, m, interaction) * weight).sum(), v, 1e-6)
    in_mean = numeric_gradient(lambda x: (scene.twin(v, x, interaction) * weight).sum(), m, 1e-6)
    # float32 sums over the faces of a vertex; directions divide by the distance to the body
    assert np.abs(vertices.grad.numpy() - in_vertices).max() < 3e-5 * np.abs(in_vertices).max()
    assert np.abs(mean.grad.numpy() - in_mean).max() < 1e-5 * np.abs(in_mean).max()


def test_features_of_an_undeformed_garment_have_gradients():
    """All singular values are 1 at rest: NaN would enter training in the very first frame."""
    scene = Scene("skirt")
    scene.vertices = scene.rest
    vertices = scene.rest.clone().requires_grad_()
    out = scene.features(vertices, scene.garment_mean, scene.interaction())
    out.sum().backward()
    assert torch.isfinite(out).all()
    assert torch.isfinite(vertices.grad).all()
    np.testing.assert_allclose(out[:, features.LAYOUT["singular_values"]].detach().numpy(), 1.0, atol=1e-5)


def test_a_centroid_on_the_body_has_no_direction():
    """Touching cloth would get a direction of NaN; its distance is 0, its direction zero."""
    scene = Scene("icosphere")
    touching = scene.interaction()._replace(closest=scene.centroids)
    vertices = scene.vertices.clone().requires_grad_()
    out = scene.features(vertices, scene.garment_mean, touching)
    out.sum().backward()
    assert torch.count_nonzero(out[:, features.LAYOUT["signed_distance"]]) == 0
    assert torch.count_nonzero(out[:, features.LAYOUT["direction_to_body"]]) == 0
    assert torch.isfinite(vertices.grad).all()


def test_interaction_serves_a_moved_garment():
    """Distance and direction must be those of the garment as it is now, not as it was when the body was asked."""
    scene = Scene("irregular_grid")
    interaction = scene.interaction()
    moved = scene.vertices + torch.tensor([0.01, -0.02, 0.03])
    out = scene.features(moved, scene.garment_mean, interaction).numpy()
    expected = scene.twin(moved.numpy(), scene.garment_mean.numpy(), interaction)
    for column in ("signed_distance", "direction_to_body"):
        np.testing.assert_allclose(out[:, features.LAYOUT[column]], expected[:, features.LAYOUT[column]], atol=2e-5)


@pytest.mark.parametrize("collapse_next", [False, True])
def test_degenerate_body_faces_do_not_deform(collapse_next):
    """A sliver of skin would send 1/0 into the features; it must count as undeformed and still carry its velocity."""
    # Warp itself skips thinner ones
    flat = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0.5, 3e-5, 5]])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]], dtype=torch.int32)
    moving = flat + torch.tensor([0.0, 0.0, 0.25])
    if collapse_next:
        flat[5, 1] = 1.0
        moving = flat + torch.tensor([0.0, 0.0, 0.25])
        moving[5] = moving[4] = moving[3]
    points = torch.tensor([[0.2, 0.2, 1.0], [0.5, 0.0, 4.9]])
    found = features.body_interaction(points, None, sdf.BodyMeshes(flat, faces), moving)
    assert torch.isfinite(found.deformation).all()
    assert found.face.tolist() == [0, 1]
    assert torch.equal(found.deformation[1], torch.eye(3))
    velocity = (moving[3:] - flat[3:]).mean(0)
    np.testing.assert_allclose(found.velocity[1].numpy(), velocity.numpy(), atol=1e-6)
    np.testing.assert_allclose(found.deformation[0].numpy(), np.eye(3), atol=1e-6)


def test_each_garment_follows_its_own_body():
    """In a batch, cloth would be carried by another garment's body."""
    first, second = meshes.posed_body(0.5), meshes.posed_body(2.0)
    both, both_next = meshes.joined(first, second), meshes.joined(meshes.posed_body(0.8), meshes.posed_body(2.3))
    vertex_offsets, face_offsets = meshes.offsets(first, second)
    bodies = sdf.BodyMeshes(torch.tensor(both.vertices), torch.tensor(both.faces), vertex_offsets, face_offsets)
    skirt = GARMENTS["skirt"]
    centroids = torch.tensor(reference_deformation.face_centroids(skirt.vertices, skirt.faces), dtype=torch.float32)
    body_of_face = (torch.arange(len(centroids)) % 2).to(torch.int32)
    packed = features.body_interaction(centroids, body_of_face, bodies, torch.tensor(both_next.vertices))
    for b, (now, then) in enumerate([(first, meshes.posed_body(0.8)), (second, meshes.posed_body(2.3))]):
        alone = sdf.BodyMeshes(torch.tensor(now.vertices), torch.tensor(now.faces))
        mine = body_of_face == b
        expected = features.body_interaction(centroids[mine], None, alone, torch.tensor(then.vertices))
        for ours, theirs in zip(packed[:2] + packed[3:], expected[:2] + expected[3:], strict=True):
            assert torch.equal(ours[mine], theirs)
        assert torch.equal(packed.face[mine] - int(face_offsets[b]), expected.face)


def test_what_is_nowhere_stays_harmless():
    """A centroid that blew up must say NaN in its own row alone and still name no body face; so must a dangling
    garment index."""
    scene = Scene("tetrahedron")
    scene.centroids[1] = float("nan")
    found = scene.interaction()
    assert found.face[1] == -1
    assert torch.isnan(found.closest[1]).all()
    assert torch.equal(found.deformation[1], torch.eye(3))
    assert torch.count_nonzero(found.velocity[1]) == 0
    assert torch.isfinite(found.closest[[0, 2, 3]]).all()
    scene.garment_of_face[2] = 2
    out = scene.features(scene.vertices, scene.garment_mean, found)
    assert torch.isnan(out[1, features.LAYOUT["signed_distance"]]).all()
    assert torch.isnan(out[2]).all()
    assert torch.isfinite(out[[0, 3]]).all()


def test_nothing_in_nothing_out():
    """A batch without faces must pass through, gradients included."""
    scene = Scene("tetrahedron")
    no_faces = torch.zeros(0, 3, dtype=torch.int32)
    found = features.body_interaction(torch.zeros(0, 3), None, scene.bodies, torch.tensor(scene.next_body.vertices))
    assert found.deformation.shape == (0, 3, 3)
    vertices = scene.vertices.clone().requires_grad_()
    out = features.face_features(
        torch.zeros(0, 3, 3), vertices, no_faces, torch.zeros(0, dtype=torch.int32), torch.zeros(1, 3), found
    )
    assert out.shape == (0, features.FEATURES)
    out.sum().backward()
    assert torch.count_nonzero(vertices.grad) == 0


def test_wrong_arguments_are_refused():
    """Wrong shapes and dtypes must not reach a kernel."""
    scene = Scene("tetrahedron")
    after, found = torch.tensor(scene.next_body.vertices), scene.interaction()
    with pytest.raises(ValueError, match="next_vertices"):
        features.body_interaction(scene.centroids, None, scene.bodies, after[1:])
    with pytest.raises(TypeError, match="centroids"):
        features.body_interaction(scene.centroids.double(), None, scene.bodies, after)
    with pytest.raises(TypeError, match="body_of_face"):
        features.body_interaction(scene.centroids, torch.zeros(4), scene.bodies, after)
    arguments = [scene.inverse_rest, scene.vertices, scene.faces, scene.garment_of_face, scene.garment_mean, found]
    wrong = [
        (0, scene.inverse_rest[1:], ValueError, "inverse_rest"),
        (1, scene.vertices.double(), TypeError, "vertices"),
        (2, scene.faces.long(), TypeError, "faces"),
        (3, scene.garment_of_face[1:], ValueError, "garment_of_face"),
        (4, scene.garment_mean[0], ValueError, "garment_mean"),
        (5, found._replace(sign=found.sign[1:]), ValueError, "sign"),
        (5, found._replace(closest=found.closest.double()), TypeError, "closest"),
        (5, found._replace(deformation=found.velocity), ValueError, "deformation"),
        (5, found._replace(velocity=found.sign), ValueError, "velocity"),
    ]
    for position, value, error, word in wrong:
        changed = [*arguments[:position], value, *arguments[position + 1 :]]
        with pytest.raises(error, match=word):
            features.face_features(*changed)


def test_operators_keep_torch_contracts():
    """Operators would break under torch.compile, export or autograd (schema, fake shapes, backward registration)."""
    scene = Scene("tetrahedron")
    found = scene.interaction()
    operators = torch.ops.warpgarment
    torch.library.opcheck(
        operators.face_features.default,
        (
            scene.inverse_rest,
            scene.vertices.requires_grad_(),
            scene.faces,
            scene.garment_of_face,
            scene.garment_mean.requires_grad_(),
            found.closest,
            found.sign,
            found.deformation,
            found.velocity,
        ),
    )
