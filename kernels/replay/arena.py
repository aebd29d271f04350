"""Memory that recorded pieces share: what one of them works with is of no use when the next one runs."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence

import torch

ALIGNED = 64  # bytes, a line of the cache
CHUNK = 2**20  # least bytes of a part of the memory


class Arena:
    """Memory that grows by chunks and is given out from its beginning, again for each piece."""

    def __init__(self) -> None:
        self._chunks: list[torch.Tensor] = []

    @property
    def bytes(self) -> int:
        """Bytes of all chunks."""
        return sum(map(len, self._chunks))

    def given_out(self, apart: Iterable[int]) -> GivenOut:
        """Gives out memory to a piece.

        Args:
            apart: Numbers of the tensors, in the order in which they are asked for, that get memory of their own.
        """
        return GivenOut(self, frozenset(apart))

    def part(self, place: tuple[int, int], size: int) -> tuple[torch.Tensor, tuple[int, int]]:
        """Bytes from a place on, which is a chunk and an offset, and the place after them."""
        chunk, offset = place
        while chunk < len(self._chunks) and offset + size > len(self._chunks[chunk]):
            chunk, offset = chunk + 1, 0
        if chunk == len(self._chunks):
            self._chunks.append(torch.empty(max(size, CHUNK), dtype=torch.uint8))
        end = offset + -(-size // ALIGNED) * ALIGNED
        return self._chunks[chunk][offset : offset + size], (chunk, end)


class GivenOut:
    """What `operator.allocate` asks for tensors while a piece is recorded."""

    def __init__(self, arena: Arena, apart: frozenset[int]) -> None:
        self._arena, self._apart, self._place, self._number = arena, apart, (0, 0), -1

    @contextlib.contextmanager
    def again(self) -> Iterator[None]:
        """Context after which its memory is given out again: what was asked for within it is of no use then."""
        place = self._place
        yield
        self._place = place

    def __call__(self, shape: Sequence[int], dtype: torch.dtype) -> torch.Tensor:
        """A tensor on the CPU."""
        self._number += 1
        size = math.prod(shape) * dtype.itemsize
        if self._number in self._apart or not size:
            return torch.empty(tuple(shape), dtype=dtype)
        with torch._C.DisableTorchFunction():  # it is no operator of the piece
            part, self._place = self._arena.part(self._place, size)
            return part.view(dtype).view(tuple(shape))


class Observed:
    """Asked instead while a piece is called: finds out which tensors are among its results."""

    def __init__(self) -> None:
        self._made: list[torch.Tensor] = []

    def __call__(self, shape: Sequence[int], dtype: torch.dtype) -> torch.Tensor:
        """A tensor on the CPU."""
        self._made.append(torch.empty(tuple(shape), dtype=dtype))
        return self._made[-1]

    def among(self, results: Iterable[torch.Tensor | None]) -> list[int]:
        """Numbers of the tensors whose memory is that of a result."""
        used = {tensor.untyped_storage().data_ptr() for tensor in results if tensor is not None}
        return [i for i, tensor in enumerate(self._made) if tensor.untyped_storage().data_ptr() in used]
