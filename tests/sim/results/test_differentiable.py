"""Gradients of rollouts beside finite differences, and positions beside those of an ordinary rollout."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
import torch

import warpgarment as wg
from warpgarment.errors import UsageError

FRAMES = 5
DRESSED = wg.demo.assets().garments["tshirt"]
GIVEN = {"first_vertices": DRESSED.first_vertices, "frames": FRAMES}


@pytest.fixture(scope="module")
def simulator():
    """`layers` without contact, whose decisions turn from one finite difference to the next."""
    found = wg.Simulator.from_pretrained("layers", device="cpu", collision_passes=0)
    found.network.requires_grad_(False)
    return found


def projected(simulator: wg.Simulator, **inputs: torch.Tensor) -> torch.Tensor:
    """Heights and a random projection of the last frame, summed: a number that every vertex has a part in."""
    moved = wg.differentiable.rollout(simulator, DRESSED.garment, wg.demo.assets().collider, **GIVEN, **inputs)
    weights = torch.randn(moved[-1].shape, generator=torch.Generator().manual_seed(0))
    return (moved[-1] * weights).sum() + moved[-1, :, 1].sum()


def test_wind_has_the_slope_of_finite_differences(simulator):
    """Gradient descent on the wind would go astray. Along y and z, which move the shirt most; within 10 %. With the
    nearest body point of a face held where it is, the slope is a third of this."""
    wind = torch.tensor([0.0, 0.0, -4.0], requires_grad=True)
    (slope,) = torch.autograd.grad(projected(simulator, wind=wind), wind)
    with torch.no_grad():
        for axis in (1, 2):
            aside = torch.zeros(3).index_fill(0, torch.tensor(axis), 0.3)
            ahead, behind = (projected(simulator, wind=wind + sign * aside).item() for sign in (1, -1))
            assert slope[axis].item() == pytest.approx((ahead - behind) / 0.6, rel=0.1)


def test_material_and_first_frame_have_slopes(simulator):
    """The fields of a material, or the positions in the first frame, would have no gradient: density beside its finite
    difference, within 10 %; a shift of the first frame moves nothing but itself, at unit slope, within 20 %."""
    cloth = torch.tensor(astuple(wg.Material.cotton()), requires_grad=True)
    (slope,) = torch.autograd.grad(projected(simulator, material=cloth, wind=torch.tensor([0.0, 0.0, -4.0])), cloth)
    with torch.no_grad():
        aside = torch.zeros_like(cloth).index_fill(0, torch.tensor(0), 0.2 * cloth[0].item())
        inputs = {"wind": torch.tensor([0.0, 0.0, -4.0])}
        ahead, behind = (projected(simulator, material=cloth + s * aside, **inputs).item() for s in (1, -1))
    assert slope[0].item() == pytest.approx((ahead - behind) / (0.4 * cloth[0].item()), rel=0.1)
    start = torch.tensor(DRESSED.first_vertices, requires_grad=True)
    moved = wg.differentiable.rollout(
        simulator, DRESSED.garment, wg.demo.assets().collider, first_vertices=start, frames=2
    )
    (shift,) = torch.autograd.grad(moved[-1, :, 1].mean(), start)
    assert shift[:, 1].sum().item() == pytest.approx(1.0, abs=0.2)


def test_positions_are_those_of_a_rollout():
    """Gradients would be those of another simulation. With contact; to 0.1 mm, as the operators add in other orders."""
    simulator = wg.Simulator.from_pretrained("layers", device="cpu")
    body, wind = wg.demo.assets().collider, torch.tensor([[0.0, 0.0, -4.0], [1.0, 0.0, -6.0]])
    moved = wg.differentiable.rollout(simulator, DRESSED.garment, body, wind=wind, **GIVEN)
    assert moved.requires_grad  # of the network's weights
    usual = simulator.rollout(DRESSED.garment, body, wind=wind, **GIVEN)
    assert np.abs(moved.detach().numpy() - usual.vertices).max() < 1e-4


def test_what_cannot_be_differentiated_is_refused(simulator):
    """A mistake would end in a message about tensors."""
    body, garment = wg.demo.assets().collider, DRESSED.garment
    with pytest.raises(ValueError, match=r"wind must have shape \[3\] or \[T,3\], got \[2\]"):
        wg.differentiable.rollout(simulator, garment, body, wind=torch.zeros(2), **GIVEN)
    plain = wg.Simulator.from_pretrained("fast", device="cpu")
    with pytest.raises(ValueError, match="reads none"):
        wg.differentiable.rollout(plain, garment, body, wind=torch.zeros(3), **GIVEN)
    with pytest.raises(UsageError, match="at least 1"):
        wg.differentiable.rollout(simulator, garment, body, frames=0)
