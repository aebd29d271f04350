"""Steps of faces with their losses in training, beside their formula in float64."""

from __future__ import annotations

import pytest
import torch
from support.poison import poison_outputs

from warpgarment.kernels.deformation.trained_steps import Rows, Wanted, trained_steps

FACES = 23


def rotations(count: int, random: torch.Generator) -> torch.Tensor:
    found = torch.linalg.qr(torch.randn(count, 3, 3, generator=random))[0]
    return found * found.det().sign()[:, None, None]


def made(*, repeats: int = 1) -> tuple[torch.Tensor, list[Rows], Wanted]:
    """Two views: two padded rows, one of them mirrored, whose numbers are parts of longer rows; and a mirrored row."""
    random = torch.Generator().manual_seed(1)
    order = torch.randperm(FACES * repeats, generator=random)
    some = 8 * repeats
    padded = torch.full((2, some + 1), -1)
    padded[0, :some], padded[1, : some - 2] = order[:some], order[some : 2 * some - 2]
    rows = []
    for index, mirrored in ((padded, [False, True]), (order[2 * some - 2 :][None], [True])):
        said = torch.randn(*index.shape, 12, generator=random)
        turn = rotations(len(index), random)
        rows.append(Rows(index, torch.tensor(mirrored), turn, *said.split([9, 3], dim=-1)))
    faces = FACES * repeats
    phi, phi_next = torch.eye(3) + 0.3 * torch.randn(2, faces, 3, 3, generator=random)
    scale = torch.cat([torch.rand(12, generator=random) + 0.5, torch.randn(12, generator=random)])
    unit, weight = torch.rand(12, generator=random) + 0.5, torch.rand(faces, generator=random)
    values = torch.rand(faces, 3, generator=random)
    return phi, rows, Wanted(scale, unit, weight, rotations(faces, random), phi_next, values)


def twin(phi: torch.Tensor, rows: list[Rows], wanted: Wanted) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The formulas of the module, operator by operator."""
    psi, values, terms = torch.zeros_like(phi), torch.zeros_like(wanted.values), torch.zeros(2, dtype=phi.dtype)
    (std, mean), mirror = wanted.scale.split(12), torch.tensor([-1.0, 1.0, 1.0], dtype=phi.dtype)
    for each in rows:
        for r, index in enumerate(each.face):
            real = index >= 0
            face, a, b, g = index[real], each.psi[r, real], each.values[r, real], each.turn[r]
            signs = torch.outer(mirror, mirror) if each.mirrored[r] else torch.ones(3, 3, dtype=phi.dtype)
            m = signs * (a * std[:9] + mean[:9]).view(-1, 3, 3)
            psi = psi.index_put((face,), g.T @ m @ g @ wanted.near[face])
            values = values.index_put((face,), b * std[9:] + mean[9:])
            t = wanted.phi[face] @ torch.linalg.inv(phi[face]) @ wanted.near[face].mT
            c = ((signs * (g @ t @ g.T)).flatten(1) - mean[:9]) / std[:9]
            d = (wanted.values[face] - mean[9:]) / std[9:]
            weight, (u, v) = wanted.weight[face], wanted.unit.split([9, 3])
            both = (weight * ((a - c).abs() * u).sum(1)).sum(), (weight * ((b - d).abs() * v).sum(1)).sum()
            terms = terms + torch.stack(both)
    return psi, values, terms


def answers(phi: torch.Tensor, rows: list[Rows], wanted: Wanted, function) -> list[torch.Tensor]:
    """Results, and gradients of phi, and of turn, psi and values of all rows, in the dtype of phi."""
    dtype = phi.dtype
    leaves = [phi] + [part.to(dtype) for each in rows for part in each[2:]]
    leaves = [leaf.detach().requires_grad_() for leaf in leaves]
    rows = [Rows(*each[:2], *leaves[3 * n + 1 : 3 * n + 4]) for n, each in enumerate(rows)]
    results = function(leaves[0], rows, Wanted(*(part.to(dtype) for part in wanted)))
    random = torch.Generator().manual_seed(2)
    slopes = [torch.randn(part.shape, generator=random).to(dtype) for part in results]
    found = torch.autograd.grad(results, leaves, slopes)
    return [*(part.detach() for part in results), *found]


def test_results_and_gradients_are_those_of_the_formulas(monkeypatch):
    """A map is turned the wrong way, a mirror changes the wrong sign, padding is read, or one of the five ways on which
    a gradient flows is missing. 2e-5 of the largest entry: float32, with inverses of matrices."""
    allocated = poison_outputs(monkeypatch)
    found = answers(*made(), trained_steps)
    assert len(allocated) == 10
    phi, rows, wanted = made()
    expected = answers(phi.double(), rows, wanted, twin)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.double(), other, rtol=0.0, atol=2e-5 * float(other.abs().max()))


def test_the_twin_has_these_gradients():
    """The twin's own gradients would be wrong."""
    phi, rows, wanted = made()
    wanted = Wanted(*(part.double() for part in wanted))
    turn, psi, values = (part.double().requires_grad_() for part in rows[0][2:])

    def function(*parts: torch.Tensor):
        return twin(parts[0], [Rows(*rows[0][:2], *parts[1:])], wanted)

    assert torch.autograd.gradcheck(function, (phi.double().requires_grad_(), turn, psi, values))


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_no_bit(threads):
    """A face depends on those that are computed with it."""
    before, found = torch.get_num_threads(), []
    try:
        for number in (1, threads):
            torch.set_num_threads(number)
            found.append(answers(*made(repeats=90), trained_steps))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
