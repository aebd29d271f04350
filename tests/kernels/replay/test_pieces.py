"""Replayed pieces beside the functions that they stand for, and beside NumPy."""

import numpy as np
import pytest
import torch
import warp as wp

from warpgarment.kernels import recorded, threads
from warpgarment.kernels.launch import as_argument, launch, launch_rows
from warpgarment.kernels.operator import allocate
from warpgarment.kernels.replay.pieces import CHECKS, WARM_UP, Pieces
from warpgarment.kernels.replay.recording import addresses, also, passing

CALLS = WARM_UP + 1 + CHECKS + 4
CPU = torch.device("cpu")


@wp.kernel(enable_backward=False)
def scaled(from_row: wp.int32, factor: wp.float32, x: wp.array[wp.float32], y: wp.array[wp.float32]):
    i = from_row + wp.tid()
    y[i] = factor * x[i]


@wp.kernel(enable_backward=False)
def counted(x: wp.array[wp.float32], total: wp.array[wp.float32]):
    wp.atomic_add(total, 0, x[wp.tid()])


@wp.func_native("return *((float*)places.data[k] + i);")
def at_address(places: wp.array[wp.int64], k: int, i: int) -> float: ...


@wp.kernel(enable_backward=False)
def gathered(count: wp.int32, places: wp.array[wp.int64], y: wp.array[wp.float32]):
    i = wp.tid()
    total = wp.float32(0.0)
    for k in range(count):
        total += wp.float32(k + 1) * at_address(places, k, i)
    y[i] = total


def times(x: torch.Tensor, factor: float) -> torch.Tensor:
    """A launch in ranges."""
    result = allocate(x.shape, torch.float32, CPU)
    given = [factor, as_argument(x, wp.float32)]
    launch_rows(scaled, len(x), given, [as_argument(result, wp.float32)], wp.get_device("cpu"), least=8)
    return result


def total(x: torch.Tensor) -> torch.Tensor:
    """A launch that adds to zeros."""
    result = torch.zeros(1)
    launch(counted, len(x), [as_argument(x, wp.float32), as_argument(result, wp.float32)], wp.get_device("cpu"))
    return result


class Counted:
    """A function that counts its calls."""

    def __init__(self, function) -> None:
        self.function, self.calls = function, 0

    def __call__(self, *tensors):
        self.calls += 1
        return self.function(*tensors)


@pytest.fixture(params=[1, 2, 3])
def pieces(request, monkeypatch):
    monkeypatch.setattr(threads, "count", lambda: request.param)
    with torch.inference_mode():
        yield Pieces(on=True)


def test_a_replay_does_what_the_function_does(pieces):
    """Launches, what torch computes between them, zeros that a kernel adds to, or an input would be left out or stale.
    NumPy in float64 is within rounding of float32; the function is called as often as is said, and no more."""

    def function(x, y):
        doubled = times(x, 2.0)
        mixed = torch.where(y > 0, doubled + y, doubled)
        return times(mixed, 0.5), total(mixed), torch.cat([x[:2], mixed[1:3]])

    piece = Counted(function)
    for seed in range(CALLS):
        x, y = (torch.from_numpy(a) for a in np.random.default_rng(seed).normal(size=(2, 100)).astype(np.float32))
        half, sums, some = (t.clone() for t in pieces("piece", piece, (x, y)))
        mixed = 2.0 * x.double().numpy() + np.maximum(y.double().numpy(), 0.0)
        np.testing.assert_allclose(half, 0.5 * mixed, atol=1e-6)
        np.testing.assert_allclose(sums, mixed.sum(), atol=1e-4)
        np.testing.assert_allclose(some, [*x[:2], *mixed[1:3]], atol=1e-6)
    assert piece.calls == WARM_UP + 1 + CHECKS


READS = {
    "a number": lambda x: (x * float(x[0]),),
    "a decision": lambda x: (x if bool((x > 0).any()) else -x,),
    "NumPy": lambda x: (torch.from_numpy(x.numpy() * 2.0),),
    "a mask": lambda x: (x[x > 0].sum()[None],),
    "places": lambda x: ((x > 0).nonzero().sum()[None],),
    "a list": lambda x: (torch.tensor(x.tolist()),),
    "what nobody has looked at": lambda x: (torch.fft.fft(x).real,),
}


@pytest.mark.parametrize("name", READS)
def test_what_reads_numbers_is_always_called(name, pieces):
    """A replay would go on with the numbers of the frame that was recorded."""
    piece = Counted(READS[name])
    for number in range(CALLS):
        x = torch.arange(6.0) - number
        (found,) = pieces("piece", piece, (x,))
        assert torch.equal(found, READS[name](x)[0])
    assert piece.calls >= CALLS


def test_other_numbers_are_noticed(pieces):
    """A function that depends on what is not among its inputs would be replayed all the same. It warns, and the results
    are those of the function."""
    numbers = iter(range(100))

    def function(x):
        return (times(x, float(next(numbers))),)

    def run():
        return [float(pieces("stretch", function, (torch.ones(8),))[0][0]) for _ in range(CALLS)]

    with pytest.warns(RuntimeWarning, match="stretch is not replayed: a replay gave other numbers"):
        results = run()
    assert results == [float(n) for n in range(CALLS)]


def test_frames_are_read_where_they_are(pieces):
    """A replay would read the frames that were recorded. Exact: sums of small integers. Two of them may be one tensor
    at first, as the frames of a start at rest are."""
    device, frames = wp.get_device("cpu"), [torch.full((5,), 1.0)] * 3

    def function(x, *past):
        y = allocate((5,), torch.float32, CPU)
        places = addresses([*past, x])
        launch(gathered, 5, [4, as_argument(places, wp.int64), as_argument(y, wp.float32)], device)
        return (y,)

    piece = Counted(function)
    for number in range(CALLS):
        x = torch.full((5,), 10.0 * number)
        (y,) = pieces("piece", piece, (x,), frames=tuple(frames))
        expected = sum((k + 1) * float(f[0]) for k, f in enumerate([*frames, x]))
        assert y.tolist() == [expected] * 5
        frames = [*frames[1:], x]
    assert piece.calls == WARM_UP + 1 + CHECKS


def test_an_operator_on_such_a_frame_is_not_recorded(pieces):
    """It would go on with the frame that was recorded."""
    for number in range(CALLS):
        frame = torch.full((3,), float(number))
        (y,) = pieces("piece", lambda x, f: (x + f,), (torch.ones(3),), frames=(frame,))
        assert y.tolist() == [number + 1.0] * 3


def test_results_can_be_kept(pieces):
    """A state would change when later frames are computed."""
    kept = [
        pieces.kept(pieces("piece", lambda x: (times(x, 3.0),), (torch.full((4,), float(n)),))[0]) for n in range(CALLS)
    ]
    assert [float(t[0]) for t in kept] == [3.0 * n for n in range(CALLS)]


def test_constants_and_inputs_are_not_written_to(pieces):
    """A replay writes inputs to where the recorded ones are: never into a tensor of the caller, nor into a constant
    that passes through a piece on its way to another one."""
    constant, given = torch.full((4,), 7.0), []
    for number in range(2 * CALLS):
        x = torch.full((4,), float(number))
        given.append(x)
        y, passed, same = pieces("one", lambda x: (times(x, 2.0), constant, x), (x,))
        other = passed if number < CALLS else torch.full((4,), 100.0)
        (z,) = pieces("two", lambda *a: (a[0] + a[1] + a[2],), (y, other, same))
        assert z.tolist() == [3.0 * number + (7.0 if number < CALLS else 100.0)] * 4
    assert constant.tolist() == [7.0] * 4
    assert [float(t[0]) for t in given] == list(range(2 * CALLS))


def test_pieces_share_memory_and_not_results(pieces):
    """What one piece works with would be another's result, or memory that is given out again be needed after all."""

    def function(x):
        after = allocate((1000,), torch.float32, CPU)
        for part in range(4):
            with passing():
                work = times(times(x + part, 2.0), 2.0)
                rows = [0, 0.25, as_argument(work, wp.float32), as_argument(after[250 * part :], wp.float32)]
                launch(scaled, 250, rows, wp.get_device("cpu"))
        return (after,)

    for number in range(CALLS):
        x = torch.arange(1000.0) + number
        one, two = (pieces(key, function, (x + shift,))[0] for key, shift in (("one", 0), ("two", 500)))
        for found, shift in ((one, 0), (two, 500)):
            expected = np.concatenate([np.arange(250) + number + shift + part for part in range(4)])
            np.testing.assert_array_equal(found, expected)
    assert pieces._arena.bytes < 2**21


def test_other_constants_are_recorded_anew(pieces):
    """Weights that were changed would go on as they were."""
    for round_, factor in enumerate((2.0, 5.0)):
        for number in range(CALLS):
            (y,) = pieces(
                "piece", lambda x, f=factor: (times(x, f),), (torch.full((3,), float(number)),), depends=round_
            )
            assert y.tolist() == [factor * number] * 3


def test_what_is_no_launch_is_done_again(pieces):
    """A tree would stay where it was recorded."""
    done = []

    def function(x):
        also(lambda: done.append(1))
        return (times(x, 1.0),)

    for _ in range(CALLS):
        pieces("piece", function, (torch.ones(3),))
    assert len(done) == CALLS + CHECKS  # in a check, by both


def test_gradients_are_those_of_the_function():
    """Replays know nothing of gradients."""
    pieces = Pieces(on=True)
    for _ in range(CALLS):
        x = torch.ones(3, requires_grad=True)
        (y,) = pieces("piece", lambda x: (x * x,), (x,))
        y.sum().backward()
        assert x.grad.tolist() == [2.0] * 3


def test_launches_are_not_noted_after_a_recording_failed(pieces):
    """Launches of the whole process would be kept for good."""
    for _ in range(WARM_UP + 1):
        pieces("piece", lambda x: (times(x, float(x[0])),), (torch.ones(3),))
    assert recorded.notes.recording is None
    assert recorded.notes.memory is None
