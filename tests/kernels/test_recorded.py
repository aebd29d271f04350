"""Launches by the record of a kernel's first launch, beside NumPy."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
import warp as wp

from warpgarment.kernels import recorded
from warpgarment.kernels.launch import as_argument, as_warp, launch, launch_adjoint, launch_tiled


@wp.struct
class Line:
    slope: wp.float32
    ends: wp.array[wp.vec3]


@wp.kernel(enable_backward=False)
def above(
    from_row: wp.int32,
    line: Line,
    twice: wp.bool,
    shift: wp.vec3,
    points: wp.array[wp.vec3],
    result: wp.array[wp.float64],
):
    i = from_row + wp.tid()
    value = line.slope * points[i][0] + wp.dot(shift, line.ends[0])
    if twice:
        value *= 2.0
    result[i] = wp.float64(value)


@wp.kernel(enable_backward=False)
def lanes(result: wp.array[wp.int32]):
    row, lane = wp.tid()
    result[row] += 1 + lane


def given(slope: float, twice: bool, count: int) -> tuple[list[object], torch.Tensor, np.ndarray, list[torch.Tensor]]:
    """Arguments, result, expected numbers and the memory of the arguments."""
    points, ends = torch.rand(count, 3), torch.rand(1, 3)
    line, result = Line(), torch.full((count,), torch.nan, dtype=torch.float64)
    line.slope, line.ends = slope, as_warp(ends, wp.vec3)
    shift = wp.vec3(1.0, 2.0, 3.0)
    arguments = [0, line, twice, shift, as_argument(points, wp.vec3), as_argument(result, wp.float64)]
    expected = (slope * points[:, 0] + ends[0] @ torch.tensor([1.0, 2.0, 3.0])).numpy() * (2.0 if twice else 1.0)
    return arguments, result, expected, [points, ends]


def test_later_launches_take_their_own_arguments():
    """A launch would read arguments or rows of the one that was recorded. Rounding of three float32 products."""
    device = wp.get_device("cpu")
    for slope, twice, count in ((1.5, False, 7), (-2.0, True, 100), (0.25, False, 1)):
        arguments, result, expected, _memory = given(slope, twice, count)
        launch(above, count, arguments, device)
        np.testing.assert_allclose(result.numpy(), expected, rtol=1e-5, atol=1e-5)
    arguments, result, expected, _memory = given(1.0, True, 10)
    launch(above, 4, [3, *arguments[1:]], device)
    assert result.isnan().tolist() == [not 3 <= k < 7 for k in range(10)]
    np.testing.assert_allclose(result.numpy()[3:7], expected[3:7], rtol=1e-5, atol=1e-5)


def test_launches_in_several_threads():
    """Threads would share the arguments of a kernel."""
    device = wp.get_device("cpu")
    cases = [given(0.1 * k, k % 2 == 0, 50 + k) for k in range(64)]
    calls = [recorded.prepared(above, len(result), arguments, device) for arguments, result, _, _ in cases]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda call: call(), calls))
    for _, result, expected, _memory in cases:
        np.testing.assert_allclose(result.numpy(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("known", [False, True])
def test_ranges_have_their_own_first_rows(known, monkeypatch):
    """Ranges of a launch would all begin at the same row, the first time a kernel is launched or later."""
    device = wp.get_device("cpu")
    arguments, result, expected, _memory = given(0.5, True, 20)
    if not known:
        monkeypatch.setattr(recorded, "_records", {})
    else:
        launch(above, 4, arguments, device)
        result.fill_(torch.nan)
    calls = recorded.divided(above, [0, 3, 4, 20], arguments[1:], device)
    assert len(calls) == 3
    for call in reversed(calls):
        call()
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-5, atol=1e-5)


@wp.kernel
def scaled(factor: wp.array[wp.float32], points: wp.array[wp.vec3], power: wp.int32, result: wp.array[wp.float32]):
    i = wp.tid()
    value = factor[i]
    if power == 2:
        value *= factor[i]
    result[i] = value * wp.length_sq(points[i])


def test_adjoints_are_those_of_their_own_arguments():
    """An adjoint would read arguments of the first launch, add to the wrong gradient, or not add. Float32: 1e-5."""
    device, generator = wp.get_device("cpu"), torch.Generator().manual_seed(0)
    for count, power in ((7, 1), (100, 2), (1, 1)):
        factor, points = torch.rand(count, generator=generator), torch.rand(count, 3, generator=generator)
        result, incoming = torch.full((count,), torch.nan), torch.rand(count, generator=generator)
        before = torch.ones(count)
        of_factor, passed = before.clone(), incoming.clone()
        arguments = [as_argument(factor, wp.float32), as_argument(points, wp.vec3), power]
        arguments.append(as_argument(result, wp.float32))
        adjoints = [as_argument(of_factor, wp.float32), None, None, as_argument(passed, wp.float32)]
        launch_adjoint(scaled, count, arguments, adjoints, device)
        square = points.double().square().sum(1)
        slope = incoming * square * (2.0 * factor if power == 2 else 1.0)
        torch.testing.assert_close(of_factor.double(), before + slope.double(), rtol=1e-5, atol=1e-5)


def test_kernels_are_recorded_once_by_several_threads():
    """Two threads would compile and load a module at the same time."""

    @wp.kernel(enable_backward=False, module="unique")
    def doubled(values: wp.array[wp.float32], result: wp.array[wp.float32]):
        i = wp.tid()
        result[i] = 2.0 * values[i]

    device, values = wp.get_device("cpu"), torch.rand(50)
    results = [torch.full((50,), torch.nan) for _ in range(8)]

    def call(result: torch.Tensor) -> None:
        launch(doubled, 50, [as_argument(values, wp.float32), as_argument(result, wp.float32)], device)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(call, results))
    for result in results:
        assert torch.equal(result, 2.0 * values)


def test_a_block_of_a_row_is_one_lane():
    """Rows of a kernel with blocks would be counted as often as there are lanes."""
    device = wp.get_device("cpu")
    for rows in (3, 5):
        result = torch.zeros(rows, dtype=torch.int32)
        launch_tiled(lanes, rows, [as_argument(result, wp.int32)], device, block_dim=64)
        assert result.tolist() == [1] * rows


def test_arguments_that_do_not_fit_are_refused_as_by_warp():
    """A wrong argument would be read as memory of another kind."""
    device = wp.get_device("cpu")
    arguments, *_memory = given(1.0, False, 5)
    launch(above, 5, arguments, device)
    with pytest.raises(RuntimeError, match="passed 5 arguments but kernel requires 6"):
        launch(above, 5, arguments[:-1], device)
    with pytest.raises(Exception, match="points"):
        launch(above, 5, [*arguments[:4], 3.0, arguments[5]], device)
