"""The command line in a pipe that nobody reads."""

import os
import subprocess
import sys

import pytest

from warpgarment import cli, demo


@pytest.mark.skipif(os.name == "nt", reason="pipes of POSIX")
@pytest.mark.parametrize("arguments", [["train", "--help"], ["--help"], ["info", str(demo.ASSETS / "body.npz")]])
def test_a_pipe_that_is_closed_ends_quietly(arguments, tmp_path):
    """`warpgarment train --help | head -5` would report a fault of the program, and keep a traceback. The other end of
    the pipe is closed before anything is written."""
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "warpgarment", *arguments]
    place = os.environ | {"TMPDIR": str(tmp_path)}
    ran = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, env=place, timeout=600)
    os.close(write)
    assert ran.returncode == 141
    assert ran.stderr == ""
    assert not list(tmp_path.glob("warpgarment-fault-*"))


def test_another_pipe_that_breaks_is_a_fault(monkeypatch, capfd):
    """A worker that died would end the program without a word, as if nobody read its output."""

    def broken(*_):
        raise BrokenPipeError

    monkeypatch.setattr(cli, "_options", broken)
    monkeypatch.setattr(cli, "kept_traceback", lambda error: "kept")
    assert cli.main(["doctor"]) == 1
    assert "fault of the program" in capfd.readouterr().err
