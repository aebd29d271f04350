"""The log of a training run: `log.jsonl`, printed lines, and TensorBoard events if TensorBoard is installed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from tqdm import tqdm

from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.plain import parsed_json, read_plain

LOG_LARGEST = 1 << 30  # bytes of a log that is read


class RunLog:
    """Writes entries of a step, seconds and values.

    Args:
        out: Folder of the run; None writes nothing.
        resumed: Step from which the run continues; later entries, of a run that was killed, are removed. None for a new
            run, whose log starts empty.
    """

    def __init__(self, out: Path | None, resumed: int | None = None) -> None:
        self.path = None if out is None else out / "log.jsonl"
        self.writer = None
        if self.path is None:
            return
        kept = [] if resumed is None else [line for line in _lines(self.path) if _step(line) <= resumed]
        with atomic_file(self.path) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in kept), "utf-8")
        self.writer = _tensorboard(self.path.parent, resumed)

    def write(self, step: int, seconds: float, values: dict[str, Any], *, aloud: bool = False) -> None:
        """Adds an entry; with `aloud` it is also printed."""
        if self.path is None:
            return
        entry = {"step": step, "seconds": round(seconds, 1), **values}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({k: json_number(v) for k, v in entry.items()}) + "\n")
        if aloud:
            say("  ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in entry.items()))
        if self.writer:
            for name, value in values.items():
                if isinstance(value, float):
                    self.writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Closes the log."""
        if self.writer:
            self.writer.close()


def say(text: str) -> None:
    """Prints a line above the progress bar."""
    tqdm.write(text)


def json_number(value: Any) -> Any:
    """A value for JSON, with NaN and infinity as text, since JSON has neither."""
    return value if not isinstance(value, float) or math.isfinite(value) else str(value)


def _lines(path: Path) -> list[str]:
    return read_plain(path, LOG_LARGEST).decode("utf-8", errors="replace").splitlines() if path.exists() else []


def _step(line: str) -> float:
    """The step of an entry; infinity for a line that is not an entry, such as an incomplete one."""
    try:
        return float(parsed_json("", line)["step"])
    except (ValueError, KeyError, TypeError, OverflowError):
        return math.inf


def _tensorboard(out: Path, resumed: int | None) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(out / "events"), purge_step=None if resumed is None else resumed + 1)
