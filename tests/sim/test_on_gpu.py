"""What the stages of a frame give on a GPU, beside a CPU, where each has its float64 twin. Skipped without a GPU.

Tolerances: float32 arithmetic in another order; a Poisson solve is 0.01 mm and a refinement 0.02 mm from the exact
result on either device.
"""

import numpy as np
import pytest
import torch
from support.scenes import body, network, outfit, skirt, walk

from warpgarment.nn.patches.network import PatchTransformer
from warpgarment.objects.pack import PackedBodies
from warpgarment.sim.history import History
from warpgarment.sim.scene import Scene
from warpgarment.sim.simulator import Simulator
from warpgarment.sim.timing import Timings

DEVICE = "cuda"
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
PRESSED = body(3, lambda t: (0.08 * min(t, 1), 0.0, 0.01 * t), lambda t: (0.0, 0.05 * t, 0.0))
TOLERANCES = {
    "features": 2e-4,
    "carried": 2e-5,
    "network": 2e-4,
    "reconstructed": 4e-5,
    "pushed out": 1e-4,
    "depth": 1e-4,
    "gradient": 1e-3,
}


def frame(device: str) -> dict[str, np.ndarray]:
    """Every stage of the second frame of three garments, one of them pinned, that a body presses; inputs are shared."""
    garments = [skirt(), outfit(), skirt(pins=[0, 1, 2])]
    before, following = (torch.from_numpy(PRESSED.vertices[t]).to(device) for t in (0, 1))
    bodies = PackedBodies.pack([PRESSED.faces], [len(before)], [0, 0, 0], torch.device(device))
    first = torch.from_numpy(np.concatenate([garment.vertices for garment in garments]))
    scene = Scene(
        garments,
        bodies,
        before,
        first.to(device),
        network().to(device),
        face_splits=1,
        epsilon=None,
        collision_passes=4,
        half=False,
        timings=Timings(torch.device(device)),
    )
    vertices = (first + 0.005 * torch.sin(20.0 * first)).to(device).requires_grad_(True)
    features = scene.features(vertices, before, following)
    history = History.cold(features.detach(), scene.packed.component_count, scene.network.config.history)
    step = scene.predict(history.stacked(features), history.velocities)
    solved, finite = scene.reconstruct(vertices, step, features, following)
    origin = scene.contact.origin(vertices.detach(), features.detach())
    pushed, _, depth, _ = scene.contact(solved, following, finite, origin)
    (pushed * torch.linspace(-1.0, 1.0, pushed.numel(), device=device).view_as(pushed)).sum().backward()
    found = {
        "features": features,
        "carried": origin,
        "network": torch.cat([step.psi.flatten(1), step.singular_values], 1),
        "reconstructed": solved,
        "pushed out": pushed,
        "depth": depth,
        "gradient": vertices.grad,
    }
    return {name: tensor.detach().cpu().numpy() for name, tensor in found.items()}


@pytest.fixture(scope="module")
def frames() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The stages of a frame on the GPU and on the CPU."""
    return frame(DEVICE), frame("cpu")


@pytest.mark.parametrize("stage", TOLERANCES)
def test_a_stage_is_that_of_a_cpu(frames, stage):
    """A kernel that is right on a CPU could race, or lack a barrier, on a GPU."""
    mine, theirs = (result[stage] for result in frames)
    scale = max(1.0, float(np.abs(theirs).max()))
    np.testing.assert_allclose(mine, theirs, rtol=0, atol=TOLERANCES[stage] * scale)


@pytest.mark.parametrize("kind", ["faces", "patches"])
@pytest.mark.parametrize("graph", [False, True])
def test_a_rollout_is_that_of_a_cpu(kind, graph):
    """Errors of single frames would add up, or a graph replay another frame. Six frames; 1 mm."""
    made = network() if kind == "faces" else network(PatchTransformer, architecture="patches")
    garments = [skirt(), outfit()]
    mine = Simulator(made.to(DEVICE), DEVICE, graph=graph).rollout(garments, walk(6))
    theirs = Simulator(made.to("cpu"), "cpu").rollout(garments, walk(6))
    for one, other in zip(mine, theirs, strict=True):
        assert [s.verdict for s in one.status] == [s.verdict for s in other.status]
        np.testing.assert_allclose(one.vertices, other.vertices, rtol=0, atol=1e-3)


def test_a_seed_gives_one_rollout():
    """Runs that cannot be repeated cannot be compared. Two runs on the GPU, 0.1 mm."""
    one, two = (Simulator(network(), DEVICE).rollout(skirt(), walk(6)).vertices for _ in range(2))
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-4)
