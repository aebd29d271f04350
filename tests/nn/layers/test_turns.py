"""Rotations of directions and hidden vectors against SciPy, and what the value path of a block must not depend on."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.outfits import inputs_of, layersnet, layout_of, moving

import warpgarment.nn.layers.network as module
from warpgarment.nn.layers.block import Block, Edges, Links, Tokens
from warpgarment.nn.layers.config import BODY, LayersNetConfig
from warpgarment.nn.layers.turns import Bases, frames, quaternions, turned

SHAPE = {"embedding": 64, "heads": 4, "world_heads": 2, "feed_forward": 32}


def directions(count: int = 50) -> torch.Tensor:
    """Vectors of any length, among them both ends of each axis."""
    made = np.random.default_rng(0).normal(size=(count, 3))
    return torch.from_numpy(np.concatenate([made, np.eye(3), -np.eye(3)]))


def rotations(count: int, seed: int = 0) -> torch.Tensor:
    """Random rotations [count,3,3] in float64."""
    return torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())


@pytest.mark.parametrize("height", [1.0, -1.0])
def test_frames_turn_directions(height):
    """A normal would not be turned to up, or the frame be no rotation. 1e-12."""
    d = directions()
    found = frames(d, height)
    unit = d / d.norm(dim=1, keepdim=True)
    assert ((found @ unit[..., None])[..., 0] - torch.tensor([0.0, height, 0.0])).abs().max() < 1e-12
    assert (found @ found.mT - torch.eye(3)).abs().max() < 1e-12
    assert (torch.linalg.det(found) - 1).abs().max() < 1e-12
    # by the shortest way: the angle is that between the two
    angle = Rotation.from_matrix(found.numpy()).magnitude()
    np.testing.assert_allclose(angle, np.arccos((height * unit[:, 1]).clip(-1, 1).numpy()), atol=1e-7)


def test_still_air():
    """Air at rest has no direction, and would give NaN. Exact."""
    nothing = torch.zeros(2, 3)
    assert torch.equal(frames(nothing), torch.eye(3).expand(2, 3, 3))
    assert torch.equal(quaternions(nothing), torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(2, 4))
    assert frames(torch.tensor([[0.0, -1.0, 1e-9]])).isfinite().all()


def test_quaternions_are_the_frames():
    """The wind's token would name another direction than its frame. 1e-7: SciPy's angle near half a turn."""
    d = directions()
    found = Rotation.from_quat(quaternions(d).numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(found, frames(d).numpy(), atol=1e-7)


def hidden(bases: Bases, rotation: torch.Tensor) -> torch.Tensor:
    """R_h of all heads as one matrix [K,K], by `matrix` and `turned`."""
    basis = bases.matrix(bases())
    eye = torch.eye(len(basis), dtype=basis.dtype)
    around = rotation.expand(len(basis), 3, 3)
    return (turned(eye @ basis, around, len(bases.weight) * bases.triples) @ basis.mT).mT


@pytest.mark.parametrize("width", [4, 8, 16])
def test_hidden_rotations(width):
    """R_h would be no rotation, or not keep products, so that hidden vectors would not turn with space. 1e-12."""
    torch.manual_seed(0)
    bases = Bases(3, width, "orthogonal").double()
    a, b = rotations(2)
    one, other = hidden(bases, a), hidden(bases, b)
    assert (one @ one.mT - torch.eye(len(one))).abs().max() < 1e-12
    assert (hidden(bases, a @ b) - one @ other).abs().max() < 1e-12
    assert (hidden(bases, torch.eye(3).double()) - torch.eye(len(one))).abs().max() < 1e-12
    assert (
        one - torch.block_diag(*(one[k : k + width, k : k + width] for k in range(0, len(one), width)))
    ).abs().max() == 0
    assert (one - torch.eye(len(one))).abs().max() > 0.1
    assert bases.penalty() < 1e-24


def test_the_published_form_is_no_rotation():
    """The text would be wrong in saying that no W of rank 3 makes W W^T the identity: at best 13 of 16 are missing."""
    bases = Bases(2, 16, "published").double()
    optimiser = torch.optim.Adam(bases.parameters(), lr=0.05)
    for _ in range(400):
        optimiser.zero_grad()
        bases.penalty().backward()
        optimiser.step()
    assert bases.penalty().item() == pytest.approx(13 / 256, rel=1e-3)


def block_of(rotation: str) -> Block:
    """A block in float64 whose gain is one, so that it turns with the hidden vectors."""
    torch.manual_seed(1)
    return Block(LayersNetConfig(**SHAPE, rotation=rotation)).double()


def edges_of(patches: int, bodies: int, rotation: torch.Tensor) -> Edges:
    """Every patch sees some patches, all body vertices, wind and gravity; rotations [bodies + 2,3,3]."""
    tokens = patches + bodies + 2
    columns = torch.arange(tokens)
    row = torch.arange(patches)
    counts = (patches * patches, patches * bodies, patches, patches)
    parts = [columns[:patches], columns[patches : patches + bodies], columns[-2:-1], columns[-1:]]
    patch = torch.cat([row.repeat_interleave(len(part)) for part in parts])
    token = torch.cat([part.repeat(patches) for part in parts])
    world = Links(patch, token, patch * tokens + token, None, tokens)
    near = row.repeat_interleave(patches)
    mesh = Links(near, row.repeat(patches), torch.arange(patches**2), None, patches)
    return Edges(world, counts, rotation[token[counts[0] :] - patches], mesh)


@pytest.mark.parametrize(("rotation", "holds"), [("orthogonal", True), ("published", False)])
def test_the_value_path_turns(rotation, holds):
    """Values would not turn with space: turning f and every R by one rotation must turn the result. 1e-12, and the
    published form must fail by more than 0.01."""
    block, counts = block_of(rotation), (5 * BODY, 5, 5)
    f, around, turn = torch.randn(sum(counts), 32).double(), rotations(sum(counts)), rotations(1, 5)[0]
    both = hidden(block.bases, turn)
    plain = block.turned_values(f, around, counts)
    found = block.turned_values(f @ both.mT, around @ turn.mT, counts)
    assert plain.abs().mean() > 0.03
    error = (found - plain @ both.mT).abs().max()
    assert error < 1e-12 if holds else error > 0.01
    assert (block.turned_values(f, around @ turn.mT, counts) - plain).abs().max() > 0.01  # R has its say


@pytest.mark.parametrize(("rotation", "holds"), [("orthogonal", True), ("published", False)])
def test_a_block_in_a_turned_hidden_space(rotation, holds):
    """A block's output would depend on how space lies: with every R and the layers to and from the hidden space turned
    by one rotation it must not change. 1e-12, and the published form must fail by more than 1e-3."""
    patches, bodies = 6, 9
    block, other = block_of(rotation), block_of(rotation)
    around, turn = rotations(bodies + 2), rotations(1, 5)[0]
    wide = torch.eye(64).double()
    wide[:32, :32] = hidden(block.bases, turn)  # of the world heads
    with torch.no_grad():
        for name in ("query", "receive", "send"):
            getattr(other, name).weight.copy_(wide @ getattr(block, name).weight)
        other.remember.weight.copy_(wide @ block.remember.weight @ wide.mT)
        other.out.weight.copy_(block.out.weight @ wide.mT)
    tokens = torch.randn(3, patches + bodies + 2, 64).double()
    receiver, sender = tokens[1, :patches], tokens[2]
    plain = block(Tokens(tokens[0], receiver, sender), edges_of(patches, bodies, around))
    found = other(Tokens(tokens[0], receiver @ wide.mT, sender @ wide.mT), edges_of(patches, bodies, around @ turn.mT))
    error = (found.value - plain.value).abs().max()
    assert error < 1e-12 if holds else error > 1e-3


def test_links_with_and_without_padding():
    """A GPU, which takes all entries of a table, would see what is not there. 1e-12 of the CPU's form."""
    network = layersnet().double()
    garments, inputs = inputs_of([moving()])
    layout = layout_of(network, garments)
    with torch.no_grad():
        plain = network.predict(inputs, layout).positions
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "WAITS", ())
            padded = network.predict(inputs, layout).positions
    assert (padded - plain).abs().max() < 1e-12
