"""The BVH reader."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import open_plain

from .clip import Clip, checked_finite, frame_rate

_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


LARGEST_FILE = 256 << 20  # bytes
MOST_JOINTS = 4_096
LARGEST = 1e6  # of an offset, a position or an angle, in the file's units
_CHANNEL = re.compile(r"[XYZ](position|rotation)")


def read_bvh(path: str | Path, up: str | None = None) -> Clip:
    """Reads a BVH file; one with Z up is turned to Y up.

    Args:
        path: The file.
        up: Axis that points up in it, "y" or "z". None: Z where the mean head is above the hips along Z, otherwise Y.

    Raises:
        MeshError: The file is not BVH, its numbers do not match its hierarchy, some are NaN, infinite or beyond
            `LARGEST`, it is larger than `LARGEST_FILE`, or has more than `MOST_JOINTS` joints; the line is named.
    """
    path = Path(path)
    with open_plain(path, LARGEST_FILE) as file:
        lines = file.read().decode(errors="replace").splitlines()
    words = [line.split() for line in lines]
    first = next((line for line in words if line), [])
    motion = next(((n, line.index("MOTION")) for n, line in enumerate(words) if "MOTION" in line), None)
    if first[:1] != ["HIERARCHY"] or motion is None:
        raise MeshError(f"{path.name} is not a BVH file: it has no HIERARCHY and MOTION sections.")
    before = [*words[: motion[0]], words[motion[0]][: motion[1]]]
    tokens = [(word, n) for n, line in enumerate(before, 1) for word in line]
    names, parents, offsets, channels = _Hierarchy(path.name, tokens[1:]).read()
    frames, frame_time, begin = _header(path.name, words, motion)
    values = _numbers(path.name, words, begin)
    width = sum(map(len, channels))
    if width == 0:
        raise MeshError(f"{path.name}: no joint has a channel, so that nothing moves. Write the file again.")
    if len(values) != frames * width:
        raise MeshError(f"{path.name}: {frames:,} frames of {width} channels announced, {len(values):,} numbers found.")
    checked_finite(values.reshape(frames, width), path.name)
    rotations, positions = _forward(parents, offsets, channels, values.reshape(frames, width))
    head = next((i for i, n in enumerate(names) if n.lower() == "head"), len(names) - 1)
    tallest = int(np.abs((positions[:, head] - positions[:, 0]).mean(0)).argmax())
    up = up or ("z" if tallest == 2 else "y")
    turn = _Z_UP_TO_Y_UP if up == "z" else np.eye(3)
    return Clip(
        names=tuple(names),
        offsets=offsets @ turn.T,
        rotations=turn @ rotations @ turn.T,
        root=positions[:, 0] @ turn.T,
        fps=frame_rate(1.0 / frame_time, path.name),
        up=up,
    )


def bvh_length(path: str | Path) -> tuple[int, float]:
    """Number of frames and frames per second of a BVH file, from its header.

    Raises:
        MeshError: The file has no such header.
    """
    path = Path(path)
    with open_plain(path, LARGEST_FILE) as file:
        words = [line.decode(errors="replace").split() for line in itertools.takewhile(_before_numbers(), file)]
    motion = next(((n, line.index("MOTION")) for n, line in enumerate(words) if "MOTION" in line), None)
    if motion is None:
        raise MeshError(f"{path.name} is not a BVH file: it has no header with Frames and Frame Time.")
    frames, frame_time, _ = _header(path.name, words, motion)
    return frames, frame_rate(1.0 / frame_time, path.name)


def _before_numbers() -> Callable[[bytes], bool]:
    """Tells of the lines of a file, one after the other, whether the frame time is still to come or is this one."""
    passed = False

    def before(line: bytes) -> bool:
        nonlocal passed
        was, passed = passed, passed or b"Frame Time" in line
        return not was

    return before


def _header(file: str, words: Sequence[Sequence[str]], motion: tuple[int, int]) -> tuple[int, float, tuple[int, int]]:
    """Number of frames, seconds of one, and the place behind them: a line, counted from 0, and a word in it.

    Args:
        file: Name of the file, for messages.
        words: Words of every line.
        motion: Place of the word MOTION.
    """
    places = ((n, i) for n in range(motion[0], len(words)) for i in range(len(words[n])) if (n, i) > motion)
    head = list(itertools.islice(places, 5))
    found = [words[n][i] for n, i in head]
    if len(found) < 5:
        raise MeshError(f"{file} is not a BVH file: it has no header with Frames and Frame Time.")
    if (found[0], *found[2:4]) != ("Frames:", "Frame", "Time:"):
        text = " ".join(found)[:60]
        raise MeshError(f"{file}, line {head[0][0] + 1}: {text!r} is not a number of Frames: and a Frame Time:.")
    frames, frame_time = map(_positive, (found[1], found[4]))
    for value, place, name in ((frames, 1, "Frames"), (frame_time, 4, "Frame Time")):
        if not 0 < value < 1e9 or (name == "Frames" and value != int(value)):
            raise MeshError(
                f"{file}, line {head[place][0] + 1}: {found[place][:40]!r} is no {name}: not above 0 and below 1e9."
            )
    return int(frames), frame_time, (head[4][0], head[4][1] + 1)


def _positive(word: str) -> float:
    try:
        return float(word) if len(word) < 40 else math.nan
    except ValueError:
        return math.nan


def _numbers(file: str, words: Sequence[Sequence[str]], start: tuple[int, int]) -> np.ndarray:
    """All numbers of the motion, in the order of the file; those that are not finite too."""
    rows = []
    for n in range(start[0], len(words)):
        try:
            row = np.array(words[n][start[1] if n == start[0] else 0 :], dtype=np.float64)
        except ValueError:
            raise MeshError(f"{file}, line {n + 1}: the MOTION section holds something that is not a number.") from None
        if (np.abs(row[np.isfinite(row)]) > LARGEST).any():
            raise MeshError(f"{file}, line {n + 1}: a number beyond {LARGEST:,.0f}. Repair what wrote it.")
        rows.append(row)
    return np.concatenate(rows) if rows else np.zeros(0)


class _Hierarchy:
    """Reads the tokens of a HIERARCHY section, each with the number of its line.

    Args:
        file: Name of the file, for messages.
        tokens: Words and the numbers of their lines.
    """

    def __init__(self, file: str, tokens: Sequence[tuple[str, int]]):
        self._file, self._tokens, self._next = file, tokens, 0

    def read(self) -> tuple[list[str], list[int], np.ndarray, list[list[str]]]:
        """Names, parents, offsets [J, 3] and channels of the joints.

        Raises:
            MeshError: The section is not a tree of joints, each with three numbers for its offset and known channels.
        """
        names: list[str] = []
        parents: list[int] = []
        offsets: list[list[float]] = []
        channels: list[list[str]] = []
        stack: list[int] = []
        current = -1
        while self._next < len(self._tokens):
            word = self._take()
            if word in ("ROOT", "JOINT"):
                if (word == "ROOT") == bool(names):
                    raise self._fault("a file has one ROOT, and every JOINT lies in it")
                if len(names) == MOST_JOINTS:
                    raise self._fault(f"more than {MOST_JOINTS:,} joints")
                names.append(self._take())
                while self._peek() not in ("{", ""):
                    names[-1] += f" {self._take()}"
                parents.append(stack[-1] if stack else -1)
                offsets.append([0.0, 0.0, 0.0])
                channels.append([])
                current = len(names) - 1
            elif word == "End":
                current = -2  # an end site has an offset but is no joint
                while self._peek() not in ("{", ""):
                    self._take()
            elif word == "{":
                stack.append(current)
            elif word == "}" and stack:
                stack.pop()
            elif word == "OFFSET" and stack:
                offset = [self._number() for _ in range(3)]
                if stack[-1] >= 0:
                    offsets[stack[-1]] = offset
            elif word == "CHANNELS" and stack and stack[-1] >= 0:
                channels[stack[-1]] = self._channels()
            else:
                raise self._fault(f"{word[:40]!r} is not expected here")
        if stack or not names:
            raise self._fault("the HIERARCHY section is incomplete")
        return names, parents, np.array(offsets), channels

    def _channels(self) -> list[str]:
        count = self._number()
        if count not in range(7):
            raise self._fault(f"a joint has 0 to 6 channels, not {count:g}")
        found = [self._take() for _ in range(int(count))]
        for name in found:
            if not _CHANNEL.fullmatch(name) or found.count(name) > 1:
                raise self._fault(f"channels are three positions and three rotations, each once, got {name[:40]!r}")
        return found

    def _number(self) -> float:
        word = self._take()
        try:
            value = float(word)
        except ValueError:
            raise self._fault(
                f"{word[:40]!r} is no number: the HIERARCHY section is incomplete or holds a word for it"
            ) from None
        if not abs(value) <= LARGEST:
            raise self._fault(f"{word[:40]} is not a finite number of at most {LARGEST:,.0f}")
        return value

    def _peek(self) -> str:
        return self._tokens[self._next][0] if self._next < len(self._tokens) else ""

    def _take(self) -> str:
        self._next += 1
        if self._next > len(self._tokens):
            raise self._fault("the HIERARCHY section is incomplete")
        return self._tokens[self._next - 1][0]

    def _fault(self, what: str) -> MeshError:
        known = self._tokens[min(self._next, len(self._tokens)) - 1][1] if self._tokens else 1
        return MeshError(f"{self._file}, line {known}: {what}. Repair it or leave the clip out.")


def _forward(
    parents: list[int], offsets: np.ndarray, channels: list[list[str]], values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """World rotations [T, J, 3, 3] and positions [T, J, 3] by forward kinematics."""
    frames, joints = len(values), len(parents)
    rotations, positions = np.empty((frames, joints, 3, 3)), np.empty((frames, joints, 3))
    column = 0
    for j, parent in enumerate(parents):
        own = values[:, column : column + len(channels[j])]
        column += len(channels[j])
        local = np.tile(offsets[j], (frames, 1))
        axes, angles = "", []
        for channel, value in zip(channels[j], own.T, strict=True):
            if channel.endswith("position"):
                local[:, "XYZ".index(channel[0])] = value
            else:
                axes += channel[0]
                angles.append(value)
        turn = Rotation.from_euler(axes, np.stack(angles, 1), degrees=True).as_matrix() if axes else np.eye(3)[None]
        if parent < 0:
            rotations[:, j], positions[:, j] = turn, local
        else:
            rotations[:, j] = rotations[:, parent] @ turn
            positions[:, j] = positions[:, parent] + np.einsum("tij,tj->ti", rotations[:, parent], local)
    return rotations, positions
