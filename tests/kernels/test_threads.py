"""The pool of threads, and launches that are cut into ranges for it."""

import threading

import pytest
import torch
import warp as wp

from warpgarment.kernels import threads
from warpgarment.kernels.launch import as_argument, launch_rows


@pytest.fixture
def three():
    """Three threads, whatever the machine has."""
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@wp.kernel(enable_backward=False)
def rows_kernel(from_row: wp.int32, scale: wp.float32, squares: wp.array[wp.float32]):
    i = from_row + wp.tid()
    squares[i] = scale * wp.float32(i) * wp.float32(i)


@pytest.mark.parametrize("rows", [0, 1, 5, 1000, 1024])
def test_ranges_of_a_launch_cover_every_row_once(three, monkeypatch, rows):
    """Rows would be left out, written by another range, or computed as if their range began at zero. Exact."""
    number, spread = [], threads.spread
    monkeypatch.setattr(threads, "spread", lambda calls: number.append(len(calls)) or spread(calls))
    squares = torch.full((rows + 1,), -1.0)
    launch_rows(rows_kernel, rows, [2.0], [as_argument(squares, wp.float32)], wp.get_device("cpu"), least=2)
    assert squares.tolist() == [2.0 * i * i for i in range(rows)] + [-1.0]
    assert number == ([min(9, rows // 2)] if rows >= 4 else [])


def test_calls_run_on_several_threads_in_this_ones_mode(three):
    """Work would stay on one core, or gradients be recorded in a thread that knows nothing of `no_grad`."""
    met = threading.Barrier(3, timeout=60)
    seen = []

    def call():
        met.wait()  # only passes if three calls run at the same time
        seen.append((torch.is_inference_mode_enabled(), threads.count()))

    with torch.inference_mode():
        threads.spread([call] * 3)
    assert seen == [(True, 1)] * 3
    assert threads.count() == 3


def test_an_exception_of_a_call_is_raised_after_all_have_ended(three):
    """A fault in a thread would be lost, or memory freed that another call still writes."""
    running = []

    def call(number):
        running.append(number)
        if number == 1:
            raise ValueError("of the second")
        running.remove(number)

    with pytest.raises(ValueError, match="of the second"):
        threads.spread([lambda n=n: call(n) for n in range(9)])
    assert running == [1]


def test_torch_works_on_one_thread_and_then_as_before(three):
    """Torch's threads would wait for each other beside the pool, or stay at one after a frame."""
    with threads.torch_on_one():
        assert (torch.get_num_threads(), threads.count()) == (1, 3)
        with threads.torch_on_all():
            assert torch.get_num_threads() == 3
        with threads.torch_on_one():
            assert (torch.get_num_threads(), threads.count()) == (1, 3)
        assert torch.get_num_threads() == 1
    assert (torch.get_num_threads(), threads.count()) == (3, 3)


def test_calls_aside_run_in_their_order_and_once(three):
    """Sums would be added up by two threads at a time, or a call be lost that no thread has begun at the end."""
    started, go, order = threading.Event(), threading.Event(), []
    aside = threads.Aside()

    def first():
        started.set()
        go.wait(60)
        order.append(0)

    aside.add(first)
    for number in range(1, 20):
        aside.add(lambda number=number: order.append(number))
    assert started.wait(60)  # on another thread, while this one goes on
    assert order == []
    go.set()
    aside.finish()
    assert order == list(range(20))


def test_calls_that_are_spread_need_no_thread_that_is_busy_aside(three):
    """A launch would wait until gradients of weights are added up that nobody needs yet."""
    go, seen, asides = threading.Event(), [], [threads.Aside() for _ in range(4)]
    for aside in asides:
        aside.add(lambda: go.wait(60))
    threads.spread([lambda n=n: seen.append(n) for n in range(6)])
    assert sorted(seen) == list(range(6))
    go.set()
    for aside in asides:
        aside.finish()


def test_an_exception_of_a_call_aside_is_raised_when_it_is_finished(three):
    """A fault in a thread would be lost, and sums without it be the gradient."""
    aside, seen = threads.Aside(), []

    def fail():
        raise ValueError("of the second")

    for call in (lambda: seen.append(0), fail, lambda: seen.append(2)):
        aside.add(call)
    with pytest.raises(ValueError, match="of the second"):
        aside.finish()
    assert seen == [0]
