"""Each stage of a frame has a fused path and one with gradients: training would go through other states than a rollout.

Values on both paths, for garments with pins and in several pieces that a body presses. They are float32 sums in another
order: tolerances are some roundings of what is compared, 1 m for positions.
"""

import numpy as np
import pytest
import torch
from support.scenes import body, network, outfit, skirt

from warpgarment.kernels.features.face import body_interaction
from warpgarment.nn.parametrisation import Step
from warpgarment.objects.pack import PackedBodies
from warpgarment.sim.scene import Scene
from warpgarment.sim.timing import Timings

MOTION = body(2, lambda t: (0.08 * t, 0.0, 0.01 * t), lambda t: (0.0, 0.05 * t, 0.0))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Three garments on one body, one of them pinned."""
    garments, device = [skirt(), outfit(), skirt(pins=[0, 1, 2])], torch.device("cpu")
    bodies = PackedBodies.pack([MOTION.faces], [len(MOTION.vertices[0])], [0, 0, 0], device)
    first = torch.from_numpy(np.concatenate([garment.vertices for garment in garments]))
    options = {"face_splits": 1, "epsilon": None, "collision_passes": 4, "half": False, "timings": Timings(device)}
    return Scene(garments, bodies, torch.from_numpy(MOTION.vertices[0]), first, network(), **options)


@pytest.fixture
def frame(scene) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Garments in another shape than at rest, and the bodies in two frames."""
    rest = scene.packed.rest_vertices
    return rest + 0.005 * torch.sin(20.0 * rest), *(torch.from_numpy(v) for v in MOTION.vertices)


def learned(tensor: torch.Tensor) -> torch.Tensor:
    """A copy that requires a gradient."""
    return tensor.clone().requires_grad_(True)


def prediction(scene, broken: int | None = None) -> Step:
    """A prediction of small deformations, which is not finite for one garment."""
    torch.manual_seed(0)
    faces, components = len(scene.packed.faces), scene.packed.component_count
    psi = torch.eye(3) + 0.05 * torch.randn(faces, 3, 3)
    if broken is not None:
        psi[scene.packed.garment_of_face == broken, 1, 1] = torch.inf
    stretch = 1.0 + 0.05 * torch.randn(faces, 3).sort(dim=1, descending=True).values
    return Step(psi, stretch, 0.01 * torch.randn(components, 3))


def test_centroids(scene, frame):
    """Training would follow other centroids than a rollout. 1e-6 m."""
    found, other = scene.centroids(frame[0]), scene.centroids(learned(frame[0]))
    assert other.requires_grad
    torch.testing.assert_close(other, found, rtol=0, atol=1e-6)


def test_features(scene, frame):
    """Training would see other features than a rollout, or cached nearest faces give others.

    1e-5, in m or without unit.
    """
    vertices, now, then = frame
    found, other = scene.features(vertices, now, then), scene.features(learned(vertices), now, then)
    assert other.requires_grad
    torch.testing.assert_close(other, found, rtol=0, atol=1e-5)
    assert not torch.allclose(found, scene.features(vertices, now, now), atol=1e-3)
    centroids = vertices[scene.packed.faces.long()].mean(1)
    on = torch.zeros(len(centroids), dtype=torch.int32)
    interaction = body_interaction(centroids, on, scene.bodies.at(now), then)
    torch.testing.assert_close(scene.features.of_interaction(vertices, interaction), found, rtol=0, atol=1e-5)


@pytest.mark.parametrize("broken", [None, 1])
def test_reconstruction(scene, frame, broken):
    """Training would solve for other positions than a rollout, or move the garment that is not finite.

    1e-5 for deformation gradients; 2e-5 m for positions, since the Poisson solve has an error of 1e-5 m.
    """
    vertices, now, then = frame
    features, step = scene.features(vertices, now, then), prediction(scene, broken)
    followed = Step(*map(learned, step))
    for of_path, other in zip(
        scene.reconstruct.gradients(step, features), scene.reconstruct.gradients(followed, features), strict=True
    ):
        torch.testing.assert_close(other, of_path, rtol=0, atol=1e-5)
    solved, finite = scene.reconstruct(vertices, step, features, then)
    other, other_finite = scene.reconstruct(vertices, followed, features, then)
    assert other.requires_grad
    assert finite.tolist() == other_finite.tolist() == [broken != garment for garment in range(3)]
    torch.testing.assert_close(other, solved, rtol=0, atol=2e-5)
    stayed = (solved == vertices).all(1)
    assert torch.equal(stayed, scene.packed.garment_of_vertex == (-1 if broken is None else broken))


def test_contact(scene, frame):
    """Training, which does not measure depths, would move cloth otherwise than a rollout. Exact: the same kernels."""
    vertices, now, then = frame
    origin = scene.contact.origin(vertices, scene.features(vertices, now, then))
    finite = torch.tensor([True, True, True])
    pushed, still_finite, depth, report = scene.contact(vertices, then, finite, origin)
    assert (pushed - vertices).abs().amax() > 0.01
    assert still_finite.all()
    assert report[0] > 0
    assert scene.contact.depth(vertices, then).amax() > 0.01 > depth.amax()
    for measure in (True, False):
        found = scene.contact(learned(vertices), then, finite, origin, measure=measure)
        assert found[0].requires_grad
        assert torch.equal(found[0], pushed)
        assert not measure or torch.equal(found[2], depth)
