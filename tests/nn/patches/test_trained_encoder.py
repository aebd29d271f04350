"""The encoder on patches by kernels in training, beside the same encoder by torch in float64."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from support import meshes

from warpgarment.kernels.dense import products
from warpgarment.kernels.dense.trained import encoder as kernels
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.patches import trained_encoder
from warpgarment.nn.patches.layout import PatchLayout, garment_patches, patch_layout
from warpgarment.nn.patches.network import PatchTransformer
from warpgarment.objects.garment import Garment

pytestmark = pytest.mark.skipif(not products.available(), reason="this processor has no vectors")


def network_of(**changes: object) -> PatchTransformer:
    torch.manual_seed(0)
    network = PatchTransformer(NetworkConfig.fast(layers=2, patch_spacing=0.1, **changes))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    return network


def layout_of(sizes: list[int]) -> PatchLayout:
    """Patches of square cloths, of which all but the largest are padded."""
    garments = []
    for size in sizes:
        mesh = meshes.irregular_grid(size, size, 0.05 * size, 0.05 * size)
        garments.append(Garment(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)))
    return patch_layout([garment_patches(garment, 0.1) for garment in garments], 0.15, 2.0)


def answers(network: PatchTransformer, layout: PatchLayout, rows: int, dtype: torch.dtype) -> list[torch.Tensor]:
    """Both results, and the gradients of faces, velocities and all weights."""
    count, pieces = layout.patch.shape[1], layout.pieces.shape[1]
    generator = torch.Generator().manual_seed(2)
    width, embedding = network.config.face_embedding, network.config.embedding
    shapes = (rows, count, width), (rows, pieces, embedding), (rows * count, width), (rows, pieces, 3)
    faces, given, slope, of_velocity = (torch.randn(shape, generator=generator).to(dtype) for shape in shapes)
    inputs = [faces.requires_grad_(), given.requires_grad_(), *trained_encoder._parameters(network)]
    parts = {name: getattr(layout, name).to(dtype) for name in ("share", "member_weight", "pieces", "weights")}
    results = network._encoded(faces, given, layout._replace(**parts), None)
    return [part.detach() for part in results] + list(torch.autograd.grad(results, inputs, (slope, of_velocity)))


def names(network: PatchTransformer) -> list[str]:
    known = {id(parameter): name for name, parameter in network.named_parameters()}
    return [
        "faces",
        "velocity",
        "of faces",
        "of velocity",
        *(known[id(p)] for p in trained_encoder._parameters(network)),
    ]


@pytest.mark.parametrize("manifold", [0, 2, 4])
@pytest.mark.parametrize(("sizes", "rows"), [([9], 1), ([9], 3), ([12, 7], 2)])
def test_gradients_are_those_of_the_encoder(manifold, sizes, rows):
    """A head would read the keys of another, patches of padding be attended to, or a weight get another's gradient.
    1e-5 of the norm of each: kernels are up to 1.1e-6 off, torch's float32 5e-7."""
    network, layout = network_of(manifold_heads=manifold), layout_of(sizes)
    assert trained_encoder.fits(network, torch.zeros(rows, 1, 128), layout)
    assert (layout.mask is not None) == (len(sizes) > 1)
    found = answers(network, layout, rows, torch.float32)
    expected = answers(copy.deepcopy(network).double(), layout, rows, torch.float64)
    for name, one, other in zip(names(network), found, expected, strict=True):
        assert (one - other).norm() <= 1e-5 * other.norm(), name


def test_memory_is_written_before_it_is_read(monkeypatch):
    """Numbers of an earlier call would be part of the result. Exact: memory holds NaN before each launch."""
    network, layout = network_of(), layout_of([12, 7])
    found = answers(network, layout, 2, torch.float32)
    monkeypatch.setattr(kernels, "allocate", lambda shape, dtype, device: torch.full(tuple(shape), torch.nan))
    for name, one, other in zip(names(network), answers(network, layout, 2, torch.float32), found, strict=True):
        assert torch.equal(one, other), name


def test_threads_change_no_bit():
    """Gradients of weights would depend on which thread adds them up, and when."""
    network, layout, found = network_of(), layout_of([12, 7]), []
    threads = torch.get_num_threads()
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            found.append(answers(network, layout, 2, torch.float32))
    finally:
        torch.set_num_threads(threads)
    for name, one, other in zip(names(network), *found, strict=True):
        assert torch.equal(one, other), name


def test_uses_of_weights_add_up_and_passes_do_not():
    """The gradient of two uses would be that of one, or a second backward pass would get that of the first as well."""
    network, layout = network_of(), layout_of([9])
    faces = torch.randn(1, layout.patch.shape[1], 128, generator=torch.Generator().manual_seed(3))
    given = torch.zeros(1, layout.pieces.shape[1], 128)
    weight = network.layers[1].contract.weight

    def loss(factor: float) -> torch.Tensor:
        return network._encoded(factor * faces, given, layout, None)[0].square().mean()

    alone = [torch.autograd.grad(loss(factor), weight)[0] for factor in (1.0, 2.0)]
    torch.testing.assert_close(torch.autograd.grad(loss(1.0) + loss(2.0), weight)[0], alone[0] + alone[1])
    assert torch.equal(torch.autograd.grad(loss(1.0), weight)[0], alone[0])


def test_weights_that_are_fixed_get_no_gradient():
    """Fixed weights would be trained, or faces before them get no gradient."""
    network, layout = network_of().requires_grad_(False), layout_of([9])
    faces = torch.randn(1, layout.patch.shape[1], 128, requires_grad=True)
    given = torch.zeros(1, layout.pieces.shape[1], 128)
    network._encoded(faces, given, layout, None)[0].sum().backward()
    assert faces.grad.abs().sum() > 0.0
    assert all(parameter.grad is None for parameter in network.parameters())
