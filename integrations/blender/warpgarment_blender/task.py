"""One simulation, in steps that take a moment each: read frames, wait for the subprocess, show the result."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from . import cache
from .scene import JobError, Reader

WORKER = Path(__file__).with_name("worker.py")
BUDGET = 0.05  # seconds that reading frames takes of each step
COUNT = re.compile(r"rollout:[^\r\n]*?(\d+)/(\d+) \[")


class Task:
    """Reads, simulates and shows; `step` is called until `finished`.

    Args:
        python: Path of a Python that has warpgarment.
        reader: What is simulated.
        garment: The garment's object.
        path: Where the mesh cache is written.
        options: Content of job.json.

    Attributes:
        words: What it is at, in a line.
        share: How much of all is done, 0 to 1.
        finished: Whether it has come to its end.
        warnings: What warpgarment has warned of.

    Raises:
        JobError: There is no such Python.
    """

    def __init__(self, python: str, reader: Reader, garment: Any, path: Path, options: dict[str, Any]) -> None:
        if not python:
            raise JobError("Name a Python that has warpgarment in the add-on's preferences.")
        if shutil.which(python) is None:
            raise JobError(f"There is no Python at {python}. Correct its path in the add-on's preferences.")
        self._python, self._reader, self._garment = python, reader, garment
        self._path, self._options = path, options
        self._folder: Path | None = Path(tempfile.mkdtemp(prefix="warpgarment_"))
        self._process: subprocess.Popen | None = None
        self.words, self.share, self.finished = "reading frames", 0.0, False
        self.warnings: list[str] = []

    def step(self) -> None:
        """Does a little; raises JobError where it cannot go on, after which it is over.

        The first frames are read in steps of `BUDGET` seconds; while the subprocess works, a step takes no time.
        """
        try:
            if self._process is None:
                self._read()
            elif self._process.poll() is None:
                self._watch()
            else:
                self._show(self._process.returncode)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Ends the subprocess if it runs, and removes its folder."""
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._folder, self.finished = None, True

    def _read(self) -> None:
        end = time.monotonic() + BUDGET
        more = self._reader.read()
        while more and time.monotonic() < end:
            more = self._reader.read()
        count = len(self._reader.frames)
        self.words, self.share = f"reading frame {self._reader.done} of {count}", 0.2 * self._reader.done / count
        if more:
            return
        assert self._folder is not None
        np.savez(self._folder / "job.npz", **self._reader.arrays())
        (self._folder / "job.json").write_text(json.dumps(self._options), encoding="utf-8")
        hidden = {"PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "PYTHONUSERBASE", "VIRTUAL_ENV"}  # of Blender's Python
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        with open(self._folder / "out.txt", "wb") as out, open(self._folder / "err.txt", "wb") as err:
            command = [self._python, str(WORKER), str(self._folder)]
            self._process = subprocess.Popen(
                command, cwd=self._folder, env=environment, stdin=subprocess.DEVNULL, stdout=out, stderr=err
            )
        self.words = "starting the simulation"

    def _text(self, name: str) -> str:
        assert self._folder is not None
        return (self._folder / name).read_text(encoding="utf-8", errors="replace")

    def _watch(self) -> None:
        found = COUNT.findall(self._text("err.txt"))
        if found:
            done, count = (int(number) for number in found[-1])
            self.words, self.share = f"frame {done} of {count}", 0.2 + 0.8 * done / max(count, 1)

    def _show(self, status: int) -> None:
        lines = self._text("out.txt").strip().splitlines()
        try:
            said = json.loads(lines[-1])
        except (IndexError, ValueError):
            said = {}
        if status or "warnings" not in said:
            last = (self._text("err.txt").strip().splitlines() or ["nothing was said"])[-1]
            if "No module named 'warpgarment'" in said.get("error", last):
                raise JobError(f"{self._python} has no warpgarment. Install it there, or name another Python.")
            raise JobError(said.get("error", f"the simulation ended with status {status}: {last}"))
        self.warnings = list(said["warnings"])
        assert self._folder is not None
        with np.load(self._folder / "result.npz", allow_pickle=False) as data:
            vertices = data["vertices"]
        first = self._reader.frames[0]
        cache.write(self._path, self._reader.local(vertices), first)
        cache.attach(self._garment, self._path, first)
        self.words, self.share = f"{len(vertices)} frames in {self._path.name}", 1.0
        self.close()
