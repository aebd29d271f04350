"""Pictures into ffmpeg, whose failures are errors: its exit status counts, and what it says is passed on."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import numpy as np

from warpgarment.errors import OutputError


class Encoder:
    """An ffmpeg that makes an H.264 film, as browsers play it, of the pictures it is sent.

    Args:
        program: ffmpeg.
        file: The film.
        output: What the film is called in errors.
        size: Width and height in pixels, even.
        fps: Frames per second.

    Raises:
        OutputError: ffmpeg cannot be started.
    """

    def __init__(self, program: str, file: Path, output: Path, size: tuple[int, int], fps: float) -> None:
        self._file, self._output = file, output
        self._said = tempfile.TemporaryFile()
        width, height = size
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6f}", "-i", "-"]
        film = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-preset", "veryfast"]
        command = [program, "-y", "-v", "warning", *source, *film, "-movflags", "+faststart", str(file.absolute())]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._said
            )
        except OSError as error:
            self._said.close()
            raise OutputError(f"{output}: ffmpeg ({program}) cannot be started: {error.strerror}.") from error

    def send(self, image: np.ndarray) -> None:
        """Hands a picture over, uint8 [H, W, 3].

        Raises:
            OutputError: ffmpeg has ended.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(image.tobytes())
        except OSError as error:
            self.abandon(kill=False)
            raise self._failure() from error

    def finish(self) -> None:
        """Waits until the film is complete.

        Raises:
            OutputError: ffmpeg failed, or left no film.
        """
        try:
            self._process.communicate()
            if self._process.returncode or not self._file.exists() or not self._file.stat().st_size:
                raise self._failure()
        finally:
            self._said.close()

    def abandon(self, kill: bool = True) -> None:
        """Ends ffmpeg, without a film."""
        if kill and self._process.poll() is None:
            self._process.kill()
        if self._process.stdin is not None:
            try:
                self._process.stdin.close()
            except OSError:
                pass  # what was on its way to a process that has ended
        self._process.wait()

    def _failure(self) -> OutputError:
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        reason = lines[-1] if lines else "it left no film"
        return OutputError(f"{self._output}: ffmpeg ended with status {self._process.returncode}: {reason}")
