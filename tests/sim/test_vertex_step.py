"""Networks that predict vertices: the simulator takes their positions as the next frame before contact."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest
import torch
from support.scenes import TINY, body, nowhere_deeper, skirt, walk

from warpgarment.kernels.poisson.solver import PoissonSolver
from warpgarment.nn.architecture import ARCHITECTURES, Architecture
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import VertexStep
from warpgarment.nn.network import GarmentNetwork
from warpgarment.objects.material import Material
from warpgarment.objects.wind import Wind
from warpgarment.sim.simulator import Simulator

SPEED = torch.tensor([0.003, -0.004, 0.002])  # metres a frame


class Drift(GarmentNetwork):
    """Every vertex moves on at the same speed, and with the mean of the body."""

    def layout(self, garments, packed, *, face_splits=1):
        return len(garments)

    def predict(self, inputs, layout, *, bfloat16=False):
        return VertexStep(inputs.vertices + SPEED + (inputs.next_body - inputs.body).mean(dim=0))


class DriftArchitecture(Architecture):
    config, presets, subsets = NetworkConfig, {}, False

    def build(self, config):
        return Drift(config)

    def memory(self, sizes, config):
        return {"network": 0}

    def flops(self, config, faces, components, rows):
        return 0, 0


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """The kind has a name for as long as a test."""
    module = types.ModuleType("drift")
    module.ARCHITECTURE = DriftArchitecture()
    monkeypatch.setitem(sys.modules, "drift", module)
    monkeypatch.setitem(ARCHITECTURES, "drift", "drift")


def drift(kind=Drift) -> GarmentNetwork:
    """A network of this kind."""
    return kind(NetworkConfig(architecture="drift", **TINY))


def test_positions_are_the_next_frame(monkeypatch):
    """A network's positions would go through the Poisson system, which bends them. Sums of float32 alone, 1e-6 m."""
    monkeypatch.setattr(PoissonSolver, "solve", lambda *_, **__: pytest.fail("a Poisson system is solved"))
    garments, motion = [skirt(), skirt()], walk(6)
    results = Simulator(drift(), "cpu", collision_passes=0).rollout(garments, motion)
    for result in results:
        moved = motion.vertices.mean(axis=1) - motion.vertices[0].mean(axis=0)
        expected = skirt().vertices + moved[:, None] + np.arange(6)[:, None, None] * SPEED.numpy()
        assert np.abs(result.vertices - expected).max() < 1e-6
        assert all(status.finite for status in result.status)


def test_steps_are_the_rollout():
    """`step` would treat such networks otherwise than `rollout`. Bit for bit."""
    motion, simulator = walk(4), Simulator(drift(), "cpu")
    whole = simulator.rollout(skirt(), motion).vertices
    state = simulator.start(skirt(), motion.vertices[0], motion.faces)
    for frame in range(1, 4):
        state = simulator.step(state, motion.vertices[frame])
        np.testing.assert_array_equal(state.vertices, whole[frame])


def test_collisions_are_refined():
    """A network's positions would be left inside the body."""

    class Squeeze(Drift):
        def predict(self, inputs, layout, *, bfloat16=False):
            return VertexStep(inputs.vertices * torch.tensor([0.5, 1.0, 0.5]))

    motion = body(2)
    loose = Simulator(drift(Squeeze), "cpu", collision_passes=0).rollout(skirt(), motion).vertices[-1]
    kept = Simulator(drift(Squeeze), "cpu").rollout(skirt(), motion).vertices[-1]
    assert nowhere_deeper(loose, motion, 1) > 0.01
    assert nowhere_deeper(kept, motion, 1) < 1e-3


def test_pins_stay_on_the_body():
    """Pinned vertices would leave the body with the network. Here it stands still; 1e-6 m."""
    worn = skirt(pins=np.arange(16, dtype=np.int32))
    result = Simulator(drift(), "cpu", collision_passes=0).rollout(worn, body(4)).vertices
    assert np.abs(result[:, :16] - worn.vertices[:16]).max() < 1e-6
    assert np.abs(result[-1, 16:] - worn.vertices[16:] - 3 * SPEED.numpy()).max() < 1e-6


def test_positions_that_are_not_finite():
    """NaN of one garment would spread, or not be reported."""

    class Broken(Drift):
        def predict(self, inputs, layout, *, bfloat16=False):
            positions = super().predict(inputs, layout).positions.clone()
            positions[0] = torch.nan
            return VertexStep(positions)

    with pytest.warns(RuntimeWarning, match="skirt stopped"):
        broken, sound = Simulator(drift(Broken), "cpu").rollout([skirt(), skirt()], walk(3))
    assert not broken.status[-1].finite
    assert sound.status[-1].finite
    assert np.isfinite(sound.vertices).all()


def test_a_network_that_reads_more_than_there_is():
    """A network would get None for an input that simulations do not have, and fail with an unclear error."""

    class Windy(Drift):
        reads = frozenset({"wind", "pairs"})

    with pytest.raises(ValueError, match="reads pairs, which simulations do not give yet"):
        Simulator(drift(Windy), "cpu").rollout(skirt(), walk(2))


@pytest.mark.parametrize("training", [True, False])
def test_the_mode_is_as_it_was(training):
    """A rollout during training would leave dropout switched off, or on while it runs."""
    seen = []

    class Watched(Drift):
        def predict(self, inputs, layout, *, bfloat16=False):
            seen.append(self.training)
            return super().predict(inputs, layout)

    network = drift(Watched).train(training)
    simulator, motion = Simulator(network, "cpu"), walk(3)
    simulator.rollout(skirt(), motion)
    simulator.step(simulator.start(skirt(), motion.vertices[0], motion.faces), motion.vertices[1])
    assert seen == [False] * 3
    assert network.training == training


class Witness(Drift):
    """Keeps its inputs."""

    reads = frozenset({"previous", "materials", "wind"})

    def predict(self, inputs, layout, *, bfloat16=False):
        self.seen = [*getattr(self, "seen", []), inputs]
        return super().predict(inputs, layout)


@pytest.mark.parametrize("live", [True, False])
def test_earlier_frames_materials_and_wind(live):
    """A network would get frames, wind or materials of other times or garments. Bit for bit."""
    network, motion, garments = drift(Witness), walk(5), [skirt(), skirt()]
    simulator = Simulator(network, "cpu", collision_passes=0)
    materials, wind = [None, Material(density=0.3)], np.arange(5 * 2 * 3, dtype=np.float32).reshape(5, 2, 3)
    if live:
        state = simulator.start(garments, motion.vertices[0], motion.faces, materials=materials, wind=wind[:1])
        frames = [state.vertices]
        for t in range(1, 5):
            state = simulator.step(state, motion.vertices[t], wind=wind[t : t + 1])
            frames.append(state.vertices)
        frames = [np.concatenate(frame) for frame in frames]
    else:
        results = simulator.rollout(garments, motion, materials=materials, wind=wind)
        frames = list(np.concatenate([result.vertices for result in results], axis=1))
    assert len(network.seen) == 4
    for t, seen in enumerate(network.seen):
        for k in (0, 1):
            np.testing.assert_array_equal(seen.previous[k], frames[max(t - 1 - k, 0)])
            np.testing.assert_array_equal(seen.previous_body[k], motion.vertices[max(t - 1 - k, 0)].astype(np.float32))
        np.testing.assert_array_equal(seen.wind[0], wind[t + 1])
        np.testing.assert_array_equal(seen.wind[1], wind[t])
        assert seen.materials[0].isnan().all()
        assert seen.materials[1].tolist() == pytest.approx(list(vars(Material(density=0.3)).values()))
        assert seen.bodies.body_of_garment.tolist() == [0, 0]


@pytest.mark.parametrize("live", [True, False])
def test_wind_of_a_shot(live):
    """`wg.Wind` would blow at other times than an array of its velocities at the network's rate, 30 a second; or `step`
    would take its first row for all. Of 15 rows a second, every second frame is a row; 1e-6 m/s."""
    network, motion = drift(Witness), walk(5)
    simulator = Simulator(network, "cpu", collision_passes=0)
    wind = Wind([0, 0, 3], [0, 4, 2], fps=15)
    if live:
        state = simulator.start([skirt(), skirt()], motion.vertices[0], motion.faces, wind=wind)
        for t in range(1, 5):
            state = simulator.step(state, motion.vertices[t], wind=wind)
    else:
        simulator.rollout([skirt(), skirt()], motion, wind=wind)
    expected = np.zeros((5, 2, 3))
    expected[:, :, 2] = np.array([0, 2, 4, 3, 2])[:, None]
    for t, seen in enumerate(network.seen):
        np.testing.assert_allclose(seen.wind.numpy(), [expected[t + 1], expected[t]], atol=1e-6)


def test_wind_holds_on_after_a_history():
    """Wind that is shorter than a motion would end, or a warm start would take that of the first frame."""
    network, motion = drift(Witness), walk(6)
    history = np.repeat(skirt().vertices[None], 3, axis=0)
    wind = np.arange(5 * 3, dtype=np.float32).reshape(5, 3)
    Simulator(network, "cpu", collision_passes=0).rollout(skirt(), motion, history=history, wind=wind)
    assert [seen.wind[:, 0].tolist() for seen in network.seen] == [
        [wind[min(t + 1, 4)].tolist(), wind[t].tolist()] for t in (2, 3, 4)
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wind": [1.0, np.nan, 0.0]}, "wind holds NaN"),
        ({"wind": [0.0, 0.0, 1000.0]}, "wind of 1,000 m/s; it must be at most 100"),
        ({"wind": np.zeros((4, 3, 3))}, "wind must have shape"),
        ({"materials": [Material(), Material()]}, "1 garments and 2 materials"),
    ],
)
def test_senseless_materials_and_wind(options, message):
    """A mistake would be simulated."""
    with pytest.raises(ValueError, match=message):
        Simulator(drift(Witness), "cpu").rollout(skirt(), walk(2), **options)


@pytest.mark.parametrize("name", ["materials", "wind"])
def test_a_network_that_does_not_read_them(name):
    """Wind would be given and silently have no effect."""
    given = {"materials": Material(), "wind": [1.0, 0.0, 0.0]}[name]
    with pytest.raises(ValueError, match=f"{name} given, but this Drift reads none"):
        Simulator(drift(), "cpu").rollout(skirt(), walk(2), **{name: given})
