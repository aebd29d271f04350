"""Tables and judgements for the terminal."""

from __future__ import annotations

import numpy as np

from warpgarment.objects.motion import GarmentMotion
from warpgarment.objects.status import RolloutStatus
from warpgarment.view.report import certified, rollout_table


def moved(*figures: tuple[int | None, int | None, float | None], finite: bool = True) -> GarmentMotion:
    """A motion with crossing pairs with others, with itself, and lag [m] of each frame."""
    status = [
        RolloutStatus.judged(t, finite, 0.0, layer_crossings=a, self_crossings=b, lag=c)
        for t, (a, b, c) in enumerate(figures)
    ]
    positions = np.zeros((len(figures), 3, 3), np.float32)
    return GarmentMotion(positions, np.array([[0, 1, 2]], np.int32), 30.0, status)


def test_only_what_was_counted_is_free():
    """A result would be called free that was not checked, or of which one frame crosses."""
    assert certified(moved((0, 0, None), (0, 0, 0.1))) == ""
    assert certified(moved((0, 0, None), (3, 1, 0.1), (0, 2, 0.0))) == (
        "crosses in 2 of 3 frames (first: frame 1), 4 pairs at most"
    )
    assert certified(moved((0, 0, None), (None, 0, 0.0))) == "not counted in 1 of 2 frames (first: frame 1)"
    assert certified(moved((None, None, None))) == "not counted in 1 of 1 frames (first: frame 0)"
    assert certified(moved((1, 0, None), (None, None, None))).startswith("crosses in 1 of 2")
    assert certified(moved((0, 0, None), finite=False)) == "not finite from frame 0 on"
    assert certified(GarmentMotion(np.zeros((1, 3, 3)), [[0, 1, 2]])) == "not counted"


def test_a_table_of_layers():
    """Crossings or lag of one garment would stand under another, or the time of all be one garment's."""
    motions = {
        "a": moved((0, 0, None), (3, 1, 0.0125)),
        "b": moved((0, 0, None), (None, 2, 0.0)),
        "c": moved((0, 0, None)),
    }
    text = rollout_table(motions, {"all": {"network": 0.003}})
    rows = {line.split("  ")[0].strip(): line.split("  ")[1:] for line in text.splitlines()}
    rows = {name: [cell.strip() for cell in row if cell.strip()] for name, row in rows.items()}
    assert text.splitlines()[0].split() == ["a", "b", "c", "all"]
    assert rows["crossing pairs with other garments, most"] == ["3", "0 or more", "0"]
    assert rows["crossing pairs with itself, most"] == ["1", "2", "0"]
    assert rows["lag, most [mm]"] == ["12.5", "0.0", "-"]
    assert rows["network [ms/frame]"] == rows["together [ms/frame]"] == ["3.0"]
    end = len(text.splitlines()[0])
    assert text.splitlines()[4][:end].endswith("3.0")
    alone = rollout_table({"a": moved((None, None, None))}, {"a": {"network": 0.003}})
    assert "crossing" not in alone
    assert "lag" not in alone
