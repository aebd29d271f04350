"""What is kept of a twin: the figures of every frame, in one small JSON file for each sequence.

A file `twins/SEQUENCE.json` holds the figures of `shape` of every recorded frame: differences between twin and
recording [cm] and looks of the twin. It also has the bias over all frames from frame 1 and from frame 10 on, which are
those that cold and warm rollouts predict; the teacher's settings; the versions of packages; the noise and its seed; and
checksums of the recording and of the figures. A sequence of 180 frames takes some 25 kB.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.training.data.schema import is_finite
from warpgarment.training.data.sequence import Sequence
from warpgarment.training.data.set_manifest import package_versions, read_checked

from ..shape import DIFFERENCE, LOOKS, WAVELENGTH, WINDOW, Shape
from .scene import TwinError

FORMAT = 1
FOLDER = "twins"  # beside the sequences of a set
MEASURES = {"wavelength_m": WAVELENGTH, "window_s": WINDOW}
_ABOUT: tuple[str, ...] = ("noise_mm", "seed", "replay_mm", "teacher", "versions")
_DIGITS = 5


@dataclass(frozen=True)
class Twin:
    """A twin as it was read.

    Attributes:
        about: Noise [mm], seed, settings of the teacher, versions.
        figures: The figures `DIFFERENCE` [cm] and `LOOKS` of every frame, float64 [T] each.
        bias: First frame -> bias over this frame and all later ones [cm].
    """

    about: Mapping[str, Any]
    figures: dict[str, np.ndarray]
    bias: dict[int, float]


def shape_of(sequence: Sequence) -> Shape:
    """The measures of a sequence."""
    return Shape(sequence.garment, [layer.vertices for layer in sequence.layers], sequence.fps)


def write_twin(
    path: Path,
    sequence: Sequence,
    twin: np.ndarray,
    teacher: Mapping[str, Any],
    *,
    noise: float,
    seed: int,
    replay: float,
) -> None:
    """Measures a twin and writes its file, completely or not at all.

    Args:
        path: File to write.
        sequence: The sequence.
        twin: Positions of the twin in every recorded frame [m], [T,V,3].
        teacher: Settings of the teacher.
        noise: Standard deviation of each start coordinate [mm].
        seed: Seed of the noise.
        replay: Distance of the scene made again without noise from the recording [mm].
    """
    recorded, shape = np.asarray(sequence.vertices), shape_of(sequence)
    figures = shape.differences(twin, recorded) | shape.looks(twin)
    content = {
        "format": FORMAT,
        "sequence": sequence.name,
        "recording": recording_of(sequence),
        "frames": len(twin),
        "noise_mm": noise,
        "seed": seed,
        "replay_mm": round(replay, 6),
        "teacher": dict(teacher),
        "versions": package_versions(),
        "measures": MEASURES,
        "figures": {name: [_short(value) for value in values] for name, values in figures.items()},
        "bias": {str(k): _short(shape.bias(twin[k:], recorded[k:])) for k in (1, 10) if k < len(twin)},
    }
    content["checksum"] = _checksum(content)
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(content), "utf-8")


def read_twin(path: Path, sequence: Sequence) -> Twin:
    """Reads the twin of a sequence.

    Raises:
        TwinError: The file is damaged, was measured by other measures, or is that of another recording.
        FileNotFoundError: There is no such file.
    """
    if not path.exists():
        raise FileNotFoundError(f"{sequence.name} has no twin")
    again = f"Remove {path.name} from {path.parent.name} and make the twin again."
    try:
        content = read_checked(path, None)
    except MeshError as error:
        raise TwinError(f"{sequence.name}: {error} {again}") from None
    if content.get("checksum") != _checksum(content):
        raise TwinError(f"{sequence.name}: its twin does not have its checksum. {again}")
    if content.get("format") != FORMAT or content.get("measures") != MEASURES:
        raise TwinError(f"{sequence.name}: its twin was measured otherwise. {again}")
    if content.get("recording") != recording_of(sequence) or content.get("frames") != len(sequence):
        raise TwinError(f"{sequence.name}: its twin is that of another recording. {again}")
    figures, bias = content.get("figures"), content.get("bias")
    if not isinstance(figures, dict) or not isinstance(bias, dict) or set(figures) != {*DIFFERENCE, *LOOKS}:
        raise TwinError(f"{sequence.name}: its twin lacks figures. {again}")
    arrays = {name: np.array([math.nan if v is None else v for v in values]) for name, values in figures.items()}
    if any(array.shape != (len(sequence),) or array.dtype.kind != "f" for array in arrays.values()):
        raise TwinError(f"{sequence.name}: the figures of its twin are not numbers of {len(sequence)} frames. {again}")
    about = {key: content.get(key) for key in _ABOUT}
    return Twin(about, arrays, {int(k): float(v) for k, v in bias.items() if k.isdigit() and is_finite(v)})


def recording_of(sequence: Sequence) -> str:
    """Checksum of the recorded positions."""
    positions = np.ascontiguousarray(sequence.vertices, np.float32)
    return hashlib.sha256(positions.tobytes()).hexdigest()


def _checksum(content: Mapping[str, Any]) -> str:
    rest = {key: value for key, value in content.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _short(value: float) -> float | None:
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None
