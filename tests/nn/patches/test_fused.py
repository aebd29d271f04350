"""The network of patches by kernels: the same network as torch's, and always with its newest weights."""

import copy
import dataclasses

import pytest
import torch
from support.comparing import close
from support.meshes import irregular_grid, skirt, two_components

import warpgarment as wg
from warpgarment.kernels.dense import products
from warpgarment.kernels.features.channels import FACE, FEATURES, INTERACTION
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import FrameInputs
from warpgarment.nn.patches import fused
from warpgarment.nn.patches.layout import garment_patches, patch_layout
from warpgarment.nn.patches.network import PatchTransformer
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.pack import PackedGarments

pytestmark = pytest.mark.skipif(not products.available(), reason="this processor has no vectors")

WIDTHS = {"embedding": 64, "feed_forward": 96, "heads": 2, "manifold_heads": 1, "face_embedding": 32}
SHAPE = WIDTHS | {"face_feed_forward": 64, "history": 3, "patch_spacing": 0.15, "layers": 2}
GARMENTS = [Garment(*mesh) for mesh in (irregular_grid(8, 5), two_components(), skirt(12, 4))]


def network(**changes) -> PatchTransformer:
    """A network with random weights and statistics that the kernels can do."""
    torch.manual_seed(0)
    made = PatchTransformer(
        NetworkConfig.fast(
            **(WIDTHS | {"face_feed_forward": 64, "history": 3, "patch_spacing": 0.15, "layers": 2} | changes)
        )
    )
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.15)
    made.set_statistics({"feature_mean": torch.randn(FEATURES), "feature_std": torch.rand(FEATURES) + 0.5})
    assert fused.fits(made)
    return made.eval()


def batch(made: PatchTransformer, *garments: Garment):
    """Random features and velocities of a padded batch, its layout and its masks."""
    config = made.config
    layout = patch_layout(
        [garment_patches(g, config.patch_spacing) for g in garments], config.geodesic_radius, config.geodesic_power
    )
    generator = torch.Generator().manual_seed(len(garments))
    sizes, pieces = [len(g.faces) for g in garments], [int(g.components[1].max()) + 1 for g in garments]
    features = torch.randn(len(garments), max(sizes), 3 * FEATURES, generator=generator)
    velocities = torch.randn(len(garments), max(pieces), 6, generator=generator)
    masks = [torch.arange(max(n))[None] < torch.tensor(n)[:, None] for n in (sizes, pieces)]
    features[~masks[0]], velocities[~masks[1]] = torch.nan, torch.nan
    return features, velocities, layout, *masks


@pytest.mark.parametrize("heading", ["world", "canonical"])
@pytest.mark.parametrize("chosen", [(0,), (1,), (0, 1, 2)])
def test_it_is_the_network_of_torch(heading, chosen, monkeypatch):
    """A rollout would use another network than training made: a bias not folded, a padded garment heard.

    Beside the same in torch: 1e-4 of outputs around one, since products on tiles lose 2^-17 of each term.
    """
    made = network(heading=heading)
    features, velocities, layout, faces, pieces = batch(made, *(GARMENTS[k] for k in chosen))
    with torch.no_grad():
        result = made(features, velocities, layout, face_mask=faces, velocity_mask=pieces)
        monkeypatch.setattr(products, "available", lambda: False)
        assert not fused.fits(made)
        expected = made(features, velocities, layout, face_mask=faces, velocity_mask=pieces)
    for one, other, mask in zip(result, expected, (faces, faces, pieces), strict=True):
        close(one[mask], other[mask], 1e-4 * max(1.0, other[mask].abs().max().item()))
        assert not torch.equal(one[mask], other[mask])  # they are two


@pytest.mark.parametrize("outdoor", [(), ("density", "stretch", "shear", "bend", "friction", "wind")])
@pytest.mark.parametrize("residual", [False, True])
def test_steps_of_a_batch(outdoor, residual, monkeypatch):
    """A frame would not move as in training: padding would be a face, or velocities be those of other pieces.

    Beside the same by torch: 1e-4 of outputs around one.
    """
    made = network(heading="canonical", outdoor=outdoor, residual=residual)
    packed = PackedGarments.pack(GARMENTS, torch.device("cpu"))
    layout, generator = made.layout(GARMENTS, packed), torch.Generator().manual_seed(0)
    faces, pieces = len(packed.faces), packed.component_offsets[-1]
    vertices = packed.rest_vertices
    materials = None
    if outdoor:
        materials = torch.rand(len(GARMENTS), len(dataclasses.fields(Material)), generator=generator) + 0.5
    inputs = FrameInputs(
        torch.randn(faces, 3, FEATURES, generator=generator), torch.randn(pieces, 2, 3, generator=generator),
        vertices, vertices, vertices, materials=materials,
    )  # fmt: skip
    with torch.no_grad():
        assert fused.predicts(made, layout)
        result = made.predict(inputs, layout)
        monkeypatch.setattr(fused, "predicts", lambda *_: False)
        monkeypatch.setattr(products, "available", lambda: False)
        expected = made.predict(inputs, layout)
    for one, other in zip(result, expected, strict=True):
        close(one, other, 1e-4 * max(1.0, other.abs().max().item()))


def test_factors_of_a_turn():
    """Features would be turned otherwise than by their layout: every kind of channel, all of them and some. Exact."""
    turn = torch.randn(1, 3, 3)
    entries = torch.cat([turn.flatten(), torch.tensor([1.0, 0.0])])
    for layout in (FACE, FACE.only(FACE.names[2:5]), INTERACTION):
        first, second = fused.factors(layout)
        found = (entries[first] * entries[second]).reshape(layout.width, -1)
        assert torch.equal(found[:, : layout.width], layout.turn(turn)[0])
        assert not found[:, layout.width :].any()


def test_no_layers_after_the_patches_and_subsets_of_faces(monkeypatch):
    """Faces would be taken from memory that no layer wrote, or a subset hear neighbours that it does not have."""
    made = network(face_layers=0)
    subset = [garment_patches(g, 0.15).subset(range(20)) for g in GARMENTS[:2]]
    for weights, some, faces in (
        (patch_layout([garment_patches(GARMENTS[0], 0.15)], 0.15, 2.0), made, len(GARMENTS[0].faces)),
        (patch_layout(subset, 0.15, 2.0), network(), 20),
    ):
        rows = len(weights.patch)
        features, velocities = torch.randn(rows, faces, 3 * FEATURES), torch.randn(rows, 2 if rows > 1 else 1, 6)
        with torch.no_grad():
            result = some(features, velocities, weights)
            with monkeypatch.context() as patched:
                patched.setattr(products, "available", lambda: False)
                expected = some(features, velocities, weights)
        for one, other in zip(result, expected, strict=True):
            close(one, other, 1e-4 * max(1.0, other.abs().max().item()))


@pytest.mark.parametrize("way", ["optimizer", "fused optimizer", "average", "loaded", "replaced", "statistics", "data"])
def test_it_has_the_newest_weights(way):
    """A network in training would be validated with an earlier step's weights. Exact: a copy has nothing packed."""
    made, other = network(), network(face_layers=2)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.1)
    given = batch(made, GARMENTS[0])
    with torch.no_grad():
        before = made(*given[:3])
    if way.endswith("optimizer"):
        for parameter in made.parameters():
            parameter.grad = torch.ones_like(parameter)
        torch.optim.AdamW(made.parameters(), lr=0.01, fused=way.startswith("fused")).step()
    elif way == "average":
        with torch.no_grad():
            torch._foreach_lerp_(list(made.parameters()), list(other.parameters()), 0.5)
    elif way == "loaded":
        made.load_state_dict(other.state_dict())
    elif way == "replaced":
        made.face_head.bias = torch.nn.Parameter(made.face_head.bias.detach() + 1.0)
    elif way == "statistics":
        made.set_statistics({"feature_std": made.feature_std * 2.0, "feature_mean": made.feature_mean + 1.0})
    else:
        made.face_head.weight.data = 2.0 * made.face_head.weight.data
    with torch.no_grad():
        after, fresh = made(*given[:3]), copy.deepcopy(made)(*given[:3])
    for one, same in zip(after, fresh, strict=True):
        assert torch.equal(one, same)
    assert not torch.equal(after.psi, before.psi)


@pytest.mark.parametrize("written", ["data", "array"])
def test_a_scene_begins_with_the_newest_weights(written):
    """torch counts no change of a weight that is written through `.data` or an array of NumPy: the network would go on
    with old weights for as long as it lives. Exact: a copy has nothing packed."""
    made, given = network(), batch(network(), GARMENTS[0])
    with torch.no_grad():
        before = made(*given[:3])
        weight = made.face_head.weight
        if written == "data":
            weight.data.mul_(2.0)
        else:
            weight.detach().numpy()[:] *= 2.0
        made.layout(GARMENTS[:1], PackedGarments.pack(GARMENTS[:1], torch.device("cpu")))
        after, fresh = made(*given[:3]), copy.deepcopy(made)(*given[:3])
    for one, same in zip(after, fresh, strict=True):
        assert torch.equal(one, same)
    assert not torch.equal(after.psi, before.psi)


def test_gradients_and_other_widths_are_torchs(monkeypatch):
    """Training would lose its gradients in a kernel that has none, or a kernel read beyond a narrow layer."""
    made = network()
    features, velocities, layout, *_ = batch(made, GARMENTS[0])
    monkeypatch.setattr(fused, "packed", None)  # not to be called
    made(features, velocities, layout).psi.sum().backward()
    assert made.embed_faces.weight.grad.any()
    for changes in ({"face_embedding": 48}, {"heads": 4}, {"embedding": 288, "heads": 9}, {"activation": "relu"}):
        assert not fused.fits(PatchTransformer(NetworkConfig.fast(**(WIDTHS | changes))))


def test_the_bundled_network_fits():
    """The network that most use would be at torch's speed."""
    assert fused.fits(wg.Simulator.from_pretrained("fast", device="cpu").network)


@pytest.mark.parametrize("name", ["dress", "tshirt"])
def test_rollouts_are_as_near_to_the_recording(name, monkeypatch):
    """Products of integers or bfloat16 would cost accuracy: the mean error of 60 frames within 1 % of torch's."""
    assets = wg.demo.assets()
    item, body = assets.garments[name], assets.collider
    sim = wg.Simulator.from_pretrained("fast", device="cpu")
    walk = wg.BodyMotion(body.vertices[:60], body.faces, body.fps)
    truth, errors = item.truth.vertices[:60], []
    for kernels in (True, False):
        if not kernels:
            monkeypatch.setattr(products, "available", lambda: False)
        found = sim.rollout(item.garment, walk, first_vertices=item.first_vertices).vertices
        errors.append(float(((found - truth) ** 2).sum(axis=2).mean(axis=1)[1:].mean() ** 0.5))
    assert abs(errors[0] / errors[1] - 1.0) <= 0.01
    assert errors[1] > 1e-3
