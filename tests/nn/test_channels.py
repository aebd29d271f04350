"""Networks that read only some of the feature channels, and the channels in their checkpoints."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors import safe_open
from support.scenes import outfit

from warpgarment.errors import CheckpointError
from warpgarment.kernels.features.channels import FACE
from warpgarment.nn import checkpoint
from warpgarment.nn.attention import geodesic_weights
from warpgarment.nn.config import CHANNELS, NetworkConfig
from warpgarment.nn.faces.network import ManifoldAwareTransformer
from warpgarment.nn.network import GarmentNetwork
from warpgarment.nn.patches.layout import garment_patches, patch_layout
from warpgarment.nn.patches.network import PatchTransformer

SOME = ("normal", "deformation_gradient", "body_velocity")  # not in the order of the table
TINY = {"embedding": 16, "layers": 1, "feed_forward": 16, "heads": 2, "history": 3, "dropout": 0.0}
PATCHED = {"face_embedding": 12, "face_feed_forward": 12, "face_layers": 1}
KINDS = {"faces": (ManifoldAwareTransformer, NetworkConfig.small), "patches": (PatchTransformer, NetworkConfig.fast)}


def pair(kind: str) -> tuple[GarmentNetwork, GarmentNetwork]:
    """A network of all channels that gives no weight to those a second one does not read; otherwise the same."""
    network, preset = KINDS[kind]
    changes = TINY | (PATCHED if kind == "patches" else {})
    torch.manual_seed(0)
    full, some = network(preset(**changes)), network(preset(**changes, channels=SOME))
    for parameter in full.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    full.set_statistics({"feature_mean": torch.randn(FACE.width), "feature_std": torch.rand(FACE.width) + 0.5})
    tensors = {name: tensor.clone() for name, tensor in full.state_dict().items()}
    weight = full.embed_faces.weight.detach().unflatten(1, (-1, FACE.width))
    for name in set(FACE.names) - set(SOME):
        weight[..., FACE.slices[name]] = 0.0
    tensors["embed_faces.weight"] = FACE.take(weight, SOME).flatten(1)
    for name in ("feature_mean", "feature_std"):
        tensors[name] = FACE.take(tensors[name], SOME)
    some.load_state_dict(tensors)
    return full.eval(), some.eval()


@pytest.mark.parametrize("kind", KINDS)
def test_a_network_of_some_channels_reads_these(kind):
    """It would read other columns, or turn them as if they were others. 1e-5: another order of sums of order one."""
    full, some = pair(kind)
    garment = outfit()
    features = torch.randn(1, len(garment.faces), 3 * FACE.width)
    velocities = torch.randn(1, 2, 6)
    if kind == "patches":
        weights = patch_layout([garment_patches(garment, 0.15)], 0.15, 2.0)
    else:
        weights = geodesic_weights(torch.from_numpy(garment.geodesics)[None], 0.15, 2.0)
    expected, found = full(features, velocities, weights), some(features, velocities, weights)
    assert (expected.psi - torch.eye(3)).abs().max() > 0.1
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


def test_what_a_file_says(tmp_path):
    """A network would be loaded with other channels than it was trained on, or its file not by an older program."""
    for name, channels in (("all", CHANNELS), ("some", SOME)):
        network = ManifoldAwareTransformer(NetworkConfig.small(**TINY, channels=channels))
        network.save(tmp_path / f"{name}.safetensors")
        assert checkpoint.load(tmp_path / f"{name}.safetensors").config == network.config
        with safe_open(str(tmp_path / f"{name}.safetensors"), "pt") as stored:
            config = json.loads(stored.metadata()["config"])
        assert config.get("channels") == (None if name == "all" else list(SOME))


def test_channels_that_there_are_not(tmp_path):
    """A file of a later program would be read with other channels. Its message names the one that is missing."""
    with pytest.raises(ValueError, match="no feature channel 'colour'"):
        NetworkConfig(channels=("normal", "colour"))
    with pytest.raises(ValueError, match="at least one"):
        NetworkConfig(channels=())
    network = ManifoldAwareTransformer(NetworkConfig.small(**TINY, channels=SOME))
    object.__setattr__(network.config, "channels", ("normal", "colour"))
    network.save(tmp_path / "later.safetensors")
    with pytest.raises(CheckpointError, match=r"later\.safetensors: no feature channel 'colour'"):
        checkpoint.load(tmp_path / "later.safetensors")
