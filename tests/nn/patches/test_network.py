"""The network of patches against a plain NumPy twin, its symmetries, its cost, and itself in a rollout."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.special
import torch
from support.comparing import close
from support.meshes import irregular_grid, skirt, two_components
from support.scenes import body, outfit, simulator, walk
from support.scenes import skirt as worn_skirt
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from warpgarment.errors import CheckpointError
from warpgarment.kernels.features.channels import FEATURES
from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import build_network
from warpgarment.nn.attention import geodesic_weights
from warpgarment.nn.config import STATISTICS, NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.nn.heading import canonical_frame, rotate_features, rotate_vectors
from warpgarment.nn.patches import ARCHITECTURE
from warpgarment.nn.patches.layout import PatchLayout, garment_patches, patch_layout
from warpgarment.nn.patches.network import PatchTransformer
from warpgarment.nn.run import rotate_output
from warpgarment.objects.garment import Garment

TINY = {
    "embedding": 24,
    "layers": 2,
    "feed_forward": 32,
    "heads": 3,
    "manifold_heads": 1,
    "history": 3,
    "face_embedding": 16,
    "face_feed_forward": 20,
    "patch_spacing": 0.15,
}


def tiny(**changes) -> PatchTransformer:
    """A small network with random weights and statistics, in evaluation mode."""
    torch.manual_seed(0)
    network = PatchTransformer(NetworkConfig.fast(**(TINY | changes)))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    statistics = {n: torch.rand(k) + 0.5 if n.endswith("std") else torch.randn(k) for n, k in STATISTICS.items()}
    for name in ("psi_mean", "q_mean"):
        del statistics[name]
    network.set_statistics(statistics)
    return network.eval()


SHEET, PIECES, SKIRT = (Garment(*mesh) for mesh in (irregular_grid(8, 5), two_components(), skirt(12, 4)))


def layout(*garments: Garment, config: NetworkConfig | None = None) -> PatchLayout:
    """The patch layout of garments."""
    config = config or NetworkConfig.fast(**TINY)
    found = [garment_patches(garment, config.patch_spacing) for garment in garments]
    return patch_layout(found, config.geodesic_radius, config.geodesic_power)


def inputs(batch: int, faces: int, components: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Random features and velocities."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(batch, faces, 3 * FEATURES, generator=generator)
    return features, torch.randn(batch, components, 6, generator=generator)


def test_matches_numpy():
    """A layer would be missing or out of order, a patch pooled wrongly, or heads mixed up.

    Dense pooling matrices; both in float64, but for the shares and weights, whose float32 rounding is 6e-8: 1e-5.
    """
    network = tiny(heading="world").double()
    found = garment_patches(PIECES, network.config.patch_spacing)
    faces, count = len(PIECES.faces), len(found.centres)
    x, v = (values.double() for values in inputs(1, faces, 2))
    result = network.forward_normalised(x, v, layout(PIECES))

    weight = {name: tensor.double().numpy() for name, tensor in network.state_dict().items()}

    def linear(name: str, values: np.ndarray) -> np.ndarray:
        return values @ weight[f"{name}.weight"].T + weight.get(f"{name}.bias", 0.0)

    def norm(name: str, values: np.ndarray) -> np.ndarray:
        values = values - values.mean(axis=1, keepdims=True)
        values /= np.sqrt((values**2).mean(axis=1, keepdims=True) + 1e-5)
        return values * weight[f"{name}.weight"] + weight[f"{name}.bias"]

    def gelu(values: np.ndarray) -> np.ndarray:
        return 0.5 * values * (1.0 + scipy.special.erf(values / np.sqrt(2.0)))

    share = np.zeros((faces, count))
    np.add.at(share, (np.arange(faces)[:, None], found.patch), found.share)
    corners = PIECES.vertices[PIECES.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    pool = (share * area[:, None]).T
    pool /= pool.sum(axis=1, keepdims=True)

    h = linear("embed_faces", x[0].double().numpy())
    h = h + linear("before.contract", gelu(linear("before.expand", norm("before.norm", h))))
    piece, patch_area = PIECES.components[1], (share * area[:, None]).sum(axis=0)
    on = (piece[found.centres] == np.arange(2)[:, None]) * patch_area
    mean = on / on.sum(axis=1, keepdims=True) @ pool @ h
    velocity = linear("embed_velocity", v[0].double().numpy()) + linear("to_velocity", mean)
    tokens = np.concatenate([linear("to_patches", pool @ h), velocity])
    geodesic = np.eye(count + 2)
    geodesic[:count, :count] = scipy.special.softmax(-((found.distances.astype(np.float64) / 0.15) ** 2), axis=1)
    for k in range(2):
        projected = linear(f"layers.{k}.attention.qkv", norm(f"layers.{k}.attention_norm", tokens))
        # those of the manifold head lie first, and its values last
        _, query, key, value = np.split(projected, [16, 32, 48], axis=1)
        outputs = [
            scipy.special.softmax(query[:, part] @ key[:, part].T / 8**0.5, axis=1) @ value[:, part]
            for part in (slice(0, 8), slice(8, 16))
        ]
        tokens = tokens + linear(f"layers.{k}.attention.out", np.concatenate([*outputs, geodesic @ value[:, 16:]], 1))
        hidden = gelu(linear(f"layers.{k}.expand", norm(f"layers.{k}.feed_forward_norm", tokens)))
        tokens = tokens + linear(f"layers.{k}.contract", hidden)
    h = h + share @ linear("from_patches", tokens[:count] - linear("to_patches", pool @ h))
    tokens = norm("final_norm", tokens)
    for k in range(2):
        own = norm(f"after.{k}.norm", h)
        around = own[found.neighbours].mean(axis=1)
        h = h + linear(
            f"after.{k}.contract", gelu(linear(f"after.{k}.expand", own) + linear(f"after.{k}.hear", around))
        )
    expected = linear("face_head", norm("face_norm", h))
    close(torch.cat([result.psi, result.singular_values], dim=2)[0].detach(), expected, 1e-5)
    close(result.velocity[0].detach(), linear("velocity_head", tokens[count:]), 1e-5)


@pytest.mark.parametrize("direction", ["world", "canonical"])
def test_forward_is_the_steps_that_training_takes(direction):
    """A rollout would use another network than training made: forward turns and normalises weights, not features.

    One garment and several; 1e-5: float32 in another order, on outputs around one.
    """
    network = tiny(heading=direction)
    for batch in (1, 3):
        features, velocities = inputs(batch, len(PIECES.faces), 2)
        result, weights = network(features, velocities, layout(PIECES)), layout(PIECES)
        frame = canonical_frame(features) if network.config.heading == "canonical" else None
        turned, v = features, velocities
        if frame is not None:
            turned, v = rotate_features(features, frame), rotate_vectors(velocities, frame)
        normalised = network.forward_normalised(network.encode(turned), network.encode_velocities(v), weights)
        expected = rotate_output(network.denormalise(normalised), frame, inverse=True)
        for a, b in zip(result, expected, strict=True):
            close(a.detach(), b.detach(), 1e-5)


def test_a_patch_for_every_face_is_the_network_of_faces():
    """A network of patches could not start from what one of faces has learnt; or would not be its generalisation.

    Patches a millimetre apart are the faces. 1e-4: the same products, but the residual is added in another order.
    """
    shape = {name: TINY[name] for name in ("embedding", "layers", "feed_forward", "heads", "manifold_heads", "history")}
    torch.manual_seed(0)
    faces = ManifoldAwareTransformer(NetworkConfig.small(**shape, dropout=0.0)).eval()
    for parameter in faces.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    faces.set_statistics({name: torch.full((STATISTICS[name],), 0.7) for name in ("feature_std", "psi_std", "q_std")})
    config = NetworkConfig.fast(**(TINY | {"face_embedding": 24, "patch_spacing": 1e-3}))
    patches = PatchTransformer.from_faces(faces, config).eval()
    features, velocities = inputs(1, len(PIECES.faces), 2)
    distances = torch.from_numpy(PIECES.geodesics)[None]
    expected = faces(features, velocities, geodesic_weights(distances, config.geodesic_radius, config.geodesic_power))
    for a, b in zip(patches(features, velocities, layout(PIECES, config=config)), expected, strict=True):
        close(a.detach(), b.detach(), 1e-4)
    with pytest.raises(ValueError, match="heads, face_embedding differ"):
        PatchTransformer.from_faces(faces, NetworkConfig.fast(**(TINY | {"heads": 2})))


def test_a_padded_batch_is_its_rows():
    """Padding would leak into real faces, whatever it holds; or a shared garment differ from a repeated one.

    1e-5: other shapes of matrix products sum in other orders.
    """
    network = tiny()
    garments, components = (SHEET, PIECES, SKIRT), (1, 2, 1)
    together = layout(*garments)
    sizes = [len(garment.faces) for garment in garments]
    features, velocities = inputs(3, max(sizes), 2)
    face_mask = torch.arange(max(sizes))[None] < torch.tensor(sizes)[:, None]
    velocity_mask = torch.arange(2)[None] < torch.tensor(components)[:, None]
    features[~face_mask], velocities[~velocity_mask] = torch.nan, torch.nan
    result = network(features, velocities, together, face_mask=face_mask, velocity_mask=velocity_mask)
    for b, (garment, f, c) in enumerate(zip(garments, sizes, components, strict=True)):
        alone = network(features[b : b + 1, :f], velocities[b : b + 1, :c], layout(garment))
        for both, one, count in zip(result, alone, (f, f, c), strict=True):
            close(both[b, :count].detach(), one[0].detach(), 1e-5)
    features, velocities = inputs(2, sizes[1], 2, seed=1)
    shared, repeated = (network(features, velocities, layout(*[PIECES] * n)) for n in (1, 2))
    for a, b in zip(shared, repeated, strict=True):
        close(a.detach(), b.detach(), 1e-5)


def test_another_order_of_faces():
    """The network would depend on how the faces are numbered; 1e-5 for other orders of float32 sums."""
    network, order = tiny(), np.random.default_rng(0).permutation(len(SHEET.faces))
    permuted = Garment(SHEET.vertices, SHEET.faces[order])
    features, velocities = inputs(1, len(order), 1)
    result, other = (network(f, velocities, layout(g)) for f, g in ((features, SHEET), (features[:, order], permuted)))
    close(other.psi.detach(), result.psi[:, order].detach(), 1e-5)
    close(other.singular_values.detach(), result.singular_values[:, order].detach(), 1e-5)
    close(other.velocity.detach(), result.velocity.detach(), 1e-5)


def test_faces_hear_their_patch_and_their_neighbours():
    """Context would not reach the faces: a fold's neighbours, the rest of the piece, or its own features.

    The gradient of one face's output: finite, not zero for itself, its neighbours and a face far away on its piece.
    """
    network = tiny(heading="world")
    features, velocities = inputs(1, len(SKIRT.faces), 1)
    features.requires_grad_(True)
    network(features, velocities, layout(SKIRT)).psi[0, 0].square().sum().backward()
    size = features.grad[0].abs().sum(dim=1)
    assert torch.isfinite(size).all()
    assert (size > 0.0).all()
    near = garment_patches(SKIRT, 0.15).neighbours[0]
    assert size[near].min() > size.median()
    assert size.argmax() == 0


def test_gradients_are_finite_and_reach_every_weight():
    """Training would leave a part of the network as it was, or end in NaN; in a padded batch, and with subsets."""
    network = tiny().train()
    subset = [garment_patches(g, 0.15).subset(np.arange(0, len(g.faces), 3)[:30]) for g in (PIECES, SKIRT)]
    for weights, faces in ((layout(PIECES, SHEET), len(PIECES.faces)), (patch_layout(subset, 0.15, 2.0), 30)):
        features, velocities = inputs(2, faces, 2)
        mask = torch.tensor([[True, True], [True, False]])
        network.zero_grad()
        result = network.forward_normalised(features, velocities, weights, component_mask=mask)
        (
            result.psi.square().mean() + result.singular_values.square().mean() + result.velocity.square().mean()
        ).backward()
        for name, parameter in network.named_parameters():
            assert torch.isfinite(parameter.grad).all(), name
            assert parameter.grad.any() or (weights.neighbours is None and "hear" in name), name


def test_cost_is_linear_in_the_faces():
    """The cost would grow with the square of the faces, or the count of operations be another than what runs.

    Operations as PyTorch counts them, on meshes with the same patches, with attention by plain products,
    which alone PyTorch counts on a CPU.
    """
    network = tiny()
    counted = []
    for repeat in (1, 3, 5):
        weights = layout(SKIRT)
        faces = len(SKIRT.faces)
        weights = weights._replace(  # every face several times, on the same patches
            patch=weights.patch.repeat(1, repeat, 1),
            share=weights.share.repeat(1, repeat, 1),
            neighbours=weights.neighbours.repeat(1, repeat, 1),
        )
        features, velocities = inputs(1, repeat * faces, 1)
        with FlopCounterMode(display=False) as counter, torch.no_grad(), sdpa_kernel(SDPBackend.MATH):
            network.forward_normalised(features, velocities, weights)
        counted.append(counter.get_total_flops())
        both, one = ARCHITECTURE.flops(network.config, repeat * faces, 1, weights)
        assert counted[-1] == both + one
    assert counted[2] - counted[1] == counted[1] - counted[0]


def test_checkpoint_round_trip(tmp_path):
    """A network of patches would come back as another kind or with other weights, or an old file not load.

    Files written before there were kinds lack those settings, and hold networks of faces.
    """
    network = tiny()
    checkpoint.save(network, tmp_path / "patches.safetensors")
    read = checkpoint.load(tmp_path / "patches.safetensors")
    assert type(read) is PatchTransformer
    assert read.config == network.config
    for name, tensor in network.state_dict().items():
        assert torch.equal(read.state_dict()[name], tensor), name
    assert not checkpoint.FIRST & {
        field.name for field in dataclasses.fields(NetworkConfig) if field.name.startswith(("face_", "patch_"))
    }
    faces = build_network(NetworkConfig.small(embedding=16, heads=2, layers=1, history=2))
    assert type(faces) is ManifoldAwareTransformer
    with pytest.raises(ValueError, match='architecture must be "faces", "patches" or "layers", got \'tokens\''):
        NetworkConfig(architecture="tokens")
    checkpoint.save(faces, tmp_path / "faces.safetensors")
    from safetensors.torch import load_file, save_file

    tensors, metadata = (
        load_file(tmp_path / "faces.safetensors"),
        checkpoint.shards.contents(tmp_path / "faces.safetensors").metadata,
    )
    save_file(
        tensors, tmp_path / "wrong.safetensors", {**metadata, "config": metadata["config"].replace("faces", "patches")}
    )
    with pytest.raises(CheckpointError, match="tensors are missing"):
        checkpoint.load(tmp_path / "wrong.safetensors")


def moving(**changes) -> PatchTransformer:
    """Random weights whose output is small: a few millimetres and degrees a frame."""
    network = tiny(**changes)
    scales = {"psi_std": (9, 0.005), "singular_value_std": (3, 5e-4), "q_std": (3, 5e-4)}
    scales |= {"singular_value_mean": (3, 1.0)}
    network.set_statistics({name: torch.full((length,), value) for name, (length, value) in scales.items()})
    return network


def test_untrained_network_moves_like_skin():
    """The prior of a residual network would not hold."""
    features, velocities = inputs(1, len(SHEET.faces), 1)
    output = PatchTransformer(NetworkConfig.fast(**TINY))(features, velocities, layout(SHEET))
    close(output.psi.detach(), np.broadcast_to(np.eye(3), output.psi.shape).copy(), 1e-6)
    assert not output.velocity.any()


def test_simulated_batches_are_single_runs(tmp_path):
    """Garments of several sizes, pieces and bodies would disturb each other in a batch, or a file not simulate.

    A batch pads and sums in another order: 1e-5 m after four frames, a hundredth of the movement.
    """
    moving().save(tmp_path / "network.safetensors")
    sim = simulator(checkpoint.load(tmp_path / "network.safetensors"))
    garments, bodies = [worn_skirt(), outfit(), worn_skirt()], [walk(5), walk(5), body(5, lambda t: (0.01 * t, 0, 0))]
    together = sim.rollout(garments, bodies)
    for garment, motion, result in zip(garments, bodies, together, strict=True):
        alone = sim.rollout(garment, motion, face_splits=3)  # which this network does not need
        assert np.abs(result.vertices - alone.vertices).max() < 1e-5
        skin = simulator(PatchTransformer(NetworkConfig.fast(**TINY))).rollout(garment, motion)
        assert np.abs(result.vertices - skin.vertices).max() > 1e-3
