"""The manifold-aware transformer against NumPy in float64, PyTorch's own encoder layer, and its symmetries."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special
import torch

from tests.support.comparing import close
from warpgarment.kernels.deformation.gradients import face_centroids, inverse_rest_frames, segment_mean
from warpgarment.kernels.features.channels import FEATURES
from warpgarment.kernels.features.face import body_interaction, face_features
from warpgarment.kernels.sdf.bodies import BodyMeshes
from warpgarment.nn import heading
from warpgarment.nn.attention import EncoderLayer, ManifoldAwareAttention, geodesic_weights
from warpgarment.nn.config import STATISTICS, NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.nn.parametrisation import NetworkOutput
from warpgarment.nn.run import rotate_output

TINY = {"embedding": 24, "layers": 2, "feed_forward": 32, "heads": 3, "manifold_heads": 1, "history": 3}


def tiny(seed: int = 0, **changes) -> ManifoldAwareTransformer:
    """A small network with random weights and statistics, in evaluation mode."""
    torch.manual_seed(seed)
    network = ManifoldAwareTransformer(NetworkConfig.small(**(TINY | changes)))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    statistics = {n: torch.rand(k) + 0.5 if n.endswith("std") else torch.randn(k) for n, k in STATISTICS.items()}
    if network.config.residual:
        for name in ("psi_mean", "q_mean"):
            del statistics[name]
    network.set_statistics(statistics)
    return network.eval()


def inputs(batch: int, faces: int, components: int, history: int = 3, seed: int = 0):
    """Random features, velocities and distances."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(batch, faces, history * FEATURES, generator=generator)
    velocities = torch.randn(batch, components, (history - 1) * 3, generator=generator)
    points = torch.rand(batch, faces, 3, generator=generator)
    return features, velocities, torch.cdist(points, points)


def test_parameter_counts():
    """The networks would not be the ones described.

    One layer of width E and feed-forward G has 4 (E² + E) in its projections, 2 E G + G + E in its feed-forward and
    4 E in two normalisations. For E = G = 512: 1,050,624 + 525,312 + 2,048 = 1,577,984, eight times: 12,623,872.
    Embeddings of 340 and 27 numbers add 341·512 + 28·512 = 188,928, heads of 12 and 3 numbers 513·15 = 7,695:
    12,820,495 in all. For E = 128, G = 192: 66,048 + 49,472 + 512 = 116,032, four times 464,128; plus 369·128 = 47,232,
    129·15 = 1,935 and a last normalisation of 256: 513,551.
    """
    assert ManifoldAwareTransformer(NetworkConfig.base()).parameter_count() == 12_820_495
    assert ManifoldAwareTransformer(NetworkConfig.small()).parameter_count() == 513_551


def test_attention_matches_numpy():
    """Heads would mix up, or the manifold heads not apply the weights they are given.

    float64 NumPy twin; 1e-5 is a hundred float32 roundings of numbers around one.
    """
    torch.manual_seed(0)
    batch, faces, components, embedding, heads, manifold = 2, 7, 2, 12, 3, 1
    layer = ManifoldAwareAttention(embedding, heads, manifold, 0.0)
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    x = torch.randn(batch, faces + components, embedding)
    weights = torch.rand(batch, faces, faces)
    mask = torch.ones(batch, faces + components, dtype=torch.bool)
    mask[1, 5:7] = False
    result = layer(x, weights, mask[:, None, None])

    width, skip = embedding // heads, 2 * manifold * embedding // heads
    rows, bias = layer.qkv.weight.detach().double().numpy()[skip:], layer.qkv.bias.detach().double().numpy()[skip:]
    learned = (heads - manifold) * width
    expected = np.full((batch, faces + components, embedding), np.nan)
    for b in range(batch):
        projected = x[b].double().numpy() @ rows.T + bias
        query, key, value = projected[:, :learned], projected[:, learned : 2 * learned], projected[:, 2 * learned :]
        for h in range(heads):
            columns = slice(h * width, (h + 1) * width)
            if h < heads - manifold:
                score = query[:, columns] @ key[:, columns].T / np.sqrt(width)
                score[:, ~mask[b].numpy()] = -np.inf
                attention = scipy.special.softmax(score, axis=1)
            else:
                attention = np.eye(faces + components)
                attention[:faces, :faces] = weights[b].double().numpy()
            expected[b, :, columns] = attention @ value[:, columns]
    expected = expected @ layer.out.weight.detach().double().numpy().T + layer.out.bias.detach().double().numpy()
    close(result.detach(), expected, 1e-5)


@pytest.mark.parametrize("norm_first", [False, True])
@pytest.mark.parametrize("activation", ["relu", "gelu"])
def test_layer_without_manifold_heads_is_the_transformers(norm_first, activation):
    """The encoder layer would not be the standard one (residuals, order of normalisation, activation).

    torch.nn.TransformerEncoderLayer with the same weights; 1e-5 for another order of float32 sums.
    """
    torch.manual_seed(1)
    layer = EncoderLayer(16, 24, 4, 0, dropout=0.1, norm_first=norm_first, activation=activation).eval()
    twin = torch.nn.TransformerEncoderLayer(
        16, 4, 24, 0.1, activation=activation, batch_first=True, norm_first=norm_first
    ).eval()
    names = {
        "self_attn.in_proj_weight": layer.attention.qkv.weight,
        "self_attn.in_proj_bias": layer.attention.qkv.bias,
        "self_attn.out_proj.weight": layer.attention.out.weight,
        "self_attn.out_proj.bias": layer.attention.out.bias,
        "linear1.weight": layer.expand.weight,
        "linear1.bias": layer.expand.bias,
        "linear2.weight": layer.contract.weight,
        "linear2.bias": layer.contract.bias,
        "norm1.weight": layer.attention_norm.weight,
        "norm1.bias": layer.attention_norm.bias,
        "norm2.weight": layer.feed_forward_norm.weight,
        "norm2.bias": layer.feed_forward_norm.bias,
    }
    for parameter in names.values():
        torch.nn.init.normal_(parameter, std=0.5)
    twin.load_state_dict({name: parameter.detach() for name, parameter in names.items()})
    x = torch.randn(2, 9, 16)
    with torch.no_grad():
        close(layer(x, torch.zeros(1, 0, 0), None), twin(x).numpy(), 1e-5)


@pytest.mark.parametrize(("radius", "power"), [(1.0, 20.0), (0.1, 20.0), (0.3, 2.0), (0.5, 0.5), (2.0, 1e-3)])
def test_geodesic_weights(radius, power):
    """Manifold heads would listen to the wrong faces, or to NaN.

    SciPy's softmax in float64, 1e-5 because p = 20 turns float32 roundings of D/r into 20 times larger ones.
    """
    rng = np.random.default_rng(0)
    points = rng.random((12, 3)) * 2
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    distances[:5, 5:] = distances[5:, :5] = np.inf  # two components
    distances = distances.astype(np.float32)
    weights = geodesic_weights(torch.from_numpy(distances), radius, power)
    score = -np.where(np.isinf(distances), np.inf, (distances.astype(np.float64) / radius) ** power)
    close(weights, scipy.special.softmax(score, axis=1), 1e-5)
    close(weights.sum(1), np.ones(12), 1e-6)
    assert (weights[:5, 5:] == 0).all()


def test_geodesic_weights_at_the_edges_of_float32():
    """A large garment, or a padded row, would turn the whole batch into NaN."""
    distances = torch.tensor([[0.0, 1e3, torch.inf], [1e3, 0.0, torch.inf], [torch.inf] * 3])
    weights = geodesic_weights(distances, 0.01, 20.0)  # (1e5)^20 overflows
    assert torch.equal(weights, torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 0]]))


@pytest.mark.parametrize("heading_setting", ["world", "canonical"])
def test_padding_changes_nothing(heading_setting):
    """A garment's prediction would depend on what else is in its batch. 2e-5: sums run over other lengths."""
    network = tiny(heading=heading_setting)
    sizes, components = [9, 4, 6], [1, 3, 2]
    features = torch.full((3, 9, 3 * FEATURES), torch.nan)  # poison
    velocities = torch.full((3, 3, 6), torch.nan)
    weights = torch.zeros(3, 9, 9)
    face_mask, velocity_mask = torch.zeros(3, 9, dtype=torch.bool), torch.zeros(3, 3, dtype=torch.bool)
    alone = []
    for i, (n, c) in enumerate(zip(sizes, components, strict=True)):
        f, v, d = inputs(1, n, c, seed=i)
        w = geodesic_weights(d, 0.5, 4.0)
        alone.append(network(f, v, w))
        features[i, :n], velocities[i, :c], weights[i, :n, :n] = f[0], v[0], w[0]
        face_mask[i, :n] = velocity_mask[i, :c] = True
    together = network(features, velocities, weights, face_mask=face_mask, velocity_mask=velocity_mask)
    for part in together:
        assert torch.isfinite(part).all()
    for i, (n, c) in enumerate(zip(sizes, components, strict=True)):
        close(together.psi[i, :n].detach(), alone[i].psi[0].detach(), 2e-5)
        close(together.singular_values[i, :n].detach(), alone[i].singular_values[0].detach(), 2e-5)
        close(together.velocity[i, :c].detach(), alone[i].velocity[0].detach(), 2e-5)


def test_shared_weights_are_the_repeated_ones():
    """A batch of one garment many times would go another way than garments that differ. 2e-5: another order of sums."""
    network = tiny()
    features, velocities, distances = inputs(3, 8, 1)
    weights = geodesic_weights(distances[:1], 0.5, 4.0)
    shared = network(features, velocities, weights)
    repeated = network(features, velocities, weights.repeat(3, 1, 1))
    for a, b in zip(shared, repeated, strict=True):
        close(a.detach(), b.detach(), 2e-5)


def test_manifold_heads_keep_to_the_manifold():
    """Another piece, or the velocity token, would leak into faces it has no way to. Exact: nothing may change."""
    network = tiny(heads=3, manifold_heads=3, heading="world")
    features, velocities, distances = inputs(1, 8, 2)
    distances[:, :3, 3:] = distances[:, 3:, :3] = torch.inf
    weights = geodesic_weights(distances, 0.5, 4.0)
    before = network(features, velocities, weights)
    other = features.clone()
    other[:, 3:] += 1.0
    velocities = velocities.clone()
    velocities[:, 1] += 1.0
    after = network(other, velocities, weights)
    assert torch.equal(before.psi[:, :3], after.psi[:, :3])
    assert torch.equal(before.velocity[:, 0], after.velocity[:, 0])
    assert (before.psi[:, 3:] - after.psi[:, 3:]).abs().amin(dim=(2, 3)).gt(0).all()
    assert (before.velocity[:, 1] - after.velocity[:, 1]).abs().gt(0).all()


def test_face_order_does_not_matter():
    """Results would depend on how the mesh file numbers its faces. 2e-5: another order of sums."""
    network = tiny()
    features, velocities, distances = inputs(1, 9, 1)
    order = torch.randperm(9, generator=torch.Generator().manual_seed(3))
    weights = geodesic_weights(distances, 0.5, 4.0)
    plain = network(features, velocities, weights)
    shuffled = network(features[:, order], velocities, weights[:, order][:, :, order])
    close(shuffled.psi.detach(), plain.psi[:, order].detach(), 2e-5)
    close(shuffled.velocity.detach(), plain.velocity.detach(), 2e-5)


def test_rotated_features_are_the_features_of_rotated_meshes():
    """The canonical heading would turn some feature the wrong way.

    The feature kernel on garment and body that were turned; 2e-4 for float32 positions around one metre and inverses of
    edges of centimetres.
    """
    rng = np.random.default_rng(0)
    faces = torch.tensor([[0, 1, 2], [2, 1, 3], [2, 3, 4]], dtype=torch.int32)
    rest = torch.from_numpy(rng.normal(0, 0.3, (5, 3)).astype(np.float32))
    vertices = torch.from_numpy(rng.normal(0, 0.5, (5, 3)).astype(np.float32)) + 1.0
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=np.float32)
    body_faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=torch.int32)
    body = torch.from_numpy(corners)
    moved = body + 0.1 * torch.from_numpy(rng.normal(size=(4, 3)).astype(np.float32))
    one_garment = torch.zeros(3, dtype=torch.int32)

    def features(turn: torch.Tensor) -> torch.Tensor:
        v, b, m = vertices @ turn.T, body @ turn.T, moved @ turn.T
        centroids = face_centroids(v, faces)
        interaction = body_interaction(centroids, None, BodyMeshes(b, body_faces), m)
        mean = segment_mean(centroids, one_garment, 1)
        return face_features(inverse_rest_frames(rest, faces), v, faces, one_garment, mean, interaction)

    turn = heading.rotation_about_up(torch.tensor([0.7]))
    expected = features(turn[0])
    result = heading.rotate_features(features(torch.eye(3)).repeat(1, 2)[None], turn).unflatten(-1, (2, FEATURES))
    for name, place in heading.LAYOUT.items():
        for frame in range(2):  # of the history
            assert (result[0, :, frame, place] - expected[:, place]).abs().max() < 2e-4, name


@pytest.mark.parametrize("angle", [0.3, 2.0, -3.1])
def test_canonical_heading_turns_with_the_garment(angle):
    """The network would have to learn every compass direction. 1e-4, for random weights of order one."""
    network = tiny(heading="canonical")
    features, velocities, distances = inputs(2, 10, 2)
    weights = geodesic_weights(distances, 0.5, 4.0)
    turn = heading.rotation_about_up(torch.tensor([angle, -0.5 * angle]))
    plain = network(features, velocities, weights)
    turned = network(heading.rotate_features(features, turn), heading.rotate_vectors(velocities, turn), weights)
    expected = NetworkOutput(
        turn[:, None] @ plain.psi @ turn[:, None].mT,
        plain.singular_values,
        (turn[:, None] @ plain.velocity[..., None]).squeeze(-1),
    )
    for a, b in zip(turned, expected, strict=True):
        close(a.detach(), b.detach(), 1e-4)
    world = tiny(heading="world")
    moved = world(heading.rotate_features(features, turn), heading.rotate_vectors(velocities, turn), weights)
    unmoved = rotate_output(world(features, velocities, weights), turn)
    assert (moved.velocity - unmoved.velocity).abs().max() > 1e-2  # else this test would show nothing


def test_yaw_of_a_turned_garment():
    """Headings would be measured about the wrong axis or with the wrong sign. Analytic; 1e-6 rad."""
    tilt = torch.tensor([[1.0, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])  # a lean forward has no heading
    turn = heading.rotation_about_up(torch.tensor([1.1, -2.9]))
    phi = (turn @ tilt)[:, None].repeat(1, 4, 1, 1)
    phi[:, 3] = torch.nan  # padding
    mask = torch.tensor([[True, True, True, False]] * 2)
    close(heading.yaw(phi, mask), [1.1, -2.9], 1e-6)
    forward = heading.rotation_about_up(torch.tensor([np.pi / 2])) @ torch.tensor([0.0, 0, 1])
    close(forward, [[1.0, 0, 0]], 1e-6)  # +Z turns to +X about +Y


def test_untrained_residual_network_moves_like_skin():
    """A residual network would start with noise instead of its prior. Exact."""
    torch.manual_seed(0)
    network = ManifoldAwareTransformer(NetworkConfig.small(**TINY)).eval()
    features, velocities, distances = inputs(2, 6, 1)
    output = network(features, velocities, geodesic_weights(distances, 0.5, 4.0))
    close(output.psi.detach(), torch.eye(3).expand(2, 6, 3, 3), 1e-6)  # turned there and back by the heading
    assert (output.singular_values == 1).all()
    assert (output.velocity == 0).all()


def test_normalisation_goes_there_and_back():
    """Losses in normalised units would be taken against other targets than the output means. 1e-5 relative to one."""
    network = tiny()
    output = NetworkOutput(torch.randn(2, 5, 3, 3), torch.randn(2, 5, 3), torch.randn(2, 1, 3))
    for a, b in zip(network.denormalise(network.normalise_targets(output)), output, strict=True):
        close(a, b, 1e-5)
    features, velocities, _ = inputs(2, 5, 1)
    x, v = network.encode(features), network.encode_velocities(velocities)
    mean, std = network.feature_mean.double().numpy(), network.feature_std.double().numpy()
    expected = (features.double().numpy().reshape(2, 5, 3, FEATURES) - mean) / std
    close(x, expected.reshape(2, 5, -1), 1e-4)
    mean, std = network.velocity_mean.double().numpy(), network.velocity_std.double().numpy()
    close(v, ((velocities.double().numpy().reshape(2, 1, 2, 3) - mean) / std).reshape(2, 1, -1), 1e-4)


def test_every_weight_learns():
    """Part of the network would be dead. The query and key rows of manifold heads are, by construction: no others."""
    network = tiny(manifold_heads=1)
    features, velocities, distances = inputs(1, 7, 2)
    output = network(features, velocities, geodesic_weights(distances, 0.5, 4.0))
    sum(part.square().sum() for part in output).backward()
    skipped = 2 * network.config.manifold_heads * network.config.embedding // network.config.heads
    for name, parameter in network.named_parameters():
        gradient = parameter.grad
        assert torch.isfinite(gradient).all(), name
        if "qkv" in name:
            assert (gradient[:skipped] == 0).all(), name
            gradient = gradient[skipped:]
        assert gradient.abs().max() > 0, name


def test_half_precision_keeps_positions():
    """bfloat16 would round velocities of millimetres to nothing, or the results come back in another type.

    Output is identity plus a normalised term of order 0.3: bfloat16 keeps two digits of the latter.
    """
    network = tiny()
    features, velocities, distances = inputs(1, 7, 1)
    weights = geodesic_weights(distances, 0.5, 4.0)
    exact = network(features, velocities, weights)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = network(features, velocities, weights)
    for a, b in zip(half, exact, strict=True):
        assert a.dtype == torch.float32
        assert (a - b).abs().max() < 0.03 * max(1.0, b.abs().max().item())


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"heads": 5}, "heads"),
        ({"manifold_heads": 9}, "manifold_heads"),
        ({"layers": 0}, "layers"),
        ({"history": 1}, "history"),
        ({"dropout": 1.0}, "dropout"),
        ({"geodesic_radius": 0.0}, "geodesic_radius"),
        ({"geodesic_power": float("nan")}, "geodesic_power"),
        ({"heading": "north"}, "heading"),
        ({"activation": "tanh"}, "activation"),
    ],
)
def test_config_refuses_nonsense(changes, word):
    """A typo in a setting would show as a strange error deep in torch, or not at all."""
    with pytest.raises(ValueError, match=word):
        NetworkConfig(**changes)


@pytest.mark.parametrize(
    ("statistics", "word"),
    [
        ({"feature_means": torch.zeros(34)}, "feature_means"),
        ({"feature_mean": torch.zeros(33)}, r"\[34\]"),
        ({"q_std": torch.tensor([1.0, 0.0, 1.0])}, "positive"),
        ({"psi_std": torch.full((9,), torch.nan)}, "finite"),
        ({"psi_mean": torch.zeros(9)}, "residual"),
    ],
)
def test_statistics_refuse_nonsense(statistics, word):
    """Statistics that divide by zero, or that move a residual network off its prior, would be trained with."""
    network = ManifoldAwareTransformer(NetworkConfig.small(**TINY))
    with pytest.raises(ValueError, match=word):
        network.set_statistics(statistics)
