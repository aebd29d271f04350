"""The BVH reader."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from warpgarment.errors import MeshError

from .clip import Clip, checked_finite, frame_rate

_Z_UP_TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def read_bvh(path: str | Path) -> Clip:
    """Reads a BVH file; a file with Z up (the mean head is above the hips along Z) is turned to Y up.

    Raises:
        MeshError: The file is not BVH, its numbers do not match its hierarchy, or some are NaN or infinite.
    """
    path = Path(path)
    tokens = path.read_text(errors="replace").split()
    if not tokens or tokens[0] != "HIERARCHY" or "MOTION" not in tokens:
        raise MeshError(f"{path.name} is not a BVH file: it has no HIERARCHY and MOTION sections.")
    motion = tokens.index("MOTION")
    try:
        names, parents, offsets, channels = _hierarchy(tokens[1:motion])
    except (ValueError, IndexError) as error:
        raise MeshError(f"{path.name}: the HIERARCHY section is incomplete or holds a word for a number.") from error
    try:
        frames, frame_time = int(tokens[motion + 2]), float(tokens[motion + 5])
        values = np.array(tokens[motion + 6 :], dtype=np.float64)
    except (ValueError, IndexError) as error:
        raise MeshError(f"{path.name}: the MOTION section holds something that is not a number.") from error
    width = sum(map(len, channels))
    if len(values) != frames * width or frames == 0 or frame_time <= 0:
        raise MeshError(f"{path.name}: {frames:,} frames of {width} channels announced, {len(values):,} numbers found.")
    checked_finite(values.reshape(frames, width), path.name)
    rotations, positions = _forward(parents, offsets, channels, values.reshape(frames, width))
    head = next((i for i, n in enumerate(names) if n.lower() == "head"), len(names) - 1)
    up = int(np.abs((positions[:, head] - positions[:, 0]).mean(0)).argmax())
    turn = _Z_UP_TO_Y_UP if up == 2 else np.eye(3)
    return Clip(
        names=tuple(names),
        offsets=offsets @ turn.T,
        rotations=turn @ rotations @ turn.T,
        root=positions[:, 0] @ turn.T,
        fps=frame_rate(1.0 / frame_time, path.name),
    )


def bvh_length(path: str | Path) -> tuple[int, float]:
    """Number of frames and frames per second of a BVH file, from its header.

    Raises:
        MeshError: The file has no such header.
    """
    path = Path(path)
    frames = None
    with path.open(errors="replace") as lines:
        for line in lines:
            if match := re.match(r"\s*Frames:\s*(\d+)", line):
                frames = int(match[1])
            elif match := re.match(r"\s*Frame Time:\s*([\d.eE+-]+)", line):
                if frames and float(match[1]) > 0:
                    return frames, frame_rate(1.0 / float(match[1]), path.name)
                break
    raise MeshError(f"{path.name} is not a BVH file: it has no header with Frames and Frame Time.")


def _hierarchy(tokens: list[str]) -> tuple[list[str], list[int], np.ndarray, list[list[str]]]:
    names: list[str] = []
    parents: list[int] = []
    offsets: list[list[float]] = []
    channels: list[list[str]] = []
    stack: list[int] = []
    current, i = -1, 0
    while i < len(tokens):
        word = tokens[i]
        if word in ("ROOT", "JOINT"):
            names.append(tokens[i + 1])
            parents.append(stack[-1] if stack else -1)
            offsets.append([0.0, 0.0, 0.0])
            channels.append([])
            current = len(names) - 1
            i += 2
        elif word == "End":
            current = -2  # an end site has an offset but is no joint
            i += 2
        elif word == "{":
            stack.append(current)
            i += 1
        elif word == "}":
            stack.pop()
            i += 1
        elif word == "OFFSET":
            if stack[-1] >= 0:
                offsets[stack[-1]] = [float(v) for v in tokens[i + 1 : i + 4]]
            i += 4
        elif word == "CHANNELS":
            count = int(tokens[i + 1])
            channels[stack[-1]] = tokens[i + 2 : i + 2 + count]
            i += 2 + count
        else:
            i += 1
    return names, parents, np.array(offsets), channels


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
