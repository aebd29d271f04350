"""Layers of faces by kernels against the same layers in float64, with numbers of faces that are no whole blocks."""

import pytest
import torch
import torch.nn.functional as F
from support.comparing import close
from support.poison import poison_outputs

from warpgarment.kernels.dense import faces, products
from warpgarment.kernels.dense.trained import layer as trained
from warpgarment.kernels.dense.turned import turned

pytestmark = pytest.mark.skipif(not products.available(), reason="this processor has no vectors")

ROWS, COUNT, WIDTH, HIDDEN = 2, 75, 96, 64  # 75 faces: two blocks of 32 and one of 11
OFF = 1e-4 if products.ON_TILES else 7e-4 if products.INTEGERS else 1e-5
"""On tiles, products of numbers around one lose 2^-17 of each term: 1e-5 in a sum of a hundred; bfloat16 alone 1e-2.

Numbers of rows of integers are off by 6e-5 of their deviation, sums of two layers by four times that at most."""


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed + sum(shape)))


def packed(weight: torch.Tensor) -> torch.Tensor:
    return products.pack(weight).flatten()


def perceptron(inputs: int = WIDTH):
    """A layer, and the function that it is, in float64."""
    expand, contract = normal(HIDDEN, inputs) / inputs**0.5, normal(WIDTH, HIDDEN) / HIDDEN**0.5
    b, c = normal(HIDDEN), normal(WIDTH)
    layer = faces.Perceptron(products.pack_inner(expand), b, products.pack_inner(contract), c)
    return layer, lambda x: F.linear(F.gelu(F.linear(x, expand.double(), b.double())), contract.double(), c.double())


def norm(x: torch.Tensor) -> torch.Tensor:
    return F.layer_norm(x.double(), (WIDTH,))


def test_packed_numbers_are_the_weights():
    """A product would multiply by other weights, or by what lies beyond them.

    Tiles hold the weights themselves or, for AMX, pairs of inputs of sixteen outputs, hi and lo apart, whose sum is the
    weight to 2^-17 of it.
    """
    weight = normal(40, 70)
    found = products.pack(weight)
    assert found.shape == (4, 3, 512)
    if products.ON_TILES:
        both = found.view(torch.bfloat16).double().reshape(4, 3, 2, 16, 16, 2)
        found = both.sum(dim=2).transpose(3, 4).reshape(4, 3, 512)
    whole = found.reshape(4, 3, 32, 16).permute(0, 3, 1, 2).reshape(64, 96)
    close(whole[:40, :70], weight.double(), (2.0**-17 if products.ON_TILES else 0.0) * weight.abs().max().item())
    assert whole[40:].abs().max() == 0.0
    assert whole[:, 70:].abs().max() == 0.0


def test_turned_weights(monkeypatch):
    """Features would be turned by another heading, the inverse one, or frames of the history mixed up."""
    allocated = poison_outputs(monkeypatch)
    frames, channels = 3, 34
    weight, mean, turns = normal(WIDTH, frames, channels), normal(channels), normal(ROWS, channels, channels)
    x, bias = normal(ROWS, COUNT, frames * channels), normal(WIDTH)
    index = torch.randperm(ROWS * COUNT, generator=torch.Generator().manual_seed(1)).reshape(ROWS, COUNT)
    index[1, -3:] = -1
    packed_faces = x.flatten(0, 1).clone()
    packed_faces[index[index >= 0]] = x[index >= 0]
    listed = packed_faces.unflatten(1, (frames, channels)).unbind(1)
    result = faces.embed(listed, index, *turned(weight, mean, F.pad(turns, (0, 14))), bias)
    assert len(allocated) == 3
    seen = x.double().unflatten(2, (frames, channels)) - torch.einsum("i,rij->rj", mean, turns)[:, None, None].double()
    expected = torch.einsum("ehi,rij,rnhj->rne", weight.double(), turns.double(), seen) + bias.double()
    expected[1, -3:] = bias.double()
    close(result, expected, 3e-5 * expected.abs().max().item())


def test_the_layer_before_patches():
    """A part of the layer would be missing: the norm, a bias, the activation, the sum; or the last block be cut."""
    x = 3.0 * normal(ROWS, COUNT, WIDTH) + 1.0
    layer, function = perceptron()
    expected = x.double() + function(norm(x))
    faces.first(x, layer)
    close(x, expected, OFF)


@pytest.mark.parametrize("layouts", [1, ROWS])
def test_what_patches_have_heard(layouts, monkeypatch):
    """Faces would get another patch's or another garment's change, or the norm be that of before."""
    poison_outputs(monkeypatch)
    x, heard, share = normal(ROWS, COUNT, WIDTH), normal(ROWS, 7, WIDTH), normal(layouts, COUNT, 4)
    patch = torch.randint(7, (layouts, COUNT, 4), generator=torch.Generator().manual_seed(1))
    given = [share[r % layouts, :, :, None].double() * heard[r][patch[r % layouts]].double() for r in range(ROWS)]
    expected = x.double() + torch.stack(given).sum(dim=2)
    own = faces.spread(x, patch, share, heard)
    close(x, expected, 1e-5)  # sums in float32
    close(own, norm(expected), 1e-5)


@pytest.mark.parametrize("layouts", [1, ROWS, None])
def test_the_layers_after_patches(layouts, monkeypatch):
    """Faces would hear others than their neighbours, or themselves where they have none, as in a subset."""
    poison_outputs(monkeypatch)
    x, own, following = (
        normal(ROWS, COUNT, WIDTH),
        normal(ROWS, COUNT, WIDTH, seed=5),
        torch.full((2, 75, 96), torch.nan),
    )
    sides, heard = None, own
    if layouts is not None:
        sides = torch.randint(COUNT, (layouts, COUNT, 3), generator=torch.Generator().manual_seed(1))
        around = torch.stack([own[r][sides[r % layouts]].mean(dim=1) for r in range(ROWS)])
        heard = torch.cat([own, around], dim=2)
    layer, function = perceptron(heard.shape[2])
    expected = x.double() + function(heard.double())
    weight, bias = normal(12, WIDTH) / WIDTH**0.5, normal(12)
    last, answer = faces.Head(packed(weight), bias), torch.full((ROWS, COUNT, 12), torch.nan)
    faces.hear(x.clone(), own, sides, layer, answer, last)
    faces.hear(x, own, sides, layer, following)
    close(x, expected, OFF)
    close(following, norm(expected), OFF)
    close(faces.head(own, last), F.linear(own.double(), weight.double(), bias.double()), OFF)
    close(answer, F.linear(norm(expected), weight.double(), bias.double()), OFF)


def test_faces_do_not_depend_on_others_of_the_batch():
    """A garment would move otherwise in a batch or with more threads: a face's block would leak into it. Exact."""
    layer, _ = perceptron()
    x = normal(ROWS, COUNT, WIDTH)
    together, alone = x.clone(), x[1:, 40:].clone()
    faces.first(together, layer)
    faces.first(alone, layer)
    assert torch.equal(together[1:, 40:], alone)


def test_the_activation():
    """GELU would be another function where its polynomials meet, or beyond the last. Measured: 3e-8 and rounding."""
    x = torch.cat([torch.linspace(-8.0, 8.0, 31 * 64), torch.tensor([0.0, -0.0, 1e4, -1e4] * 16)])
    nothing, one = packed(torch.zeros(32, 32)), packed(torch.eye(32))
    around = trained.Around(*[torch.zeros(0, dtype=torch.int64)] * 3)
    for values in x.split(32):
        weights = trained.Weights(nothing, values, one, torch.zeros(32), nothing, one)
        result, _ = trained.layer(torch.zeros(1, 32), weights, around)
        expected = F.gelu(values.double())
        assert ((result[0] - expected).abs() <= 1e-7 + 2.0**-17 * expected.abs()).all(), values


@pytest.mark.skipif(not products.INTEGERS, reason="this processor has no products of integers")
@pytest.mark.parametrize("largest", [1.0, 1e3])
def test_sums_of_integers_are_exact(largest):
    """A sum would leave 32 bits and come out with the other sign: rows and columns that are the same and as long as
    they may be, of equal numbers and with a large one. 6e-4 of the result: four roundings, each of half of 1/5,787."""
    row = torch.ones(64)
    row[5] = largest
    layer = faces.Perceptron(
        products.pack_inner(row.expand(64, 64).contiguous()), torch.zeros(64),
        products.pack_inner(row.expand(32, 64).contiguous()), torch.zeros(32),
    )  # fmt: skip
    own, answer = row[None, None, :32].contiguous(), torch.full((1, 1, 32), torch.nan)
    sides = torch.zeros(1, 1, 3, dtype=torch.int64)
    x = torch.zeros(1, 1, 32)
    faces.hear(x, own, sides, layer, answer)
    heard = torch.cat([row[:32], row[:32]]).double()
    inner = F.gelu((row.double() @ heard).expand(64))
    expected = row.double() @ inner
    assert (x / expected - 1.0).abs().max() <= 6e-4


def test_a_row_of_zeros():
    """A garment whose faces are all alike to the network would become NaN: nothing can be divided by a norm of zero."""
    layer, function = perceptron()
    zeros = torch.zeros(1, 1, WIDTH)
    faces.hear(zeros, torch.zeros(1, 1, WIDTH), None, layer, torch.full((1, 1, WIDTH), torch.nan))
    close(zeros, function(torch.zeros(1, 1, WIDTH, dtype=torch.float64)), OFF)


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_numbers_that_are_not_finite_stay_visible(wrong):
    """A garment that failed would look as if it had not, or make others of its block fail."""
    layer, function = perceptron(2 * WIDTH)
    own = normal(1, 3, WIDTH)
    own[0, 1, 7] = wrong
    sides = torch.tensor([[[0, 0, 2], [0, 2, 2], [2, 2, 2]]])
    x = torch.zeros(1, 3, WIDTH)
    faces.hear(x, own, sides, layer, torch.full((1, 3, WIDTH), torch.nan))
    assert not x[0, 1].isfinite().any()
    heard = torch.cat([own[0], own[0][sides[0]].mean(dim=1)], dim=1)[[0, 2]]
    close(x[0, [0, 2]], function(heard.double()), OFF)
    broken = layer._replace(contract=products.pack_inner(torch.full((WIDTH, HIDDEN), torch.nan)))
    faces.hear(x, torch.ones(1, 3, WIDTH), sides, broken, torch.full((1, 3, WIDTH), torch.nan))
    assert x.isnan().all()
