"""The head of faces by kernels in training, beside the same layers by torch in float64."""

from __future__ import annotations

import copy

import pytest
import torch
from support.poison import poison_outputs

from warpgarment.kernels.dense import products
from warpgarment.nn.architecture import build_network
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.patches import trained_head
from warpgarment.nn.patches.network import PatchTransformer

pytestmark = pytest.mark.skipif(not products.available(), reason="this processor has no vectors")


def network_of(width: int) -> PatchTransformer:
    torch.manual_seed(0)
    shape = {"embedding": 32, "feed_forward": 32, "heads": 2, "manifold_heads": 1, "layers": 1, "history": 3}
    network = build_network(NetworkConfig.fast(**shape, face_embedding=width, face_feed_forward=32))
    for parameter in (*network.face_norm.parameters(), *network.face_head.parameters()):
        torch.nn.init.normal_(parameter, std=0.3)
    return network


def answers(network: PatchTransformer, faces: int, dtype: torch.dtype) -> list[torch.Tensor]:
    """The result, and the gradients of the faces and of all weights, of a head that is used twice."""
    random = torch.Generator().manual_seed(2)
    x = (3.0 + 2.0 * torch.randn(faces, network.face_norm.weight.numel(), generator=random)).to(dtype)
    slope = torch.randn(faces, 12, generator=random).to(dtype)
    x.requires_grad_()
    if dtype == torch.float32:
        assert trained_head.fits(network, x)
        results = [trained_head.forward(network, x) for _ in range(2)]
    else:
        assert not trained_head.fits(network, x)
        results = [network.face_head(network.face_norm(x)) for _ in range(2)]
    leaves = [x, *network.face_norm.parameters(), *network.face_head.parameters()]
    return [results[0].detach(), *torch.autograd.grad(results, leaves, [slope, 2.0 * slope])]


@pytest.mark.parametrize(("faces", "width"), [(1, 32), (77, 64), (1500, 128)])
def test_gradients_are_those_of_the_layers(faces, width, monkeypatch):
    """A face at the end of a block is not computed, or a weight gets the gradient of another, or of one call alone.
    1e-5 of the norm of each, in float32."""
    allocated, network = poison_outputs(monkeypatch), network_of(width)
    found = answers(network, faces, torch.float32)
    assert len(allocated) == 8
    expected = answers(copy.deepcopy(network).double(), faces, torch.float64)
    for one, other in zip(found, expected, strict=True):
        assert (one - other).norm() <= 1e-5 * other.norm()


def test_weights_that_change_are_folded_anew():
    """After a step of the optimiser the head still has its old weights."""
    network = network_of(32)
    before = answers(network, 40, torch.float32)
    for parameter in network.parameters():
        parameter.grad = torch.ones_like(parameter)
    torch.optim.AdamW(network.parameters(), lr=0.1, fused=True).step()
    after = answers(network, 40, torch.float32)
    assert not torch.allclose(before[0], after[0])
    for one, other in zip(after, answers(copy.deepcopy(network).double(), 40, torch.float64), strict=True):
        assert (one - other).norm() <= 1e-5 * other.norm()


def test_threads_change_no_bit():
    """Results depend on how many threads there are."""
    network, threads, found = network_of(64), torch.get_num_threads(), []
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            found.append(answers(network, 1500, torch.float32))
    finally:
        torch.set_num_threads(threads)
    for place, (one, other) in enumerate(zip(*found, strict=True)):
        assert torch.equal(one, other) or place in (2, 3)  # the norm's, for which torch's products may differ
