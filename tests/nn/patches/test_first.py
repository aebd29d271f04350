"""The first layer and the sums of the network of patches in training, with their gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support import meshes

from warpgarment.kernels.features.channels import FEATURES
from warpgarment.nn.config import NetworkConfig
from warpgarment.nn.heading import rotation_about_up
from warpgarment.nn.inputs import RowInputs
from warpgarment.nn.patches.bags import sums_of
from warpgarment.nn.patches.layout import PatchLayout, garment_patches, patch_layout
from warpgarment.nn.patches.network import PatchTransformer
from warpgarment.nn.run import run
from warpgarment.objects.garment import Garment

HISTORY, LIVE = 4, 2
OFF = 1e-300
"""Noise that changes no number, but with which the first layer is applied to normalised features."""


def layout_of(*sizes: tuple[int, int]) -> PatchLayout:
    garments = [Garment(mesh.vertices, mesh.faces) for mesh in (meshes.skirt(*size, waist=0.17) for size in sizes)]
    return patch_layout([garment_patches(garment, 0.08) for garment in garments], 0.15, 2.0)


def network_of(outdoor: tuple[str, ...] = ()) -> PatchTransformer:
    torch.manual_seed(0)
    config = NetworkConfig.fast(
        history=HISTORY, embedding=32, face_embedding=32, heads=2, manifold_heads=1, outdoor=outdoor
    )
    network = PatchTransformer(config)
    for name, parameter in network.named_parameters():
        if "head" in name or "hear" in name:
            torch.nn.init.normal_(parameter, std=0.1)
    network.set_statistics(
        {"feature_mean": torch.randn(FEATURES), "feature_std": 0.5 + torch.rand(FEATURES), "psi_std": [0.1] * 9}
    )
    return network


def answers(network: PatchTransformer, layout: PatchLayout, dtype: torch.dtype, *, noise: float, live: bool) -> list:
    """Outputs for rows that are turned and mirrored, then the gradients of all weights and of the newest frames."""
    network = network.to(dtype)
    generator = torch.Generator().manual_seed(1)
    rows, count = layout.patch.shape[:2]
    frames = [torch.randn(rows, count, FEATURES, generator=generator, dtype=torch.float64) for _ in range(HISTORY)]
    frames = [frame.to(dtype).requires_grad_(k >= HISTORY - LIVE) for k, frame in enumerate(frames)]
    velocities = 0.1 * torch.randn(rows, 1, 3 * (HISTORY - 1), generator=generator, dtype=torch.float64).to(dtype)
    outdoor = torch.rand(rows, count, network.outdoor.width, generator=generator, dtype=torch.float64).to(dtype)
    turn, rest = rotation_about_up(torch.tensor([[0.4, -1.0], [0.2, 0.7]], dtype=dtype))
    weights = layout._replace(
        **{name: getattr(layout, name).to(dtype) for name in ("share", "member_weight", "pieces", "weights")}
    )
    stacked = torch.cat(frames, dim=-1)
    inputs = RowInputs(
        stacked.detach() if live else stacked,
        velocities,
        weights,
        turn=turn,
        rest_turn=rest,
        mirrored=torch.tensor([True, False]),
        outdoor=outdoor if network.outdoor.width else None,
        live=tuple(frames[HISTORY - LIVE :]) if live else (),
    )
    output = run(network, inputs, noise=noise).output
    loss = sum((part.flatten() * torch.linspace(0.5, 1.5, part.numel(), dtype=dtype)).sum() for part in output)
    of = [*network.parameters(), *frames[HISTORY - LIVE :]]
    return [*(part.detach() for part in output), *torch.autograd.grad(loss, of)]


@pytest.mark.parametrize("outdoor", [(), ("density", "wind")])
@pytest.mark.parametrize("live", [False, True])
def test_turns_mirrors_and_statistics_in_the_weights_are_those_of_the_features(live, outdoor):
    """A row is mirrored before it is turned, a frame gets the gradient of another, or a weight none: against the same
    layer on features that were turned, mirrored and normalised before. float64; 1e-11 of the largest number of each."""
    layout, network = layout_of((14, 7), (14, 7)), network_of(outdoor)
    found = answers(network, layout, torch.float64, noise=0.0, live=live)
    expected = answers(network, layout, torch.float64, noise=OFF, live=live)
    for one, other in zip(found, expected, strict=True):
        assert (one - other).abs().max() <= 1e-11 * max(1.0, float(other.abs().max()))


def test_float32_gradients_are_as_exact_as_before():
    """The means of features that are now subtracted after the product round more than they may: the error of all
    gradients together, beside float64, is at most 1.5 times that of the layer on normalised features (here 1.0)."""
    layout, network = layout_of((14, 7), (14, 7)), network_of()
    exact = answers(network, layout, torch.float64, noise=0.0, live=True)
    errors = []
    for noise in (0.0, 1e-30):
        found = answers(network, layout, torch.float32, noise=noise, live=True)
        errors.append(sum(float((a - b).norm() / b.norm().clamp(min=1e-12)) for a, b in zip(found, exact, strict=True)))
    assert errors[0] < 1.5 * errors[1], errors


@pytest.mark.parametrize("sizes", [[(14, 7)], [(14, 7), (12, 6)]])
def test_sums_and_their_gradients_are_products_with_a_matrix(sizes):
    """A face counts in the patch of another garment, or the gradient goes to other faces than the sum came from: each
    sum against the matrix made of the layout entry by entry. 1e-5: float32."""
    layout = layout_of(*sizes)
    count, patches, rows = layout.patch.shape[1], layout.start.shape[1], 2
    matrices = np.zeros((rows, patches, count)), np.zeros((rows, count, patches)), np.zeros((rows, count, count))
    for row in range(rows):
        r = row % len(layout.patch)
        starts = [*layout.start[r].tolist(), layout.member.shape[1]]
        for p in range(patches):
            for m in range(starts[p], starts[p + 1]):
                matrices[0][row, p, layout.member[r, m]] += layout.member_weight[r, m]
        for f in range(count):
            for k in range(layout.patch.shape[2]):
                matrices[1][row, f, layout.patch[r, f, k]] += layout.share[r, f, k]
            for k in range(3):
                matrices[2][row, f, layout.neighbours[r, f, k]] += 1.0 / 3.0
    for sums, matrix in zip(sums_of(layout, rows), matrices, strict=True):
        dense = torch.from_numpy(matrix)
        values = torch.randn(rows, matrix.shape[2], 5, dtype=torch.float64)
        weight = torch.randn(rows, matrix.shape[1], 5, dtype=torch.float64)
        flat = values.float().flatten(0, 1).requires_grad_()
        result = sums(flat)
        torch.testing.assert_close(result.double(), (dense @ values).flatten(0, 1), rtol=0, atol=1e-5)
        (gradient,) = torch.autograd.grad(result, flat, weight.float().flatten(0, 1))
        torch.testing.assert_close(gradient.double(), (dense.mT @ weight).flatten(0, 1), rtol=0, atol=1e-5)
