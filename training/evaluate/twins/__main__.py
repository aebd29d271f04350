"""Makes twins of test sequences: the same scenes simulated again from starts with a little noise.

    python -m warpgarment.training.evaluate.twins --data DATA                     # kept in DATA/twins
    python -m warpgarment.training.evaluate.twins --data DATA --motions CLIPS     # a set made with clips

The distance between a recording and its twin is the floor of the error that `warpgarment evaluate` reports. A scene is
made from the manifest of its sequence; the teacher must have the settings and versions recorded there. First the scene
is simulated without noise, up to the first recorded frames, and must be where it was recorded. Twins that exist are
kept, so that an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from warpgarment.errors import MeshError
from warpgarment.io.disk.outputs import check_writable
from warpgarment.kernels.sdf.query import signed_distance
from warpgarment.objects.body import BodyMotion
from warpgarment.training.data.sequence import Sequence, list_sequences
from warpgarment.training.data.splits import evenly
from warpgarment.training.teachers import ClothScene, Teacher, TeacherError, make_teacher

from .scene import TwinError, check_teacher, noisy, scene_of
from .stored import FOLDER, read_twin, write_twin


@dataclass(frozen=True)
class TwinsConfig:
    """Settings of twins.

    Attributes:
        data: Folder of sequences.
        out: Folder of the twins; None for DATA/twins.
        split: Split whose sequences get twins.
        motions: Folder of the clips with which the set was made; None if all motions are procedural.
        noise: Standard deviation of the noise on each coordinate of the free vertices at the start [mm].
        seed: Seed of the noise.
        check: Number of frames that are simulated without noise first, and compared with the recording.
        tolerance: Largest mean distance of these frames from the recording [mm].
        max_sequences: Number of sequences, evenly spread over the list; None for all.
        device: Warp device of teachers that run in this process.
    """

    data: Path
    out: Path | None = None
    split: Literal["train", "validation", "test"] = "test"
    motions: Path | None = None
    noise: float = 0.1
    seed: int = 0
    check: int = 1
    tolerance: float = 0.05
    max_sequences: int | None = None
    device: str = "cpu"


def make_twins(config: TwinsConfig, *, make: Callable[[str, str | None], Teacher] = make_teacher) -> dict[str, str]:
    """Makes the twins that do not exist.

    Args:
        config: Settings.
        make: Function that makes a teacher by name and device.

    Returns:
        What was done with each sequence: name -> text.

    Raises:
        TwinError: Some sequences have no twin now, or existing ones have other noise; the message names the first.
        OutputError: The folder cannot be written to.
    """
    if not config.noise > 0 or config.check < 0:
        raise TwinError(f"noise {config.noise} must be positive and check {config.check} not negative.")
    out = config.out or config.data / FOLDER
    check_writable(out, folder=True)
    folders = evenly(list_sequences(config.data, config.split), config.max_sequences)
    done: dict[str, str] = {}
    refused: dict[str, str] = {}
    teachers: dict[str, Teacher] = {}
    for folder in folders:
        path = out / f"{folder.name}.json"
        try:
            sequence = Sequence.load(folder)
            if _exists(path, sequence, config):
                done[folder.name] = "is there"
            else:
                name = str(sequence.manifest.get("parameters", {}).get("teacher", {}).get("teacher", ""))
                if not name:
                    raise TwinError(f"{folder.name}: its manifest names no teacher, so that it cannot be made again.")
                teacher = teachers.setdefault(name, make(name, config.device))
                done[folder.name] = _make(path, sequence, teacher, config)
            print(f"{folder.name}: {done[folder.name]}", flush=True)
        except (TwinError, TeacherError, MeshError) as error:
            refused[folder.name] = str(error)
            print(f"no twin of {error}", file=sys.stderr, flush=True)
    if refused:
        raise TwinError(
            f"{len(refused)} of {len(folders)} sequences have no twin, first: {next(iter(refused.values()))}"
        )
    return done


def simulated(teacher: Teacher, scene: ClothScene, frames: int) -> np.ndarray:
    """The first frames of a scene [m], float32 [T,V,3]."""
    stream = teacher.simulate(scene)
    return np.stack(list(itertools.islice(stream, frames)))


def _exists(path: Path, sequence: Sequence, config: TwinsConfig) -> bool:
    try:
        about = read_twin(path, sequence).about
    except (FileNotFoundError, TwinError):
        return False  # a twin that cannot be read is made anew
    for name, value in (("noise_mm", config.noise), ("seed", config.seed)):
        if about.get(name) != value:
            raise TwinError(
                f"{sequence.name}: its twin was made with {name} {about.get(name)}, not {value}. Choose another folder."
            )
    return True


def _make(path: Path, sequence: Sequence, teacher: Teacher, config: TwinsConfig) -> str:
    check_teacher(sequence, teacher)
    scene = scene_of(sequence, config.motions)
    recorded, replay = np.asarray(sequence.vertices), 0.0
    count = min(config.check, len(recorded))
    if count:
        again = simulated(teacher, scene, count)
        replay = 1e3 * float(np.linalg.norm(again.astype(np.float64) - recorded[:count], axis=-1).mean(axis=1).max())
        if not replay <= config.tolerance:
            raise TwinError(
                f"{sequence.name}: simulated again without noise it is {replay:.3g} mm away from the recording, more "
                f"than {config.tolerance:g}. The teacher's code has changed since, or another machine made the set "
                "(--tolerance)."
            )
    rng = np.random.default_rng([config.seed, int(sequence.manifest.get("number", 0))])
    twin = simulated(teacher, noisy(scene, 1e-3 * config.noise, rng), len(recorded))
    if not np.isfinite(twin).all():
        raise TwinError(f"{sequence.name}: the twin's simulation failed; its positions are not finite.")
    settings = json.loads(json.dumps(teacher.settings()))
    write_twin(path, sequence, twin, settings, noise=config.noise, seed=config.seed, replay=replay)
    distance = 100 * np.linalg.norm(twin.astype(np.float64) - recorded, axis=-1).mean(axis=1)
    slope = floor_slope(recorded, twin, sequence.body())
    return (
        f"{distance.mean():.3f} cm from its twin, {distance[-30:].mean():.3f} in the last 30 frames; "
        f"{slope:.3f} of the distance to the body (--unroll.floor)"
    )


def floor_slope(recorded: np.ndarray, twin: np.ndarray, body: BodyMotion) -> float:
    """How far the twin is from the recording for each metre between cloth and body, without unit: the line through the
    origin with the least squares, over the second half, every fifth frame."""
    products, squares = 0.0, 0.0
    faces = torch.from_numpy(np.asarray(body.faces, np.int32))
    for t in range(len(recorded) // 2, min(len(recorded), body.frames), 5):
        points, solid = (torch.tensor(np.asarray(x, np.float32)) for x in (recorded[t], body.vertices[t]))
        outside = signed_distance(points, solid, faces)[0].double().clamp(min=0.0).numpy()
        products += float(outside @ np.linalg.norm(twin[t].astype(np.float64) - recorded[t], axis=1))
        squares += float(outside @ outside)
    return products / squares if squares else 0.0


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    import tyro

    program = "python -m warpgarment.training.evaluate.twins"
    config = tyro.cli(TwinsConfig, prog=program, args=arguments, description=__doc__)
    try:
        make_twins(config)
    except TwinError as error:
        print(f"warpgarment: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
