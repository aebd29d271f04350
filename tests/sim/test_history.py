"""Stacks of following frames, which overlap in memory, beside copies of them."""

import torch

from warpgarment.sim.history import STACKS, History, Stacks

FACES, FRAMES = 7, 6
ROOM = STACKS * FRAMES


def followed(history: History, stacked: torch.Tensor) -> History:
    return history.followed(stacked, torch.zeros(1, 3))


def test_states_keep_their_histories():
    """A frame would overwrite the history of an older state, or read one of another state."""
    torch.manual_seed(0)
    start = History(torch.rand(FACES, FRAMES - 1, 34), torch.zeros(1, FRAMES - 1, 3))
    stacks, states, copies = Stacks(), [start], [start.features.clone()]
    for number in range(3 * ROOM):
        at = number if number % 5 else max(number - 3, 0)  # every fifth frame follows an older state again
        newest = torch.rand(FACES, 34)
        stacked = stacks(states[at], newest)
        expected = torch.cat([copies[at], newest[:, None]], dim=1)
        assert torch.equal(stacked, expected)
        states.append(followed(states[at], stacked))
        copies.append(expected[:, 1:])
    assert all(torch.equal(state.features, copy) for state, copy in zip(states, copies, strict=True))


def test_following_frames_share_their_memory():
    """Each frame would copy the whole history, as before."""
    history, stacks = History.cold(torch.rand(FACES, 34), 1, FRAMES), Stacks()
    places = set()
    for _ in range(ROOM - FRAMES + 1):
        stacked = stacks(history, torch.rand(FACES, 34))
        places.add(stacked.untyped_storage().data_ptr())
        history = followed(history, stacked)
    assert len(places) == 1


def test_gradients_reach_the_newest_features():
    """Features would be written into memory without a gradient."""
    newest = torch.rand(FACES, 34, requires_grad=True)
    history = History.cold(torch.rand(FACES, 34), 1, FRAMES)
    Stacks()(history, newest).sum().backward()
    assert newest.grad is not None
    assert torch.equal(newest.grad, torch.ones(FACES, 34))
