"""The encoder of patches by kernels against the same in float64, with numbers of tokens that are no whole blocks."""

import pytest
import torch
import torch.nn.functional as F
from support.comparing import close
from support.poison import poison_outputs

from warpgarment.kernels.dense import products, tokens

pytestmark = pytest.mark.skipif(not products.available(), reason="this processor has no vectors")

ROWS, COUNT, WIDTH, EMBEDDING, HIDDEN, HEAD, LAYERS = 2, 90, 32, 96, 64, 32, 2
PATCHES, PIECES = 41, 3  # 44 tokens: a block of 32, and one of 12 that has patches and velocities
OFF = 3e-5 if products.ON_TILES else 3e-4 if products.INTEGERS else 5e-6
"""Of the largest output: products on tiles lose 2^-17 of each term, 8e-6, in each of a dozen. bfloat16 alone: 1e-2.

Integers of rows of 96 are 6e-5 of their deviation off."""


def normal(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed + sum(shape)))


def packed(weight: torch.Tensor) -> torch.Tensor:
    return products.pack(weight).flatten()


def weight(outputs: int, inputs: int, seed: int = 0) -> torch.Tensor:
    return normal(outputs, inputs, seed=seed) / inputs**0.5


def norm(x: torch.Tensor) -> torch.Tensor:
    return F.layer_norm(x, x.shape[-1:])


@pytest.mark.parametrize("layouts", [1, ROWS])
@pytest.mark.parametrize("learned", [0, 64, EMBEDDING])
@pytest.mark.parametrize("padded", [False, True])
def test_the_encoder(layouts, learned, padded, monkeypatch):
    """Patches would be pooled wrongly, heads mixed up, padding be heard, or a velocity not hear its own piece."""
    columns = 2 * learned + EMBEDDING
    to_patches, to_velocity = weight(EMBEDDING, WIDTH), weight(EMBEDDING, WIDTH, seed=1)
    heard, velocity = weight(WIDTH, EMBEDDING), weight(3, EMBEDDING)
    biases = {n: normal(n, seed=9) for n in (columns, EMBEDDING, HIDDEN, WIDTH, 3)}
    layers = [
        [weight(columns, EMBEDDING, k), weight(EMBEDDING, EMBEDDING, k), weight(HIDDEN, EMBEDDING, k),
         weight(EMBEDDING, HIDDEN, k)] for k in range(LAYERS)
    ]  # fmt: skip
    each = [biases[n] for n in (columns, EMBEDDING, HIDDEN, EMBEDDING)] * LAYERS
    encoder = tokens.Encoder(
        EMBEDDING, learned, HEAD, HIDDEN, LAYERS, packed(to_patches), biases[EMBEDDING],
        torch.cat([*(products.pack_inner(w) for layer in layers for w in layer), packed(heard)]),
        torch.cat([b.flatten() for b in [*each, biases[WIDTH], biases[3], velocity, to_velocity]]),
    )  # fmt: skip
    x, given = normal(ROWS, COUNT, WIDTH), normal(ROWS, PIECES, EMBEDDING)
    member = torch.randint(COUNT, (layouts, 300), generator=torch.Generator().manual_seed(1))
    start = torch.linspace(0, 290, PATCHES).long().repeat(layouts, 1)
    shares = normal(layouts, 300).abs() / 7.0
    pools = tokens.Pools(
        start, member, shares, normal(layouts, PIECES, PATCHES).softmax(2), normal(layouts, PATCHES, PATCHES).softmax(2)
    )
    real = torch.ones(ROWS, PATCHES + PIECES, dtype=torch.bool)
    if padded:
        real[1, 30:PATCHES] = real[0, -1] = False
    poison_outputs(monkeypatch)
    result = tokens.encode(encoder, x, given, pools, real if padded else None)

    for r in range(ROWS):
        layout = r % layouts
        patch = torch.bucketize(torch.arange(300), start[layout], right=True) - 1
        y = torch.zeros(PATCHES, WIDTH, dtype=torch.float64)
        y.index_add_(0, patch, shares[layout, :, None].double() * x[r][member[layout]].double())
        own = given[r].double() + (pools.pieces[layout].double() @ y) @ to_velocity.double().T
        now = torch.cat([F.linear(y, to_patches.double(), biases[EMBEDDING].double()), own])
        start_of = now
        for layer in layers:
            w = [values.double() for values in layer]
            b = [biases[len(values)].double() for values in layer]
            query, key, value = F.linear(norm(now), w[0], b[0]).split([learned, learned, EMBEDDING], dim=1)
            found = []
            for h in range(learned // HEAD):
                part = slice(HEAD * h, HEAD * (h + 1))
                score = (query[:, part] @ key[:, part].T).masked_fill(~real[r], -torch.inf)
                found.append(score.softmax(1) @ value[:, part])
            spread = torch.block_diag(pools.geodesic[layout].double(), torch.eye(PIECES))
            found.append(spread @ value[:, learned:])
            now = now + F.linear(torch.cat(found, dim=1), w[1], b[1])
            now = now + F.linear(F.gelu(F.linear(norm(now), w[2], b[2])), w[3], b[3])
        change = (now - start_of)[:PATCHES]
        expected = (
            F.linear(change, heard.double(), biases[WIDTH].double()),
            F.linear(norm(now[PATCHES:]), velocity.double(), biases[3].double()),
        )
        for one, other in zip(result, expected, strict=True):
            close(one[r], other, OFF * other.abs().max().item())


def test_a_row_does_not_depend_on_padding_or_others():
    """A garment would move otherwise with others beside it, or with a pool of threads. Exact, with any threads."""
    encoder = tokens.Encoder(
        EMBEDDING, 64, HEAD, HIDDEN, 1, packed(weight(EMBEDDING, WIDTH)), normal(EMBEDDING),
        torch.cat([*(products.pack_inner(weight(o, i)) for o, i in ((224, 96), (96, 96), (64, 96), (96, 64))),
                   packed(weight(32, 96))]),
        torch.cat([normal(224), normal(96), normal(64), normal(96), normal(32), normal(3), normal(3 * 96),
                   normal(96 * 32)]),
    )  # fmt: skip
    x, given = normal(ROWS, COUNT, WIDTH), normal(ROWS, 1, EMBEDDING)
    member, shares = torch.arange(COUNT).repeat(ROWS, 4), normal(ROWS, 4 * COUNT)
    start = torch.arange(0, 4 * COUNT, 12).repeat(ROWS, 1)
    real = torch.ones(ROWS, 31, dtype=torch.bool)
    pools = tokens.Pools(start, member, shares, torch.ones(ROWS, 1, 30), torch.eye(30).repeat(ROWS, 1, 1))
    before, kept = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            kept.append(tokens.encode(encoder, x, given, pools, real))
    finally:
        torch.set_num_threads(before)
    alone = tokens.encode(encoder, x[1:], given[1:], tokens.Pools(*(p[1:] for p in pools)), None)
    for many, few, one in zip(kept[0], kept[1], alone, strict=True):
        assert torch.equal(many, few)
        assert torch.equal(many[1:], one)
