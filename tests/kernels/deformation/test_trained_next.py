"""Deformation gradients of the next frame in training, beside their formula in float64."""

from __future__ import annotations

import pytest
import torch
from support.poison import poison_outputs

from warpgarment.kernels.deformation.trained_next import trained_next_gradients

FACES, SMALLEST = 45, 0.01  # five whole groups of eight faces and a part


@pytest.fixture
def given() -> list[torch.Tensor]:
    """Features, psi, singular values and velocities of three garments, well away from equal singular values."""
    random = torch.Generator().manual_seed(3)
    features = torch.randn(FACES, 34, generator=random)
    near = torch.eye(3) + 0.2 * torch.randn(2, FACES, 3, 3, generator=random)
    features[:, :9] = (near[0] * torch.tensor([1.6, 1.0, 0.5])).flatten(1)
    values = torch.rand(FACES, 3, generator=random).sort(descending=True)[0] + torch.tensor([1.0, 0.5, 0.0])
    values[4, 2] = -0.2  # below the least
    return [features, near[1], values, torch.randn(3, 3, generator=random)]


def owners() -> tuple[torch.Tensor, torch.Tensor, int]:
    belongs = torch.arange(FACES, dtype=torch.int32) // 15
    return belongs, belongs, 3


def twin(given: list[torch.Tensor], kept: torch.Tensor, *, replace: bool) -> torch.Tensor:
    """The formula of the module by torch's own decomposition; torch differentiates it."""
    features, psi, values = given[:3]
    psi = torch.where(kept[:, None, None], psi, torch.eye(3, dtype=psi.dtype))
    product = psi @ features[:, :9].reshape(-1, 3, 3)
    if not replace:
        return product
    values = torch.where(kept[:, None], values, 1.0).clamp(min=SMALLEST)
    u, _, vt = torch.linalg.svd(product)
    last = torch.tensor([1.0, 1.0, -1.0], dtype=psi.dtype)
    sign = torch.where((u.det() * vt.det() < 0.0)[:, None], last, torch.ones_like(last)).detach()
    return (u * (sign * values.abs() * sign * sign)[:, None]) @ (vt * sign[:, :, None])


@pytest.mark.parametrize("replace", [True, False])
@pytest.mark.parametrize("broken", [False, True])
def test_gradients_are_those_of_the_formula(given, replace, broken, monkeypatch):
    """A face gets the gradient of another, the transposed one, or one of a garment whose prediction is not finite.

    1e-5 of the largest entry: results are float32, and quotients of singular values that are near each other amplify.
    """
    made = poison_outputs(monkeypatch)
    if broken:
        given[1][20, 0, 0] = torch.nan
    kept = torch.ones(FACES, dtype=torch.bool)
    kept[15:30] = not broken
    mine = [part.clone().requires_grad_() for part in given[:3]]
    target, finite = trained_next_gradients(*mine, given[3], *owners(), replace=replace, smallest=SMALLEST)
    slope = torch.randn(FACES, 3, 3, generator=torch.Generator().manual_seed(5))
    found = torch.autograd.grad(target, mine, slope)
    assert len(made) == 4
    assert not target.isnan().any()
    assert finite.tolist() == [True, not broken, True]
    exact = [part.double().requires_grad_() for part in given[:3]]
    expected = twin(exact, kept, replace=replace)
    torch.testing.assert_close(target.double(), expected, rtol=0.0, atol=1e-5)
    wanted = torch.autograd.grad(expected, exact, slope.double(), allow_unused=True)
    for one, other, like in zip(found, wanted, exact, strict=True):
        other = torch.zeros_like(like) if other is None else other.nan_to_num()
        assert not one.isnan().any()
        torch.testing.assert_close(one.double(), other, rtol=0.0, atol=1e-5 * max(1.0, float(other.abs().max())))


def test_threads_change_no_bit(given):
    """The gradient of a face depends on which faces are computed with it."""
    features, psi, values, velocity = (torch.cat([part] * 60) for part in given)
    belongs = torch.zeros(len(psi), dtype=torch.int32)
    threads, found = torch.get_num_threads(), []
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            mine = [part.clone().requires_grad_() for part in (features, psi, values)]
            target, _ = trained_next_gradients(*mine, velocity, belongs, belongs, 1, replace=True, smallest=SMALLEST)
            found.append([target, *torch.autograd.grad(target.sum(), mine)])
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
