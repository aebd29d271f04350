"""If these failed, a film would run at another speed than the motion, jump, or show frames that are not there yet."""

from __future__ import annotations

import pytest

from warpgarment.view.browser.playhead import Playhead


def test_it_plays_in_time_and_begins_again():
    """A motion would last longer or shorter than it should, or end. Frames are those of a clock: floor(30 t) mod 60."""
    head = Playhead(60, 30.0)
    head.play(100.0)
    for passed in (0.0, 0.4, 1.0, 1.99, 2.01, 3.7, 5.3):
        assert head.at(100.0 + passed) == int(passed * 30.0 + 1e-6) % 60


def test_speed_changes_from_now_on():
    """Moving the slider would jump to another frame: half a second at 1, then one at 0.5, are 15 + 15 frames."""
    head = Playhead(60, 30.0)
    head.play(0.0)
    head.turn(0.5, 0.5)
    assert head.at(0.501) == 15
    assert head.at(1.501) == 30


def test_holding_and_seeking():
    """A held motion would creep, or a scrubbed one would not go on from where it was put."""
    head = Playhead(60, 30.0)
    head.play(0.0)
    head.hold(1.01)
    assert head.at(50.0) == 30
    assert head.wait(50.0) is None
    head.seek(12, 60.0)
    assert head.at(70.0) == 12
    head.play(70.0)
    assert head.at(70.11) == 15
    head.seek(900, 71.0)
    assert head.at(71.0) == 59


@pytest.mark.parametrize("speed", [0.25, 1.0, 2.0])
def test_it_says_when_the_next_frame_comes(speed: float):
    """The page would wake too late, and leave frames out, or too early: the frame changes at the time that it says."""
    head = Playhead(60, 30.0)
    head.turn(speed, 0.0)
    head.play(0.0)
    wait = head.wait(0.3)
    assert wait is not None
    assert head.at(0.3 + wait - 1e-6) == head.at(0.3)
    assert head.at(0.3 + wait + 1e-6) == head.at(0.3) + 1


def test_it_waits_for_frames_that_are_not_there():
    """Frames that are not computed yet would be shown, or those that were waited for left out once they arrive."""
    head = Playhead(60, 30.0)
    head.play(0.0)
    assert head.at(1.0, ready=5) == 4
    assert head.at(1.1, ready=6) == 5  # no jump: it goes on from where it waited
    assert head.at(1.14, ready=60) == 6
    held = Playhead(60, 30.0)
    held.seek(20, 0.0)
    assert held.at(1.0, ready=5) == 4
    assert held.at(2.0, ready=60) == 20, "a held frame comes back when it is there"
