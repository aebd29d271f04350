"""Growing a network: the larger one must predict the same, and be able to learn something else."""

import dataclasses

import pytest
import torch
from support import sequences as synthetic_sequences
from support.runs import config_for

from warpgarment.nn import checkpoint
from warpgarment.nn.architecture import GrowthError, build_network
from warpgarment.nn.attention import geodesic_weights
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.faces.grow import grow
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.training.samples.pushforward import PushforwardConfig
from warpgarment.training.train.config import TrainConfig
from warpgarment.training.train.start import train

SMALL = NetworkConfig.small(embedding=16, layers=2, feed_forward=24, heads=4, manifold_heads=2, dropout=0.0, history=3)
SHAPES = {
    "wider": {"embedding": 32},
    "deeper": {"layers": 5},
    "more_hidden": {"feed_forward": 40},
    "more_and_wider_heads": {"embedding": 64, "heads": 8, "manifold_heads": 2},
    "no_learned_heads_added": {"embedding": 48, "heads": 6, "manifold_heads": 4},
    "like_base": {"embedding": 64, "layers": 4, "feed_forward": 64, "heads": 8, "manifold_heads": 2},
}


def _network(config=SMALL, seed=0):
    """A network none of whose parameters or statistics is zero or one."""
    torch.manual_seed(seed)
    network = ManifoldAwareTransformer(config)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
        network.feature_std.uniform_(0.5, 2.0)
        network.singular_value_std.uniform_(0.5, 2.0)
    return network.eval()


def _inputs(seed=1):
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn((2, 12, SMALL.history * 34), generator=generator)
    velocities = torch.randn((2, 1, (SMALL.history - 1) * 3), generator=generator)
    distances = 0.2 * torch.rand((2, 12, 12), generator=generator)
    return features, velocities, geodesic_weights(distances, SMALL.geodesic_radius, SMALL.geodesic_power)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_grown_network_predicts_the_same(shape):
    """If this fails, growing throws away what was learned. Tolerance: float64 throughout, sums in another order."""
    small = _network().double()
    large = grow(small, dataclasses.replace(SMALL, **SHAPES[shape]))
    inputs = [x.double() for x in _inputs()]
    for name, before, after in zip(("psi", "singular values", "q"), small(*inputs), large(*inputs), strict=True):
        assert before.std() > 1e-2, "a network that says nothing proves nothing"
        torch.testing.assert_close(after, before, rtol=0, atol=1e-11, msg=lambda m, n=name: f"{n}: {m}")


def test_copies_part_ways():
    """If this fails, a network four times as wide learns like the narrow one: its copies get the same gradients."""
    config = dataclasses.replace(SMALL, **SHAPES["like_base"])
    large = grow(_network(), config)
    optimizer = torch.optim.SGD(large.parameters(), lr=1e-2)
    for _ in range(2):  # what starts at zero hides what is behind it from the first step
        optimizer.zero_grad()
        sum((x**2).mean() for x in large(*_inputs())).backward()
        optimizer.step()
    rows = large.embed_faces.weight.detach().unflatten(0, (4, 16))
    assert (rows[1:] - rows[:1]).abs().amax(dim=(0, 2)).min() > 1e-6
    still = [n for n, p in large.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert not still, "every parameter learns, new ones too"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"embedding": 40}, "multiple"),
        ({"layers": 1}, "layers"),
        ({"feed_forward": 8}, "feed_forward"),
        ({"manifold_heads": 3}, "learned heads"),
        ({"heads": 8}, "channels of manifold heads"),
        ({"geodesic_radius": 0.5}, "geodesic_radius"),
        ({"history": 4}, "history"),
    ],
)
def test_shapes_that_do_not_contain_the_old_one_are_refused(change, named):
    """If this fails, growing gives a network that is broken, or says nothing about why it cannot."""
    with pytest.raises(GrowthError, match=named):
        grow(_network(), dataclasses.replace(SMALL, **change))


def test_post_norm_is_refused():
    """If this fails, a new layer that should do nothing normalises the stream."""
    config = dataclasses.replace(SMALL, norm_first=False)
    with pytest.raises(GrowthError, match="norm_first"):
        grow(_network(config), dataclasses.replace(config, layers=3))


def test_training_starts_from_a_grown_network(tmp_path):
    """If this fails, `--grow` trains the small shape, or starts from nothing: compared without a single useful step."""
    data = synthetic_sequences.write_set(tmp_path / "set", train=2, frames=16)
    small = _network(NetworkConfig.small(embedding=16, layers=1, feed_forward=16, heads=2, manifold_heads=1))
    small.save(tmp_path / "small.safetensors")
    shape = ("embedding=32", "layers=3", "feed_forward=24", "heads=4", "manifold_heads=2", "dropout=0.0")
    settings = {"overrides": shape, "init": tmp_path / "small.safetensors", "grow": True, "steps": 1, "lr": 1e-12}
    file = train(config_for(data, tmp_path / "run", **settings, pushforward=PushforwardConfig(share=0.0)))
    large = ManifoldAwareTransformer.load(file).eval()
    assert (large.config.embedding, large.config.layers) == (32, 3)
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn((1, 9, 340), generator=generator), torch.randn((1, 1, 27), generator=generator)
    weights = torch.full((1, 9, 9), 1.0 / 9.0)
    for before, after in zip(small(*inputs, weights), large(*inputs, weights), strict=True):
        torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4)  # float32, outputs of order one


@pytest.mark.parametrize("preset", ["small", "fast"])
def test_growing_gives_a_checkpoint_that_loads_or_says_why_not(tmp_path, preset):
    """If this fails, `--grow` trains a network whose checkpoint cannot be loaded: of faces, set up as of patches."""
    data = synthetic_sequences.write_set(tmp_path / "set", train=2, frames=16)
    shape = {"embedding": 16, "layers": 1, "feed_forward": 16, "heads": 2, "manifold_heads": 1, "face_embedding": 16}
    build_network(getattr(NetworkConfig, preset)(**shape)).save(tmp_path / "small.safetensors")
    overrides = ("embedding=32", "layers=2", "feed_forward=24", "heads=4", "manifold_heads=2", "face_embedding=16")
    settings = {"network": preset, "overrides": (*overrides, "dropout=0.0"), "steps": 1, "grow": True}
    settings |= {"init": tmp_path / "small.safetensors", "pushforward": PushforwardConfig(share=0.0)}
    config = config_for(data, tmp_path / "run", **settings)
    if preset == "fast":
        with pytest.raises(GrowthError, match=r"architecture='patches'.*Leave out grow"):
            train(config)
        assert not (tmp_path / "run").exists(), "refused before anything is written"
    else:
        assert checkpoint.load(train(config)).config == config.network_config()


def test_growing_needs_something_to_grow(tmp_path):
    """If this fails, a forgotten --init trains from random weights without a word."""
    with pytest.raises(ValueError, match="init"):
        TrainConfig(data=tmp_path, out=tmp_path, steps=1, grow=True)
