"""Networks of faces and of patches that read the material of a garment and the wind relative to its faces."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from safetensors import safe_open
from scipy.spatial.transform import Rotation
from support.scenes import outfit, skirt, tube, walk

from benchmarks.frames import FrameCounts
from warpgarment.errors import CheckpointError
from warpgarment.kernels.dense.products import INTEGERS
from warpgarment.kernels.features.channels import FACE, FEATURES, OUTDOOR
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import GrowthError, architecture, build_network
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.grow import added, untrained
from warpgarment.nn.heading import canonical_frame, rotate_features, rotate_vectors, rotation_about_up
from warpgarment.nn.inputs import RowInputs
from warpgarment.nn.layers.config import LayersNetConfig
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.parametrisation import NetworkOutput
from warpgarment.nn.run import mirror_inputs, mirror_output, rotate_output, run
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.sim import graph
from warpgarment.sim import simulator as simulator_module
from warpgarment.sim.simulator import Simulator

TINY = {"embedding": 16, "layers": 1, "feed_forward": 16, "heads": 2, "manifold_heads": 1, "history": 3, "dropout": 0.0}
TINY |= {"geodesic_radius": 0.2, "patch_spacing": 0.15, "face_embedding": 16, "face_feed_forward": 16, "face_layers": 1}
PRESETS = {"faces": NetworkConfig.small, "patches": NetworkConfig.fast}
SILK = Material(density=0.08, stretch=400.0, bend=2e-5, friction=0.1)
GALE = np.array([1.0, 0.5, -6.0], np.float32)

every_kind = pytest.mark.parametrize("kind", PRESETS)


def made(kind: str, outdoor: tuple[str, ...] = OUTDOOR.names, **changes) -> GarmentNetwork:
    """Random weights whose output is small: a few millimetres and degrees a frame."""
    torch.manual_seed(0)
    network = build_network(PRESETS[kind](**(TINY | {"outdoor": outdoor} | changes)))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    scales = {"psi_std": (9, 0.02), "singular_value_std": (3, 2e-3), "q_std": (3, 2e-3)}
    statistics = {name: torch.full((length,), value) for name, (length, value) in scales.items()}
    if width := network.outdoor.width:
        statistics |= {"outdoor_mean": torch.linspace(-0.4, 0.6, width), "outdoor_std": torch.full((width,), 0.8)}
        if "wind" in outdoor:
            statistics["outdoor_mean"][network.outdoor.slices["wind"]] = 0.0
            statistics["outdoor_std"][network.outdoor.slices["wind"]] = 3.0
    network.set_statistics(statistics)
    return network.eval()


def rollout(network: GarmentNetwork, garment, body: BodyMotion, frames: int = 6, **options):
    """Without collisions, whose contacts come and go with rounding."""
    return Simulator(network, "cpu", collision_passes=0).rollout(garment, body, frames=frames, **options)


def rows_of(kind: str, network: GarmentNetwork) -> RowInputs:
    """Random inputs of two rows of one garment, in world space."""
    garment, generator = skirt(), torch.Generator().manual_seed(3)
    shape = architecture(kind)
    weights = shape.rows([(shape.geometry(garment, network.config), None)], network.config, torch.device("cpu"))
    faces = len(garment.faces)
    return RowInputs(
        torch.randn(2, faces, 3 * FEATURES, generator=generator),
        torch.randn(2, 1, 6, generator=generator),
        weights,
        outdoor=torch.randn(2, faces, network.outdoor.width, generator=generator),
    )


@every_kind
def test_shipped_networks_do_not_change(kind):
    """A network that was trained without these channels would have other tensors, inputs or settings in its file."""
    network = checkpoint.load(checkpoint.find({"faces": "small", "patches": "fast"}[kind]))
    assert network.config.outdoor == ()
    assert network.reads == frozenset()
    assert "outdoor" not in network.config.as_dict()
    assert not [name for name in network.state_dict() if "outdoor" in name]
    assert network.config.inputs == 10 * FACE.width == network.embed_faces.in_features


@every_kind
def test_added_channels_change_nothing_at_first(kind):
    """`--init fast` with the channels would not start as `fast`, on a body that moves, in a wind, in single steps as in
    training and in a rollout.

    Bit for bit, but for the network of faces: its inputs are longer rows of one product, which some matrix libraries
    add up in another order. Measured: 1e-5 m after fourteen frames.
    """
    network = checkpoint.load(checkpoint.find({"faces": "small", "patches": "fast"}[kind]))
    config = dataclasses.replace(network.config, outdoor=OUTDOOR.names)
    more = architecture(kind).start_from(network, config, grow=False)
    assert more.config == config
    assert untrained(more)
    assert not untrained(network)
    garment, given = outfit(), {"materials": SILK, "wind": GALE}
    expected = Simulator(network, "cpu").rollout(garment, walk(14))
    found = Simulator(more, "cpu").rollout(garment, walk(14), **given)
    assert np.abs(expected.vertices[-1] - expected.vertices[0]).max() > 0.01
    assert np.abs(found.vertices - expected.vertices).max() <= (3e-5 if kind == "faces" else 0.0)
    features = torch.randn(1, len(garment.faces), 10 * FEATURES)
    shape = architecture(kind)
    weights = shape.rows([(shape.geometry(garment, config), None)], config, torch.device("cpu"))
    rows = RowInputs(features, torch.randn(1, 2, 27), weights, in_network_frame=True)
    outside = torch.randn(1, len(garment.faces), OUTDOOR.width)
    with torch.no_grad():
        a, b = run(network, rows).output, run(more, rows._replace(outdoor=outside)).output
    assert (a.psi - torch.eye(3)).abs().max() > 1e-3
    # longer sums in the first layer, here in one product; of which integers in later ones may be rounded otherwise
    rounded = kind == "patches" and INTEGERS
    torch.testing.assert_close(b, a, rtol=1e-6, atol=5e-5 if rounded else 1e-7)
    assert architecture(kind).start_from(more, more.config, grow=False) is more


@every_kind
def test_more_channels_after_those_there_are(kind):
    """A network with the wind that is to read materials too would lose what it learnt of the wind, or mix columns up.
    2e-6: two products in place of one in the first layer."""
    network = made(kind, ("wind",))
    more = added(network, ("wind", "bend", "density"))
    assert torch.equal(more.outdoor_std[:3], network.outdoor_std)
    rows = rows_of(kind, network)
    wider = torch.cat([rows.outdoor, torch.randn(2, rows.outdoor.shape[1], 2)], dim=-1)
    with torch.no_grad():
        a, b = run(network, rows).output, run(more, rows._replace(outdoor=wider)).output
    torch.testing.assert_close(b, a, rtol=2e-6, atol=2e-6)
    with pytest.raises(ValueError, match=r"more can only be added after these, as in outdoor=wind,bend"):
        added(network, ("bend", "wind"))


def test_growing_keeps_the_channels():
    """A network of faces that reads a wind would grow into one that reads none, or that predicts otherwise. 1e-5: sums
    of other lengths in float32."""
    network = made("faces", ("wind",))
    wide = dataclasses.replace(network.config, embedding=32, outdoor=("wind", "bend"))
    grown = architecture("faces").start_from(network, wide, grow=True).eval()
    assert grown.config == wide
    rows = rows_of("faces", network)
    wider = torch.cat([rows.outdoor, torch.randn(2, rows.outdoor.shape[1], 1)], dim=-1)
    with torch.no_grad():
        a, b = run(network, rows).output, run(grown, rows._replace(outdoor=wider)).output
    torch.testing.assert_close(b, a, rtol=1e-5, atol=1e-5)
    with pytest.raises(GrowthError, match="geodesic_radius"):
        architecture("faces").start_from(network, dataclasses.replace(wide, geodesic_radius=0.5), grow=True)


@every_kind
def test_turned_rows_have_turned_answers(kind):
    """The wind would not turn to the network's heading with the garment, or not be mirrored with it: the same rows in
    the network's frame, turned beforehand by hand. 2e-5: two orders of products in float32, of numbers up to 10."""
    network, angle = made(kind), torch.tensor([0.4, -1.1])
    rows, turn = rows_of(kind, network), rotation_about_up(angle)
    mirrored = torch.tensor([True, False])
    with torch.no_grad():
        found = run(network, rows._replace(turn=turn, mirrored=mirrored)).output
        own = run(network, rows._replace(turn=turn)).output  # the shortcut of the first layer, without a mirror

    def by_hand(flip: bool) -> NetworkOutput:
        whole = turn @ canonical_frame(rows.features)
        features, velocities = rotate_features(rows.features, whole), rotate_vectors(rows.velocities, whole)
        outside = rows.outdoor.clone()
        outside[..., 5:] = torch.einsum("rij,rnj->rni", whole, outside[..., 5:])
        chosen = mirrored if flip else torch.zeros(2, dtype=torch.bool)
        features, velocities = mirror_inputs(features, velocities, chosen)
        outside[..., 5] *= torch.where(chosen, -1.0, 1.0)[:, None]
        given = RowInputs(features, velocities, rows.rows, in_network_frame=True, outdoor=outside)
        with torch.no_grad():
            output = mirror_output(run(network, given).output, chosen)
        return rotate_output(output, whole, inverse=True)

    for a, b in ((found, by_hand(True)), (own, by_hand(False))):
        for one, other in zip(a, b, strict=True):
            torch.testing.assert_close(one, other, rtol=2e-5, atol=2e-5)


@every_kind
def test_yaw_turns_a_rollout_with_its_wind(kind):
    """Cloth would move otherwise on a body that faces another way in a wind that turned with it. 1e-4 m, as without a
    wind (test_architectures.py); with the wind left as it was it is more than ten times that."""
    turn = Rotation.from_euler("y", 2.0).as_matrix().astype(np.float32)
    garment, motion, network = skirt(), walk(6), made(kind)
    around = BodyMotion(motion.vertices @ turn.T, motion.faces, motion.fps)
    given = {"first_vertices": garment.vertices @ turn.T, "materials": SILK}
    plain = rollout(network, garment, motion, materials=SILK, wind=GALE).vertices
    found = rollout(network, garment, around, wind=turn @ GALE, **given).vertices
    wrong = rollout(network, garment, around, wind=GALE, **given).vertices
    assert np.abs(found - plain @ turn.T).max() < 1e-4
    assert np.abs(wrong - plain @ turn.T).max() > 1e-3


@every_kind
def test_materials_and_wind_matter_where_they_are(kind):
    """A material or a wind would have no effect, reach another garment of the batch, or a garment without a material
    would not be one of the mean material. 2e-5 m for garments of other sizes in a batch, as without these channels."""
    network, garments, body = made(kind), [skirt(), outfit(), skirt()], walk(6)
    cloth = [SILK, None, Material(density=1.0, bend=0.1)]
    wind = np.stack([GALE, np.zeros(3), -GALE])[None].repeat(6, axis=0)
    wind[3:] *= 0.2
    together = rollout(network, garments, body, materials=cloth, wind=wind)
    for k, motion in enumerate(together):
        own = {"materials": cloth[k], "wind": wind[:, k]}
        alone = rollout(network, garments[k], body, **own).vertices
        assert np.abs(motion.vertices - alone).max() < 2e-5
        other = rollout(network, garments[k], body, materials=Material(bend=1e-2), wind=own["wind"]).vertices
        calm = rollout(network, garments[k], body, materials=cloth[k]).vertices
        assert np.abs(other - alone).max() > 2e-4
        assert (np.abs(calm - alone).max() > 2e-4) == (k != 1)
    mean = 10.0 ** network.outdoor_mean[:5].double().numpy() * [0.3, 1e3, 1e3, 1e-3, 0.3]
    middling = Material(*mean[:4], friction=mean[4])
    known = rollout(network, garments[1], body, materials=middling).vertices
    assert np.abs(together[1].vertices - known).max() < 2e-5


@every_kind
def test_a_batch_is_its_garments_alone_bit_for_bit(kind):
    """The bits of a garment would depend on its company, which the documentation rules out beyond 512 faces."""
    garments = [Garment(*tube(20, 15, bottom=-0.3, top=0.3)), Garment(*tube(22, 16, bottom=-0.25, top=0.3))]
    assert min(len(garment.faces) for garment in garments) > 512
    network, cloth = made(kind), [SILK, Material()]
    together = rollout(network, garments, walk(5), materials=cloth, wind=GALE)
    for garment, material, motion in zip(garments, cloth, together, strict=True):
        alone = rollout(network, garment, walk(5), materials=material, wind=GALE)
        assert np.array_equal(motion.vertices, alone.vertices)


@every_kind
def test_by_steps(kind):
    """A simulation step by step would feel another wind than a rollout, or the wind of another frame. Exact."""
    network, garment, body = made(kind), skirt(), walk(6)
    wind = np.linspace(-4.0, 5.0, 18).reshape(6, 3).astype(np.float32)
    expected = rollout(network, garment, body, materials=SILK, wind=wind).vertices
    simulator = Simulator(network, "cpu", collision_passes=0)
    state = simulator.start(garment, body.vertices[0], body.faces, materials=SILK, wind=wind[0])
    for frame in range(1, 6):
        state = simulator.step(state, body.vertices[frame], wind=wind[frame])
        assert np.array_equal(state.vertices, expected[frame])


@every_kind
def test_no_number_is_looked_at_within_a_frame(kind):
    """The host would wait for a GPU in the middle of a frame, and a graph of it could not be recorded."""
    body, simulator = walk(3), Simulator(made(kind), "cpu")
    state = simulator.start([skirt(), outfit()], body.vertices[0], body.faces, materials=[SILK, None], wind=GALE)
    state = simulator.step(state, body.vertices[1])
    assert FrameCounts(state.scene, state.now, torch.from_numpy(body.vertices[2])).reads == []


@every_kind
def test_replays_are_the_frames(kind, monkeypatch):
    """The wind, the frame before or the materials of a replayed frame would be those of the recording. Bit for bit."""

    def again(call):
        """A recording for the CPU: its replay runs the frame once more, on the same memory."""
        after = call()

        def replay():
            for held, new in zip(after, call(), strict=True):
                held.copy_(new.clone())

        return after, replay

    network, garments, body = made(kind), [skirt(), outfit()], walk(9)
    wind = np.random.default_rng(0).normal(scale=3.0, size=(9, 2, 3))
    options = {"materials": [SILK, None], "wind": wind}
    plain = Simulator(network, "cpu").rollout(garments, body, **options)
    recorded, graphed = [], graph.GraphedFrames
    monkeypatch.setattr(
        simulator_module, "GraphedFrames", lambda scene: recorded.append(graphed(scene, again)) or recorded[-1]
    )
    replaying = Simulator(network, "cpu")
    replaying.graph = True
    found = replaying.rollout(garments, body, **options)
    assert recorded[0].recorded
    for one, other in zip(plain, found, strict=True):
        assert np.array_equal(one.vertices, other.vertices)


def test_networks_that_do_not_read_them_refuse_them():
    """A wind would be given and silently not blow. The message names the kinds of networks in which it does."""
    simulator = Simulator.from_pretrained("fast", device="cpu")
    for given in ({"materials": SILK}, {"wind": GALE}):
        with pytest.raises(ValueError, match=r"reads none. A LayersNet does, and so does a network trained with"):
            simulator.rollout(skirt(), walk(12), **given)
    only_wind = made("patches", ("wind",))
    rollout(only_wind, skirt(), walk(3), 3, wind=GALE)
    with pytest.raises(ValueError, match="materials given"):
        rollout(only_wind, skirt(), walk(3), 3, materials=SILK)
    with pytest.raises(ValueError, match="always reads materials and wind"):
        LayersNetConfig(outdoor=("wind",))


@every_kind
def test_what_a_file_says(kind, tmp_path):
    """A trained network would be loaded without its channels or their statistics, or with channels there are not."""
    network = made(kind, ("bend", "wind"))
    network.save(tmp_path / "network.safetensors", dtype=torch.bfloat16)
    loaded = checkpoint.load(tmp_path / "network.safetensors")
    assert loaded.config == network.config
    assert loaded.reads == network.reads
    assert torch.equal(loaded.outdoor_std, network.outdoor_std)  # statistics keep all their digits
    with safe_open(str(tmp_path / "network.safetensors"), "pt") as stored:
        assert json.loads(stored.metadata()["config"])["outdoor"] == ["bend", "wind"]
    with pytest.raises(ValueError, match="no feature channel 'rain'"):
        PRESETS[kind](outdoor=("rain",))
    object.__setattr__(network.config, "outdoor", ("bend", "rain"))
    network.save(tmp_path / "later.safetensors")
    with pytest.raises(CheckpointError, match=r"later\.safetensors: no feature channel 'rain'"):
        checkpoint.load(tmp_path / "later.safetensors")
