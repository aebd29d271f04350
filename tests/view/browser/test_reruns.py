"""If these failed, moving a slider would freeze the page, show an old run, or leave threads behind."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
from support.scenes import skirt, walk

from warpgarment.objects.material import Material
from warpgarment.objects.wind import Wind
from warpgarment.view.browser.reruns import SETTLE, Reruns, Settings
from warpgarment.view.browser.turns import Turns

FRAMES = 40


class Slow:
    """Something to run again: frame k of speed s holds the number 1000 s + k; a frame takes 10 ms."""

    def __init__(self) -> None:
        self.garments, self.body = [skirt()], walk(FRAMES)
        self.reads, self.materials, self.wind = ("wind",), (None,), None
        self.computed: list[int] = []

    def run(self, materials, wind):
        speed = 0 if wind is None else round(float(np.linalg.norm(wind.rows[0])))
        if speed == 13:
            raise ValueError("an unlucky wind")
        for frame in range(FRAMES):
            time.sleep(0.01)
            self.computed.append(1000 * speed + frame)
            value = np.nan if speed == 9 and frame == 3 else 1000 * speed + frame
            yield [np.full((len(self.garments[0].vertices), 3), value, np.float32)]


def _wind(speed: int) -> Settings:
    return Settings((None,), Wind([0, 0, 1], speed))


def _until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_the_last_change_counts():
    """An old run would end before the new one begins, or its frames would be among the new ones."""
    live = Slow()
    reruns = Reruns(live, lambda: None, Turns())
    reruns.ask(_wind(1))
    _until(lambda: reruns.run is not None and reruns.run.ready >= 3)
    for speed in (2, 3, 4):
        reruns.ask(_wind(speed))
    _until(lambda: reruns.run.settings.wind.rows[0, 2] == 4 and reruns.run.done)
    assert not [number for number in live.computed if number // 1000 in (2, 3)], "changes of a moment are one"
    assert len([number for number in live.computed if number // 1000 == 1]) < FRAMES, "the first one is given up"
    assert reruns.run.ready == FRAMES
    np.testing.assert_array_equal(reruns.run.frames[0][:, 0, 0], 4000 + np.arange(FRAMES))
    reruns.close()


def test_frames_can_be_seen_while_others_are_computed():
    """A page would stand still for the whole run: frames are there one after another, and it is told of each."""
    arrived = []
    reruns = Reruns(Slow(), lambda: arrived.append(None if reruns.run is None else reruns.run.ready), Turns())
    reruns.ask(_wind(1))
    _until(lambda: reruns.run is not None and reruns.run.done)
    assert arrived[1:-1] == list(range(1, FRAMES + 1))
    assert reruns.run.seconds >= 0.01 * (FRAMES - 1)
    reruns.close()


def test_faults_are_told_and_the_next_run_goes_on():
    """An error would end the thread in silence, or a frame of NaN would be shown."""
    reruns = Reruns(Slow(), lambda: None, Turns())
    for speed, fault, ready in ((13, "ValueError: an unlucky wind", 0), (9, "positions of frame 3 are not finite", 3)):
        reruns.ask(_wind(speed))
        _until(lambda wanted=speed: reruns.run is not None and reruns.run.settings.wind.rows[0, 2] == wanted)
        _until(lambda: reruns.run.done)
        assert fault in reruns.run.fault
        assert reruns.run.ready == ready
    reruns.ask(_wind(1))
    _until(lambda: reruns.run.done and not reruns.run.fault)
    reruns.close()


def test_closing_ends_the_thread_soon():
    """A page that is closed would compute on: no more than the frame that it is at."""
    before = threading.active_count()
    live = Slow()
    reruns = Reruns(live, lambda: None, Turns())
    reruns.ask(_wind(1))
    _until(lambda: reruns.run is not None and reruns.run.ready >= 1)
    reruns.close()
    assert threading.active_count() == before
    assert len(live.computed) < FRAMES


def test_turns_go_to_whoever_waited_longest():
    """Colours would wait for a whole run: of a plain lock, whoever takes it again at once nearly always has it."""
    turns, stop = Turns(), threading.Event()
    held = SimpleNamespace(times=0)

    def busy() -> None:
        while not stop.is_set():
            with turns:
                held.times += 1
                time.sleep(0.002)

    thread = threading.Thread(target=busy)
    thread.start()
    _until(lambda: held.times > 2)
    waited = []
    for _ in range(20):
        before = held.times
        with turns:
            waited.append(held.times - before)
    stop.set()
    thread.join()
    assert max(waited) <= 2, "one that is in, and at most one that has just begun to wait"


def test_materials_are_handed_on():
    """A run would be of another material than the menu says."""
    live = Slow()
    seen = []
    live.run = lambda materials, wind: seen.append(materials) or iter(())
    reruns = Reruns(live, lambda: None, Turns())
    reruns.ask(Settings((Material.denim(),), None))
    _until(lambda: bool(seen))
    assert seen == [(Material.denim(),)]
    reruns.close()
    assert SETTLE < 0.5
