"""Results of set-up are kept by their content, within a number of bytes."""

from __future__ import annotations

import numpy as np
import pytest

from warpgarment.kernels import kept


def test_other_content_is_made_anew():
    """Two matrices get one factor: content that differs in a number, a type, a shape or a nesting has the same key."""
    store, one = kept.Kept(), np.arange(6, dtype=np.int32)
    contents = [
        (one,), (one.reshape(2, 3),), (one.astype(np.int64),), (one + 1,), (one, one), ((one,), one), (one.tobytes(),),
        (one.tobytes(), True), (one.tobytes(), False), (one.tobytes()[:12], one.tobytes()[12:]), ("a", "b"), ("ab",),
    ]  # fmt: skip
    with kept.keeping(store):
        for number, content in enumerate(contents):
            assert kept.of("x", content, lambda n=number: (n,)) == (number,)
        for number, content in enumerate(contents):
            assert kept.of("x", content, lambda: pytest.fail("made again")) == (number,)
        assert kept.of("y", contents[0], lambda: "other") == "other"


def test_nothing_is_kept_outside_and_no_more_than_its_bytes():
    """Simulations keep the factors of garments that are gone, or training grows without end."""
    store, made = kept.Kept(most=1000), []

    def make(number: int) -> tuple[np.ndarray]:
        made.append(number)
        return (np.zeros(400, np.uint8),)

    for _ in range(2):
        kept.of("x", (0,), lambda: make(0))
    assert made == [0, 0]
    assert not len(store)
    with kept.keeping(store):
        for number in (1, 2, 1, 3, 1, 2):  # 2 was used least recently when 3 came
            kept.of("x", (number,), lambda n=number: make(n))
    assert made == [0, 0, 1, 2, 3, 2]
    assert store.bytes == 800
    assert len(store) == 2
