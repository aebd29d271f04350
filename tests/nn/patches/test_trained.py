"""A layer of faces by kernels in training, beside the same layer by torch in float64."""

from __future__ import annotations

import copy

import pytest
import torch

from warpgarment.kernels.dense import products
from warpgarment.nn.patches import trained
from warpgarment.nn.patches.bags import Bags, Sums
from warpgarment.nn.patches.network import FaceLayer

pytestmark = pytest.mark.skipif(not products.available(), reason="this processor has no vectors")


def layer_of(width: int, hidden: int, hears: bool) -> FaceLayer:
    torch.manual_seed(0)
    layer = FaceLayer(width, hidden, "gelu", hears)
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return layer


def neighbours(faces: int) -> Sums:
    """The mean over three faces, some of them heard by many and some by none."""
    index = torch.randint(0, faces, (3 * faces,), generator=torch.Generator().manual_seed(1)) ** 2 // faces
    return Sums(Bags(index, torch.arange(0, 3 * faces, 3), torch.full((3 * faces,), 1.0 / 3.0)), faces)


def answers(layer: FaceLayer, faces: int, sums: Sums | None, dtype: torch.dtype) -> list[torch.Tensor]:
    """The result, and the gradients of the faces and of all weights."""
    generator = torch.Generator().manual_seed(2)
    x, slope = torch.randn(2, faces, layer.expand.in_features, generator=generator).to(dtype)
    x.requires_grad_()
    result = layer(x, sums)
    return [result.detach(), *torch.autograd.grad(result, [x, *layer.parameters()], slope)]


@pytest.mark.parametrize("hears", [False, True])
@pytest.mark.parametrize(("faces", "width", "hidden"), [(1, 32, 32), (77, 64, 96), (900, 128, 128), (40, 256, 256)])
def test_gradients_are_those_of_the_layer(hears, faces, width, hidden):
    """A sum lacks the last faces of a block, a weight gets the gradient of another, or a neighbour none. 3e-5 of the
    norm of each: products without lo lo' are 4e-6 off, torch's float32 is 1e-6 off."""
    layer, sums = layer_of(width, hidden, hears), neighbours(faces)
    x = torch.zeros(faces, width)
    assert trained.fits(layer, x, sums)
    assert not trained.fits(layer, x.double(), sums)
    found = answers(layer, faces, sums, torch.float32)
    expected = answers(copy.deepcopy(layer).double(), faces, sums, torch.float64)
    names = ["result", "faces", *dict(layer.named_parameters())]
    for name, one, other in zip(names, found, expected, strict=True):
        assert (one - other).norm() <= 3e-5 * other.norm(), name


@pytest.mark.parametrize("fused", [None, False, True, "by hand"])
def test_weights_that_change_are_packed_anew(fused):
    """After a step of the optimiser the layer still has its old weights; a fused one does not count its changes,
    nor are those counted that are written by hand after gradients were asked for."""
    layer, sums = layer_of(32, 32, True), neighbours(50)
    before = answers(layer, 50, sums, torch.float32)
    if fused == "by hand":
        for parameter in layer.parameters():
            parameter.data.mul_(1.5)
    elif fused is None:
        with torch.no_grad():
            for parameter in layer.parameters():
                parameter.mul_(1.5)
    else:
        for parameter in layer.parameters():
            parameter.grad = torch.ones_like(parameter)
        torch.optim.AdamW(layer.parameters(), lr=0.1, fused=fused).step()
    after = answers(layer, 50, sums, torch.float32)
    expected = answers(copy.deepcopy(layer).double(), 50, sums, torch.float64)
    assert not torch.allclose(before[0], after[0])
    for one, other in zip(after, expected, strict=True):
        assert (one - other).norm() <= 3e-5 * other.norm()


def test_threads_change_no_bit():
    """Sums of gradients depend on how many threads there are."""
    layer, sums = layer_of(64, 64, True), neighbours(1500)
    threads, found = torch.get_num_threads(), []
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            found.append(answers(layer, 1500, sums, torch.float32))
    finally:
        torch.set_num_threads(threads)
    # torch's own products of the norm's gradients may differ in their last bits with its threads
    names = ["result", "faces", *dict(layer.named_parameters())]
    for name, one, other in zip(names, *found, strict=True):
        if not name.startswith("norm"):
            assert torch.equal(one, other), name
