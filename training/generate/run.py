"""`warpgarment generate`: simulated sequences, each a pure function of the set's options and its number.

    warpgarment generate --out DATA --motions CLIPS --workers 2               # the standard set
    warpgarment generate --out DATA --recipe layers --sequences 50            # outfits, materials, wind
    warpgarment generate --out DATA --first 17 --sequences 1 --attempt 0 --keep-rejected    # one attempt again

Sequences that exist are skipped, so an interrupted run continues where it stopped, and a worker that is killed loses
only the sequence it was making. A sequence that the quality gate rejects is drawn anew, up to `attempts` times; the
manifest keeps the parameters and the reason of every attempt.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.io.disk.outputs import check_space, check_writable
from warpgarment.objects.garment import Garment
from warpgarment.training.data.sequence import MANIFEST, write_sequence
from warpgarment.training.data.set_manifest import package_versions, write_set_manifest
from warpgarment.training.teachers import ClothScene, Moving, MovingTeacher, Teacher, TeacherError, make_teacher

from .placement import body_motion, clothed
from .quality import Limits, QualityGate
from .recipes import BLEND, FPS, GenerateConfig, Plan, plan_sequence

BYTES_OF_FACE, BYTES_OF_BODY = 3.2, 600.0  # about, of a frame: half a vertex in 6 bytes, and 31 bones


@dataclass
class Attempt:
    """One attempt at a sequence, with its inputs and results.

    Attributes:
        plan: Parameters of the sequence.
        scene: Scene for the teacher; None if the plan could not be carried out.
        reason: Reason for the rejection; None as long as the attempt is good.
        arrays: Arrays to store in addition to the garments' frames.
        gate: Quality gate that measures the frames.
        frames: Garment vertices of the good frames [m], float32 [V, 3] each.
        velocities: Velocities in these frames [m/s], float32 [V, 3] each; none if they are not recorded.
        garments: Garments at rest, innermost first.
        body_frames: Vertices of the body [m], float32 [T, U, 3].
        began: Clock at the start of the work [s].
    """

    plan: Plan
    scene: ClothScene | None = None
    reason: str | None = None
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    gate: QualityGate | None = None
    frames: list[np.ndarray] = field(default_factory=list)
    velocities: list[np.ndarray] = field(default_factory=list)
    garments: tuple[Garment, ...] = ()
    body_frames: np.ndarray | None = None
    began: float = field(default_factory=time.perf_counter)


def prepare(plan: Plan, config: GenerateConfig) -> Attempt:
    """Body, motion, garments, scene and gate of a plan; if one of them cannot be made, the attempt has the reason."""
    attempt = Attempt(plan)
    try:
        body, transforms, frames = body_motion(plan, config)
        garments, cloths = clothed(plan, body, transforms)
    except ValueError as error:  # the motion cannot be cleared, or a garment cannot be cut for this body
        attempt.reason = str(error)
        return attempt
    collider = body.collider_faces()
    faces = body.faces[collider]
    wind = plan.wind.velocities(len(frames), FPS) if plan.wind else None
    starts = np.cumsum([0, *(len(g.vertices) for g in garments)])
    attempt.scene = ClothScene(cloths, frames, faces, fps=FPS, wind=wind)
    attempt.garments, attempt.body_frames = garments, frames
    blown = float(np.linalg.norm(wind, axis=1).max()) / FPS if wind is not None else 0.0
    attempt.gate = QualityGate(garments, faces, air=blown)
    attempt.arrays = {
        "garment_rest_vertices": np.concatenate([g.vertices for g in garments]),
        "garment_faces": np.concatenate([g.faces + s for g, s in zip(garments, starts, strict=False)]),
        "pins": np.concatenate([g.pins + s for g, s in zip(garments, starts, strict=False)]),
        "garment_starts": starts,
        "body_rest_vertices": body.vertices,
        "body_faces": body.faces,
        "collider_faces": collider,
        "bone_indices": body.bone_indices,
        "bone_weights": body.bone_weights,
        "bone_transforms": transforms,
    }
    if wind is not None:
        attempt.arrays["wind"] = wind
    return attempt


def check_velocities(teacher: Teacher) -> MovingTeacher:
    """A teacher, if it knows velocities.

    Raises:
        TeacherError: It does not.
    """
    if not isinstance(teacher, MovingTeacher):
        raise TeacherError(f"{teacher.name} gives no velocities. Leave --velocities out, or choose --teacher newton.")
    return teacher


def simulate(attempts: list[Attempt], teacher: Teacher, *, velocities: bool = False) -> None:
    """Simulates attempts side by side until each is complete or rejected.

    Raises:
        TeacherError: Velocities are wanted and the teacher has none.
    """
    live = [a for a in attempts if a.reason is None]
    if not live:
        return
    scenes = [a.scene for a in live if a.scene is not None]  # of all live attempts, which were prepared without fault
    stream: Iterator[Sequence[Moving | np.ndarray | None]]
    if velocities:
        stream = check_velocities(teacher).simulate_moving(scenes)
    elif len(live) == 1:
        stream = ([vertices] for vertices in teacher.simulate(scenes[0]))
    else:
        stream = teacher.simulate_many(scenes)
    for frame, worlds in enumerate(stream):
        for attempt, shown in zip(live, worlds, strict=True):
            if shown is None or attempt.reason:
                continue
            vertices = shown.vertices if isinstance(shown, Moving) else shown
            assert attempt.gate is not None  # made with the scene, as the frames are
            assert attempt.body_frames is not None
            attempt.reason = attempt.gate.check(frame, vertices, attempt.body_frames[frame])
            if not attempt.reason:
                attempt.frames.append(vertices)
                if isinstance(shown, Moving):
                    attempt.velocities.append(shown.velocities)
        if all(a.reason for a in live):
            break


def manifest_of(attempt: Attempt, config: GenerateConfig, teacher: Teacher) -> dict[str, Any]:
    """The manifest of a simulated attempt; a late failure makes the sequence end before it."""
    plan, reason, kept = attempt.plan, attempt.reason, len(attempt.frames)
    cut_short = None
    if reason and kept > config.least_frames:
        cut_short, reason = reason, None
        kept -= 5  # the frames just before a failure are already bad
    patterns = plan.outfit.layers
    return {
        "number": plan.number,
        "attempt": plan.attempt,
        "recipe": plan.recipe,
        "seed": config.seed,
        "split": plan.split,
        "category": plan.category,
        "garment": plan.name if plan.cut is None else f"{plan.category}_cut_{plan.cut:02d}",
        "garments": [
            {"name": f"{pattern.category}_{plan.number:05d}", "category": pattern.category, "material": m.as_dict()}
            for pattern, m in zip(patterns, plan.materials, strict=True)
        ],
        "motion": plan.motion,
        "body": {"kind": plan.body} | plan.phenotype,
        "fps": FPS,
        "blend": BLEND,
        "parameters": asdict(plan) | {"teacher": teacher.settings(), "limits": asdict(Limits())},
        "status": "rejected" if reason else "good",
        "reason": reason,
        "cut_short": cut_short,
        "frames": kept,
        "figures": attempt.gate.figures(kept) if attempt.gate else {},
        "seconds": round(time.perf_counter() - attempt.began, 1),
    } | ({"velocities": True} if config.velocities else {})


def make_sequences(config: GenerateConfig, numbers: list[int]) -> list[dict[str, Any]]:
    """Makes sequences side by side, writes them and returns their manifests; rejected ones are drawn anew."""
    teacher = make_teacher(config.teacher, config.device)
    versions = package_versions()
    first = config.attempt or 0
    last = first if config.attempt is not None else config.attempts - 1
    tries: dict[int, list[dict[str, Any]]] = {n: [] for n in numbers}
    finished = []
    pending = list(numbers)
    for number in range(first, last + 1):
        attempts = [prepare(plan_sequence(config, n, number), config) for n in pending]
        simulate(attempts, teacher, velocities=config.velocities)
        pending = []
        for attempt in attempts:
            manifest = manifest_of(attempt, config, teacher) | {"versions": versions}
            plan = attempt.plan
            if manifest["status"] == "rejected" and number < last:
                tries[plan.number].append(manifest)
                pending.append(plan.number)
                continue
            manifest["rejected_attempts"] = tries[plan.number]
            write_sequence(config.out / plan.name, _arrays(attempt, manifest, config), manifest)
            finished.append(manifest)
        if not pending:
            break
    return finished


def _arrays(attempt: Attempt, manifest: dict[str, Any], config: GenerateConfig) -> dict[str, np.ndarray]:
    frames = manifest["frames"]
    if not frames or (manifest["status"] == "rejected" and not config.keep_rejected):
        return {}
    cut = {k: attempt.arrays[k][:frames] for k in ("bone_transforms", "wind") if k in attempt.arrays}
    moved = {"garment_vertices": np.stack(attempt.frames[:frames])}
    if attempt.velocities:
        moved["garment_velocities"] = np.stack(attempt.velocities[:frames])
    return attempt.arrays | cut | moved


def numbers_to_make(config: GenerateConfig) -> list[int]:
    """Numbers of this shard whose sequences do not exist yet, including failed ones."""
    index, count = map(int, config.shard.split("/"))
    done = {p.parent.name.split("_")[0] for p in config.out.glob(f"[0-9]*_*/{MANIFEST}")}
    numbers = range(config.first, config.first + config.sequences)
    return [n for n in numbers if n % count == index and f"{n:05d}" not in done]


def generate(config: GenerateConfig) -> Path:
    """Makes the sequences that do not exist yet; returns the folder of the data set.

    Raises:
        DatasetMismatch: The folder holds a set made with other options.
        TeacherError: Sequences failed; the message has their number and the reason.
        OutputError: The folder cannot be written to, or the disk has no room for the sequences.
        UsageError: There is no such device.
    """
    from tqdm import tqdm

    from warpgarment.cluster import on_cluster

    from .workers import spread

    config = replace(config, out=Path(config.out), motions=Path(config.motions) if config.motions else None)
    check_writable(config.out, folder=True)
    numbers, planned = numbers_to_make(config), range(config.first, config.first + config.sequences)
    bytes_of_face = BYTES_OF_FACE * (1 + config.velocities)
    check_space(config.out, len(numbers) * config.frames * (bytes_of_face * config.faces + BYTES_OF_BODY))
    if config.make_blender:
        from warpgarment.training.teachers.blender.environment import make_environment

        make_environment()
    teacher = make_teacher(config.teacher, "cpu" if config.ray else config.device)  # raises errors before any work
    if config.velocities:
        check_velocities(teacher)
    if config.bodies == "anny":
        from warpgarment.bodies.anny import anny_bodies

        anny_bodies()  # builds the cache once, before the workers start
    config.out.mkdir(parents=True, exist_ok=True)
    write_set_manifest(config.out, config.determining(), teacher.settings(), numbers=planned, command=config.command())
    batches = [numbers[i : i + config.worlds] for i in range(0, len(numbers), config.worlds)]
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # for the workers
    make = partial(make_sequences, config)
    gpus = float(config.device.startswith("cuda"))
    stream = on_cluster(make, batches, config.ray, gpus=gpus) if config.ray else spread(make, batches, config.workers)
    counts, frames, failures = {"good": 0, "rejected": 0, "failed": 0}, 0, []
    with tqdm(total=len(numbers), unit="seq") as bar:
        for done in stream:
            if done.error:
                counts["failed"] += len(done.item)
                failures.append(done)
                tqdm.write(f"{', '.join(map(str, done.item))}: failed: {done.error}")
            for manifest in done.result or []:
                counts[manifest["status"]] += 1
                frames += manifest["frames"] if manifest["status"] == "good" else 0
                tqdm.write(_line(manifest))
            bar.set_postfix(counts | {"frames": frames})
            bar.update(len(done.item))
    if failures:
        raise TeacherError(
            f"{counts['failed']} of {len(numbers)} sequences failed (first: number {failures[0].item[0]}, "
            f"{failures[0].error}). Run the same command again to make them."
        )
    return config.out


def _line(manifest: dict[str, Any]) -> str:
    text = f"{manifest['garment']} on {manifest['motion']}: {manifest['status']} {manifest['frames']} frames"
    if manifest["attempt"]:
        text += f", attempt {manifest['attempt'] + 1}"
    return text + (f" ({manifest['reason']})" if manifest["reason"] else "")
