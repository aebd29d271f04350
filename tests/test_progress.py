"""Bars of what takes long: they say how much is left, and leave no trace where nobody looks."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np

import warpgarment as wg
from warpgarment import progress
from warpgarment.progress import bars, counted, parts


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


def test_parts_have_a_bar_where_it_was_asked_for_and_takes_long(capsys, monkeypatch):
    """A file would be written for a minute without a sign, a quick one flash up a bar, or a script that asked for none
    be shown one. The number of frames is that of the array."""
    frames = np.zeros((3, 2, 3))
    monkeypatch.setattr(progress, "LATER", 0.0)
    assert len(list(parts(frames, "writing"))) == 3
    assert capsys.readouterr().err == ""
    with bars(shown=True):
        assert len(list(parts(frames, "writing m"))) == 3
    said = capsys.readouterr().err
    assert "writing m" in said
    assert "/3" in said
    monkeypatch.setattr(progress, "LATER", 60.0)
    with bars(shown=True):
        list(parts(frames, "writing"))
    with bars(shown=False):
        list(parts(frames, "writing"))
    assert capsys.readouterr().err == ""


def test_files_are_written_with_a_bar(capsys, monkeypatch, tmp_path):
    """A format would keep quiet while it works through its frames. Each writer, and the readers of those that are read
    frame by frame, say what they do; the motion comes back."""
    monkeypatch.setattr(progress, "LATER", 0.0)
    body = wg.BodyMotion(np.random.default_rng(0).normal(size=(3, 4, 3)), [[0, 1, 2], [0, 2, 3]], fps=30)
    for name in ("m.usda", "m.abc", "m.glb", "m.pc2", "m.mdd", "frames/"):
        with bars(shown=True):
            body.save(f"{tmp_path}/{name}")
        assert "writing" in capsys.readouterr().err, name
    for name in ("m.usda", "m.abc", "frames/"):
        with bars(shown=True):
            back = wg.BodyMotion.load(f"{tmp_path}/{name}", fps=30)
        assert "reading" in capsys.readouterr().err, name
        np.testing.assert_allclose(back.vertices, body.vertices, atol=1e-6)


def test_compiling_is_said_while_it_goes_on(capsys, monkeypatch, tmp_path):
    """The first run would stand still for half a minute. A folder that Warp makes for this process is a module that is
    compiled; those of other processes and finished ones are not."""
    monkeypatch.setattr(progress, "_cached", lambda: [path.name for path in tmp_path.iterdir()])
    (tmp_path / "wp_done_0123456").mkdir()
    (tmp_path / "wp_theirs_0123456_p1_t77").mkdir()
    with bars(shown=True):
        time.sleep(1.2)
    assert capsys.readouterr().err == ""
    with bars(shown=True):
        (tmp_path / f"wp_ours_0123456_p{os.getpid()}_t77").mkdir()
        time.sleep(1.2)
        (tmp_path / f"wp_ours_0123456_p{os.getpid()}_t77").rename(tmp_path / "wp_ours_0123456")
        time.sleep(1.2)
    said = capsys.readouterr().err
    assert "compiling kernels, only this once: 0module" in said
    assert "compiling kernels, only this once: 1module" in said


def test_warp_makes_modules_in_folders_of_that_name(tmp_path):
    """A later Warp would compile elsewhere, and the bar never appear: a kernel is compiled into an empty cache."""
    (tmp_path / "kernel.py").write_text(
        "import threading, os, sys, warp as wp\n"
        "wp.config.kernel_cache_dir = sys.argv[1]\n"
        "wp.init()  # which puts a folder for its version there\n"
        "@wp.kernel\n"
        "def twice(x: wp.array[float]):\n"
        "    x[wp.tid()] = 2.0 * x[wp.tid()]\n"
        "seen, done = set(), threading.Event()\n"
        "def look():\n"
        "    while not done.wait(0.005):\n"
        "        seen.update(os.listdir(wp.config.kernel_cache_dir))\n"
        "thread = threading.Thread(target=look); thread.start()\n"
        "wp.launch(twice, 1, [wp.zeros(1, dtype=float, device='cpu')], device='cpu')\n"
        "done.set(); thread.join()\n"
        "print(sum(f'_p{os.getpid()}_t' in name for name in seen))\n"
    )
    cache = tmp_path / "cache"
    cache.mkdir()
    ran = subprocess.run([sys.executable, tmp_path / "kernel.py", cache], capture_output=True, text=True, check=True)
    assert int(ran.stdout.split()[-1]) == 1
