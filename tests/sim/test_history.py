"""Stacks of following frames, which overlap in memory or share their frames, beside copies of them."""

import pytest
import torch

from warpgarment.nn.inputs import Frames
from warpgarment.sim import history as kept
from warpgarment.sim.history import STACKS, History, Stacks

FACES, FRAMES = 7, 6
ROOM = STACKS * FRAMES


def followed(history: History, stacked: torch.Tensor) -> History:
    return history.followed(stacked, torch.zeros(1, 3))


def whole(features: torch.Tensor | Frames) -> torch.Tensor:
    return features.whole() if isinstance(features, Frames) else features


@pytest.mark.parametrize("large", [False, True])
def test_states_keep_their_histories(large, monkeypatch):
    """A frame would overwrite the history of an older state, or read one of another state; also where a batch is so
    large that its frames are tensors of their own."""
    monkeypatch.setattr(kept, "MOST_BYTES", 0 if large else 2**26)
    torch.manual_seed(0)
    start = History(torch.rand(FACES, FRAMES - 1, 34), torch.zeros(1, FRAMES - 1, 3))
    stacks, states, copies = Stacks(separate=large), [start], [start.features.clone()]
    for number in range(3 * ROOM):
        at = number if number % 5 else max(number - 3, 0)  # every fifth frame follows an older state again
        newest = torch.rand(FACES, 34)
        stacked = stacks(states[at], newest)
        expected = torch.cat([copies[at], newest[:, None]], dim=1)
        assert isinstance(stacked, Frames) == large
        assert torch.equal(whole(stacked), expected)
        states.append(followed(states[at], stacked))
        copies.append(expected[:, 1:])
    assert all(torch.equal(whole(state.features), copy) for state, copy in zip(states, copies, strict=True))


def test_following_frames_share_their_memory():
    """Each frame would copy the whole history, as before."""
    history, stacks = History.cold(torch.rand(FACES, 34), 1, FRAMES), Stacks()
    places = set()
    for _ in range(ROOM - FRAMES + 1):
        stacked = stacks(history, torch.rand(FACES, 34))
        places.add(stacked.untyped_storage().data_ptr())
        history = followed(history, stacked)
    assert len(places) == 1


def test_frames_of_large_batches_are_not_copied(monkeypatch):
    """The features of a large batch would be in memory twice while a frame is computed."""
    monkeypatch.setattr(kept, "MOST_BYTES", 0)
    history, stacks = History.cold(torch.rand(FACES, 34), 1, FRAMES), Stacks(separate=True)
    given = [torch.rand(FACES, 34) for _ in range(FRAMES)]
    for newest in given:
        stacked = stacks(history, newest)
        history = followed(history, stacked)
    assert all(one is other for one, other in zip(stacked.frames, given, strict=True))
    assert isinstance(Stacks()(History.cold(given[0], 1, FRAMES), given[1]), torch.Tensor)  # a network that needs one


@pytest.mark.parametrize("large", [False, True])
def test_gradients_reach_the_newest_features(large, monkeypatch):
    """Features would be written into memory without a gradient."""
    monkeypatch.setattr(kept, "MOST_BYTES", 0 if large else 2**26)
    newest = torch.rand(FACES, 34, requires_grad=True)
    history, stacks = History.cold(torch.rand(FACES, 34), 1, FRAMES), Stacks(separate=True)
    history = followed(history, stacks(history, torch.rand(FACES, 34)))
    stacked = stacks(history, newest)
    assert isinstance(stacked, torch.Tensor)
    stacked.sum().backward()
    assert newest.grad is not None
    assert torch.equal(newest.grad, torch.ones(FACES, 34))
