"""The step of faces in one launch, beside the operators of the network that have gradients."""

import pytest
import torch
from support.comparing import close
from support.meshes import irregular_grid, skirt, two_components

from warpgarment.kernels.features.channels import FACE, LAYOUT
from warpgarment.nn.architecture import build_network
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.inputs import FrameInputs, Frames
from warpgarment.objects.garment import Garment
from warpgarment.objects.pack import PackedGarments

GARMENTS = [Garment(*mesh) for mesh in (irregular_grid(8, 5), two_components(), skirt(12, 4))]
SHAPE = {"embedding": 16, "feed_forward": 16, "heads": 2, "manifold_heads": 1, "layers": 1, "history": 3,
         "face_embedding": 16, "face_feed_forward": 16, "patch_spacing": 0.15, "dropout": 0.0}  # fmt: skip


@pytest.mark.parametrize("heading", ["world", "canonical"])
@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("chosen", [(1,), (0, 1, 2, 1)])
def test_it_is_what_the_operators_make(chosen, residual, heading):
    """A simulation would take other steps than training: turned the wrong way, beside another face's body, unscaled.

    Garments of other sizes in padded rows, and pieces. With gradients, `predict` goes operator by operator. 1e-5 of
    numbers around one: the network in float32, whose products are added up in another order there.
    """
    torch.manual_seed(0)
    network = build_network(NetworkConfig.fast(**SHAPE, residual=residual, heading=heading)).eval()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    network.set_statistics({"psi_std": torch.rand(9) + 0.5, "singular_value_std": torch.rand(3) + 0.5,
                            "singular_value_mean": torch.rand(3), "q_std": torch.rand(3) + 0.5})  # fmt: skip
    garments = [GARMENTS[k] for k in chosen]
    packed = PackedGarments.pack(garments, torch.device("cpu"))
    features = torch.randn(len(packed.faces), 3, FACE.width)
    near = torch.linalg.qr(torch.randn(len(features), 3, 3))[0]
    near[near.det() < 0.0] *= -1.0
    features[:, -1, LAYOUT["body_deformation"]] = (near + 0.1 * torch.randn_like(near)).flatten(1)
    velocities = torch.randn(packed.component_count, 2, 3)
    layout = network.layout(garments, packed)
    given = FrameInputs(features, velocities, packed.rest_vertices, *[torch.zeros(1, 3)] * 2)
    expected = network.predict(given, layout)
    with torch.no_grad():
        result = network.predict(given, layout)
        frames = network.predict(given._replace(features=Frames(features.unbind(1))), layout)
    for one, other in zip(result, expected, strict=True):
        close(one, other.detach(), 1e-5 * max(1.0, other.abs().max().item()))
    assert all(torch.equal(one, other) for one, other in zip(result, frames, strict=True))  # of a large batch
