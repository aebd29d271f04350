"""Descriptors of tensors, of which shapes and types are remembered."""

import gc
import weakref

import pytest
import torch
import warp as wp

from warpgarment.kernels import launch
from warpgarment.kernels.launch import as_argument


@wp.kernel(enable_backward=False)
def sum_of_rows(table: wp.array2d[wp.float32], total: wp.array[wp.float32]):
    i = wp.tid()
    for j in range(table.shape[1]):
        total[i] += table[i, j]


def totals(table: torch.Tensor) -> list[float]:
    """Sums of the rows, by a launch with descriptors."""
    total = torch.zeros(len(table))
    wp.launch(
        sum_of_rows, len(table), inputs=[as_argument(table, wp.float32), as_argument(total, wp.float32)], device="cpu"
    )
    return total.tolist()


def test_one_address_under_several_shapes():
    """A launch would read a tensor in the shape of another that was at its address."""
    table = torch.arange(4.0).view(2, 2)
    assert totals(table) == [1.0, 5.0]
    assert totals(table.t()) == [2.0, 4.0]
    assert totals(table.view(1, 4)) == [6.0]
    assert totals(table.view(4, 1)) == [0.0, 1.0, 2.0, 3.0]
    table += 1
    assert totals(table) == [3.0, 7.0]
    with pytest.raises(RuntimeError, match="Cannot convert"):
        as_argument(table, wp.int32)


def test_memory_is_given_back_and_few_are_remembered(monkeypatch):
    """Descriptors would keep every tensor that was ever passed, or pile up in a long training."""
    monkeypatch.setattr(launch, "MOST_DESCRIPTORS", 8)
    monkeypatch.setattr(launch, "_descriptors", {})
    tensor = torch.zeros(100)
    alive = weakref.ref(tensor.untyped_storage())
    as_argument(tensor, wp.float32)
    del tensor
    gc.collect()
    assert alive() is None
    kept = [torch.zeros(n) for n in range(1, 20)]
    for tensor in kept:
        as_argument(tensor, wp.float32)
        assert 0 < len(launch._descriptors) <= 8
