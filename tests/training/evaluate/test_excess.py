"""Error over the floor: rollouts and twins with differences that are known."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from support import sequences as synthetic

from warpgarment.training.data.sequence import Sequence
from warpgarment.training.evaluate.excess import Excess, lines
from warpgarment.training.evaluate.twins.stored import write_twin

UP = np.array([0.0, 1.0, 0.0])


@pytest.fixture
def sequence(tmp_path):
    return Sequence.load(synthetic.write(tmp_path / "data", "one", "test", frames=50, seed=1))


def twin(sequence, tmp_path, offset):
    """Stores a twin that is `offset` [m], shape [T], above the recording."""
    moved = sequence.vertices + offset[:, None, None] * UP
    write_twin(tmp_path / "twins" / f"{sequence.name}.json", sequence, moved, {}, noise=0.1, seed=0, replay=0.0)


def test_excess_is_error_minus_floor_of_the_same_frames(sequence, tmp_path):
    """Floors are of other frames than the rollout's, or signs are exchanged. The twin rises by 1 mm a frame, the
    prediction is 3 cm up; frames 10 to 49 are predicted. 2e-5 relative: five digits are stored."""
    time = np.arange(50)
    twin(sequence, tmp_path, 1e-3 * time)
    excess = Excess(tmp_path / "twins")
    excess.observe(sequence, sequence.body(), "warm", 9, sequence.vertices[10:] + 0.03 * UP)
    (row,) = excess.rows
    floor = 0.1 * time[10:].mean()
    for name in ("distance", "hem", "top", "low"):
        assert row["error"][name] == pytest.approx(3.0, rel=2e-5), name
        assert row["floor"][name] == pytest.approx(floor, rel=2e-5), name
        assert row["excess"][name] == pytest.approx(3.0 - floor, rel=2e-4), name
    np.testing.assert_allclose(row["error_over_time"], 3.0, rtol=2e-5)
    np.testing.assert_allclose(row["floor_over_time"], 0.1 * time[10:], rtol=2e-5, atol=1e-4)
    assert row["error"]["high"] == pytest.approx(0.0, abs=1e-4)
    assert row["looks"]["recording"]["bending"] == row["looks"]["recording"]["acceleration"] == 1.0
    for who in ("network", "twin"):  # neither a shift nor a steady rise bends or accelerates
        for name in ("bending", "strain_1", "strain_99", "acceleration"):
            assert row["looks"][who][name] == pytest.approx(row["looks"]["recording"][name], rel=1e-3, abs=1e-5), name


def test_the_floor_of_the_bias_is_that_of_the_same_frames(sequence, tmp_path):
    """A floor over all frames stands beside the bias of a shorter rollout. It is known from frames 1 and 10 to the end;
    of other frames there is none. The twin is 2 cm up from frame 10 on, and in frames 1 to 9 as far down."""
    twin(sequence, tmp_path, np.where(np.arange(50) < 10, -0.02, 0.02))
    excess = Excess(tmp_path / "twins")
    for newest, last in ((9, 50), (0, 50), (9, 40), (4, 50)):
        vertices = sequence.vertices[newest + 1 : last] + 0.03 * UP
        excess.observe(sequence, sequence.body(), "warm", newest, vertices)
    floors = [row["floor"]["bias"] for row in excess.rows]
    assert floors[0] == pytest.approx(2.0, rel=1e-3)
    assert floors[1] == pytest.approx(2.0 * (40 - 9) / 49, rel=0.05)  # the garment turns a little meanwhile
    assert math.isnan(floors[2])
    assert math.isnan(floors[3])
    assert "3.00 / -" in "\n".join(lines(excess.result()))


def test_sequences_without_a_twin_are_said_and_not_mixed_in(sequence, tmp_path):
    """A mean floor stands beside the mean error of other sequences, or a missing floor counts as zero."""
    twin(sequence, tmp_path, np.full(50, 0.01))
    other = Sequence.load(synthetic.write(tmp_path / "data", "two", "test", frames=50, seed=2))
    excess = Excess(tmp_path / "twins")
    for one, error in ((sequence, 0.03), (other, 0.05)):
        excess.observe(one, one.body(), "cold", 0, one.vertices[1:] + error * UP)
    result = excess.result()
    json.dumps(result)
    assert result["without_floor"] == {"two": "has no twin"}
    assert result["mean"]["cold"]["error"]["distance"] == pytest.approx(4.0, rel=1e-4)
    assert result["mean"]["cold"]["floor"] is None
    assert result["mean_with_floor"]["cold"]["excess"]["distance"] == pytest.approx(2.0, rel=1e-3)
    text = "\n".join(lines(result))
    assert "| **mean with floor** | cold | 3.00 / 1.00 | 2.00 |" in text
    assert "- two: has no twin" in text


def test_without_twins_the_table_has_no_floors_and_says_so(sequence, tmp_path):
    """Columns of nothing are shown, or nobody learns how to make twins."""
    excess = Excess(tmp_path / "twins")
    excess.observe(sequence, sequence.body(), "warm", 9, sequence.vertices[10:] + 0.03 * UP)
    text = "\n".join(lines(excess.result()))
    assert "excess |" not in text
    assert "python -m warpgarment.training.evaluate.twins --data DATA" in text
    assert "| one | warm | 3.00 | 3.00 |" in text
    assert "| one | warm | twin |" not in text


def test_a_rollout_that_failed_counts_as_such(sequence, tmp_path):
    """NaN spreads into the means, or the rollout vanishes from the count."""
    excess = Excess(tmp_path / "twins")
    vertices = sequence.vertices[1:].copy()
    excess.observe(sequence, sequence.body(), "cold", 0, vertices)
    vertices[20:] = np.nan
    excess.observe(sequence, sequence.body(), "cold", 0, vertices)
    mean = excess.result()["mean"]["cold"]
    assert (mean["sequences"], mean["failed"]) == (2, 1)
    assert mean["error"]["distance"] == 0.0
    lines(excess.result())
