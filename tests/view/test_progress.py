"""Bars of what takes long: they say how much is left, and leave no trace where nobody looks."""

from __future__ import annotations

from warpgarment.view.progress import counted


def test_a_bar_says_how_much_is_left(capsys):
    """Items are lost, or the bar lacks the number of all and the time left; the items have no length of their own."""
    assert list(counted(iter("abcd"), "drawing", unit="frame", total=4, shown=True)) == list("abcd")
    said = capsys.readouterr().err
    assert "drawing" in said
    assert "0/4" in said
    assert "frame/s" in said


def test_no_bar_away_from_a_terminal(capsys):
    """A log file or a pipe fills with bars: pytest's stderr is no terminal."""
    assert list(counted([1, 2], "drawing", unit="frame")) == [1, 2]
    assert capsys.readouterr().err == ""
