"""Makes training sequences in which a teacher goes on from the states of a network's own rollouts.

    python -m warpgarment.training.generate.on_policy --data DATA --out DATA --network fast
    warpgarment train --data DATA --init fast --unroll.steps 8 ...

A network that is trained on recordings sees only states near them. Its own states are others: a hem that lags, cloth
that is squeezed. What cloth does from there is a question to the physics, which answers here: the network rolls out a
training sequence, and from some of its frames a teacher simulates a few more, with the velocities of the rollout. One
new sequence holds all of these pieces (`training/data/pieces.py`): the last frames of the rollout, as history, and the
teacher's, as targets. Only the train split is read and written.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from warpgarment.errors import CheckpointError, MeshError, OutputError, UsageError
from warpgarment.io.disk.outputs import check_writable
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.material import Material
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence, list_sequences, write_sequence
from warpgarment.training.data.splits import evenly
from warpgarment.training.rollouts import predict
from warpgarment.training.teachers import Cloth, ClothScene, Teacher, TeacherError, make_teacher

LOST = 0.3
"""Mean distance from the recording [m] from which on the frames of a rollout are left out."""
_OF_FRAMES = ("garment_vertices", "body_vertices", "bone_transforms", "wind")


@dataclass(frozen=True)
class OnPolicyConfig:
    """Settings.

    Attributes:
        data: Folder of recorded sequences.
        out: Folder of the new sequences; it may be that of the recorded ones.
        network: Network that rolls out: a preset that ships, or a checkpoint.
        teacher: Teacher that goes on.
        pieces: Number of pieces of each sequence.
        frames: Number of frames that the teacher simulates in each.
        max_sequences: Number of recorded sequences, evenly spread over the list; None for all.
        seed: Seed of the places of pieces.
        device: Device of the network and the teacher.
    """

    data: Path
    out: Path
    network: str
    teacher: Literal["warp", "newton"] = "warp"
    pieces: int = 16
    frames: int = 8
    max_sequences: int | None = None
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        if self.pieces < 1 or self.frames < 1:
            raise UsageError(f"pieces {self.pieces} and frames {self.frames} must be at least 1")


def make_on_policy(config: OnPolicyConfig, teacher: Teacher | None = None) -> dict[str, str]:
    """Makes the sequences that do not exist yet.

    Args:
        config: Settings.
        teacher: The teacher; None for that of the settings.

    Returns:
        What was done with each recorded sequence: name -> text.

    Raises:
        UsageError: No sequence could be used; the message has the first reason.
        OutputError: The folder cannot be written to.
    """
    check_writable(config.out, folder=True)
    simulator = Simulator.from_pretrained(config.network, device=config.device)
    teacher = teacher or make_teacher(config.teacher, config.device)
    folders = [f for f in list_sequences(config.data, "train") if not f.name.endswith(_ENDING)]
    done: dict[str, str] = {}
    refused: dict[str, str] = {}
    for folder in tqdm(evenly(folders, config.max_sequences), desc="sequences", unit=""):
        target = Path(config.out) / f"{folder.name}{_ENDING}"
        if target.exists():
            done[folder.name] = "is there"
            continue
        try:
            sequence = Sequence.load(folder)
            arrays, manifest = on_policy(sequence, simulator, teacher, config)
            write_sequence(target, arrays, manifest | {"network": config.network})
            count = len(arrays["garment_vertices"]) // manifest["pieces"]["frames"]
            done[folder.name] = f"{count} pieces"
        except (MeshError, TeacherError) as error:
            refused[folder.name] = str(error)
            print(f"left out: {error}", file=sys.stderr, flush=True)
    if not done:
        reason = f", first: {next(iter(refused.values()))}" if refused else ": there are none for training"
        raise UsageError(f"{config.data}: none of {len(refused)} sequences could be used{reason}")
    return done | {name: f"left out: {why}" for name, why in refused.items()}


_ENDING = "_on_policy"


def on_policy(
    sequence: Sequence, simulator: Simulator, teacher: Teacher, config: OnPolicyConfig
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The pieces of one sequence, as arrays and a manifest for `write_sequence`.

    Args:
        sequence: A recorded sequence with one garment.
        simulator: Simulator with the network.
        teacher: The teacher.
        config: Number and length of pieces, and the seed.

    Raises:
        MeshError: The sequence has several garments, or is too short, or the rollout soon leaves the recording.
        TeacherError: The teacher cannot go on from given velocities, or failed in all pieces.
    """
    if len(sequence.layers) > 1:
        raise MeshError(f"{sequence.name}: {len(sequence.layers)} garments; a teacher goes on with one only.")
    known, body = simulator.network.config.history, sequence.body()
    states = rolled_out(sequence, simulator, body)
    places = np.arange(known - 1, len(states))
    places = places[places + config.frames < min(body.frames, len(sequence))]
    if not len(places):
        raise MeshError(
            f"{sequence.name}: {len(states)} frames of the rollout and {min(body.frames, len(sequence))} of the body "
            f"leave no place for {known} frames and {config.frames} more."
        )
    rng = np.random.default_rng([config.seed, int(sequence.manifest.get("number") or 0)])
    starts = sorted(int(rng.choice(part)) for part in np.array_split(places, min(config.pieces, len(places))))
    material = sequence.materials[0] or Material()
    scenes = [_scene(sequence, body, states, t, config.frames, material) for t in starts]
    shown = [[] for _ in starts]  # type: list[list[np.ndarray]]
    for frames in teacher.simulate_many(scenes):
        for piece, frame in zip(shown, frames, strict=True):
            if frame is not None:
                piece.append(frame)
    good = [k for k, piece in enumerate(shown) if np.isfinite(piece).all()]
    if not good:
        raise TeacherError(f"{sequence.name}: the teacher failed in all {len(starts)} pieces.")
    frames_of = [range(starts[k] - known + 1, starts[k] + config.frames + 1) for k in good]
    cloth = [
        np.concatenate([states[f.start : starts[k] + 1], shown[k][1:]]) for f, k in zip(frames_of, good, strict=True)
    ]
    flat = np.concatenate([np.asarray(f) for f in frames_of])
    whole = {name: array for name, array in sequence.arrays().items() if name != "garment_velocities"}
    arrays = {name: array[flat] if name in _OF_FRAMES else array for name, array in whole.items()}
    arrays["garment_vertices"] = np.concatenate(cloth).astype(np.float32)
    kept = ("number", "category", "garment", "garments", "motion", "body", "fps")
    manifest = {name: sequence.manifest[name] for name in kept if name in sequence.manifest} | {
        "split": "train",
        "status": "good",
        "frames": len(flat),
        "seed": config.seed,
        "pieces": {"frames": known + config.frames, "known": known},
        "from": sequence.name,
        "at": [starts[k] for k in good],
        "teacher": teacher.settings(),
    }
    return arrays, manifest


def rolled_out(sequence: Sequence, simulator: Simulator, body: BodyMotion) -> np.ndarray:
    """The recorded first frame and a cold rollout from there [m], float32 [T,V,3], up to where it gets lost."""
    steps = min(body.frames, len(sequence)) - 1
    moved = predict(simulator, sequence, 0, steps, cold=True, body=body)
    recorded = np.asarray(sequence.vertices[: steps + 1], np.float32)
    states = np.concatenate([recorded[:1], moved])
    lost = ~(np.linalg.norm(states - recorded, axis=-1).mean(axis=1) < LOST)  # also where it is NaN
    return states[: int(lost.argmax()) if lost.any() else len(states)]


def _scene(
    sequence: Sequence, body: BodyMotion, states: np.ndarray, at: int, frames: int, material: Material
) -> ClothScene:
    """The scene that goes on from a frame of the rollout, with the mean velocity of the frame before: in recordings
    that is nearer to the velocity at its end than differences of second order, since bodies move evenly in a frame."""
    garment = sequence.garment
    velocity = (states[at] - states[at - 1]) * np.float32(sequence.fps)
    cloth = Cloth(garment, _edge(garment.vertices, garment.faces), states[at], material, velocity)
    part = slice(at, at + frames + 1)
    wind = None if sequence.wind is None else sequence.wind[part]
    return ClothScene((cloth,), body.vertices[part], body.faces, fps=sequence.fps, wind=wind, settle=0)


def _edge(vertices: np.ndarray, faces: Iterable) -> float:
    """Mean length of the edges of faces at rest [m]."""
    corners = np.asarray(vertices)[np.asarray(faces)]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).mean())


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    import tyro

    program = "python -m warpgarment.training.generate.on_policy"
    config = tyro.cli(OnPolicyConfig, prog=program, args=arguments, description=__doc__)
    try:
        done = make_on_policy(config)
    except (UsageError, OutputError, TeacherError, CheckpointError, FileNotFoundError) as error:
        print(f"warpgarment: {error}", file=sys.stderr)
        return 2
    for name, what in done.items():
        print(f"{name}: {what}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
