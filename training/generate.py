"""`warpgarment generate`: simulated sequences, each a pure function of its number and the set's seed.

    warpgarment generate --out DATA --sequences 72 --workers 2 --motions CLIPS

Sequences that exist are skipped, so an interrupted run continues where it stopped; a worker that is killed loses the
sequence it was on. What the quality gate rejects leaves a manifest with its parameters and the reason.
"""

from __future__ import annotations

import importlib.metadata
import multiprocessing
import os
import re
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from warpgarment.garment import Garment

from .dataset import MANIFEST, write_sequence
from .garments import CATEGORIES, Pattern, make_garment, sampled_pattern
from .motions import read_bvh, retarget
from .procedural import KINDS, procedural
from .quality import Limits, QualityGate
from .skeleton import PoseSequence, arms_abducted, blended_in, facing_forward, mirrored, posed
from .teacher import ClothSettings, simulate

FPS = 30.0
BLEND = 30


@dataclass(frozen=True)
class GenerateConfig:
    """Options of `warpgarment generate`.

    Attributes:
        out: Folder of the data set.
        sequences: How many to make.
        first: Number of the first one.
        frames: Frames of motion per sequence, after 30 that blend in from the rest pose.
        faces: Faces of a T-shirt; other categories scale with their area.
        categories: Garments to make, in turn.
        motions: Folder of BVH clips; without one, motions are procedural.
        procedural_share: Share of procedural motions among the training sequences where there are clips.
        seed: Of the whole set.
        workers: Processes.
        device: Warp device of the teacher.
        least_frames: A sequence that fails later than this is kept up to the failure.
    """

    out: Path
    sequences: int = 72
    first: int = 0
    frames: int = 180
    faces: int = 1200
    categories: tuple[str, ...] = ("tshirt", "dress", "skirt", "trousers", "top")
    motions: Path | None = None
    procedural_share: float = 0.25
    seed: int = 0
    workers: int = 1
    device: str = "cpu"
    least_frames: int = 90


@dataclass(frozen=True)
class Plan:
    """Everything that determines a sequence."""

    number: int
    split: str
    category: str
    motion: str
    start: float
    mirror: bool
    phenotype: dict[str, float]
    pattern: Pattern
    frames: int


def clip_group(name: str) -> str:
    """Clips of the same performance share a group: the two partners of a salsa are numbered 01-15 and 16-30."""
    salsa = re.search(r"salsa_(\d+)", name)
    return f"salsa_{(int(salsa.group(1)) - 1) % 15 + 1:02d}" if salsa else name


def split_of_clips(names: list[str]) -> dict[str, str]:
    """Splits clips by performance: every sixth group is for testing, every twelfth for validation."""
    groups = sorted({clip_group(n) for n in names})
    held = {g: "test" if i % 6 == 2 else "validation" if i % 12 == 5 else "train" for i, g in enumerate(groups)}
    return {n: held[clip_group(n)] for n in names}


def clip_frames(path: Path) -> int:
    """Frames a clip has at 30 fps, read from its header."""
    header = re.search(r"Frames:\s*(\d+)\s+Frame Time:\s*([\d.eE+-]+)", path.read_text(errors="replace"))
    return int(int(header.group(1)) * float(header.group(2)) * FPS) if header else 0


def split_of_number(number: int) -> str:
    """Which split a sequence belongs to: of 18, three are for testing, one for validation."""
    return "test" if number % 6 == 3 else "validation" if number % 18 == 5 else "train"


def plan_sequence(config: GenerateConfig, number: int) -> Plan:
    """The parameters of a sequence: a pure function of the configuration and its number."""
    rng = np.random.default_rng([config.seed, number])
    split = split_of_number(number)
    unknown = sorted(set(config.categories) - set(CATEGORIES))
    if unknown:
        raise ValueError(f"unknown garment categories {unknown}; there are {', '.join(CATEGORIES)}")
    order = sum(split_of_number(n) == split for n in range(number))
    category = config.categories[order % len(config.categories)]
    clips = sorted(p.stem for p in config.motions.glob("*.bvh")) if config.motions else []
    if config.motions and not clips:
        raise FileNotFoundError(f"no .bvh clips in {config.motions}")
    splits = split_of_clips(clips)
    candidates = [c for c in clips if splits[c] == split]
    if split != "train":  # held-out rollouts should run for the whole length
        long = [c for c in candidates if clip_frames(config.motions / f"{c}.bvh") >= config.frames + 8]
        candidates = long or candidates
    if candidates and not (split == "train" and rng.random() < config.procedural_share):
        motion = candidates[int(rng.integers(len(candidates)))]
    else:
        motion = f"procedural:{KINDS[int(rng.integers(len(KINDS)))]}"
    pattern = sampled_pattern(category, rng, config.faces)
    gender = float(rng.uniform(0, 1))
    phenotype = {
        "gender": gender,
        "age": float(rng.uniform(0.6, 0.85)),
        "muscle": float(rng.uniform(0.35, 0.7)),
        "weight": float(rng.uniform(0.3, 0.65)),
        "height": float(rng.uniform(0.35, 0.65)),
        "proportions": float(rng.uniform(0.4, 0.8)),
    }
    start, mirror = float(rng.random()), bool(rng.random() < 0.5)
    return Plan(number, split, category, motion, start, mirror, phenotype, pattern, config.frames)


def body_motion(plan: Plan, config: GenerateConfig):
    """The rest body and its poses: the clip or formula, arms held off, blended in from the rest pose."""
    from .bodies import anny_bodies

    body = anny_bodies().rest(**plan.phenotype)
    if plan.motion.startswith("procedural:"):
        poses = procedural(body, plan.motion.split(":")[1], plan.frames, seed=plan.number, fps=FPS)
    else:
        poses = retarget(read_bvh(config.motions / f"{plan.motion}.bvh"), body, FPS)
        poses = _window(poses, plan)
    if plan.mirror:
        poses = mirrored(body, poses)
    poses = arms_abducted(body, poses, 15.0)
    return body, blended_in(body, facing_forward(poses), BLEND)


def _window(poses: PoseSequence, plan: Plan) -> PoseSequence:
    """A window of the clip; the first frames, often a T-pose, are left out where the clip is long enough."""
    lead = 8 if len(poses) > plan.frames + 8 else min(2, len(poses) - 2)
    start = lead + int(plan.start * max(0, len(poses) - lead - plan.frames))
    return poses[start : start + plan.frames]


def make_sequence(config: GenerateConfig, number: int) -> dict:
    """Makes one sequence and writes it; returns its manifest."""
    plan = plan_sequence(config, number)
    folder = config.out / f"{number:05d}_{plan.category}"
    began = time.perf_counter()
    body, poses = body_motion(plan, config)
    frames, transforms = posed(body, poses)
    collider = body.collider_faces()
    manifest = {
        "format": 1,
        "number": number,
        "seed": config.seed,
        "split": plan.split,
        "category": plan.category,
        "garment": f"{plan.category}_{number:05d}",
        "motion": plan.motion,
        "body": plan.phenotype,
        "fps": FPS,
        "blend": BLEND,
        "parameters": asdict(plan) | {"settings": ClothSettings().as_dict(), "limits": asdict(Limits())},
        "versions": {name: importlib.metadata.version(name) for name in ("warpgarment", "newton", "warp-lang", "anny")},
    }
    kept: list[np.ndarray] = []
    reason = None
    gate = None
    try:
        garment, edge = make_garment(body, plan.pattern)
        first = transforms[0, 0].astype(np.float64)  # the rest pose, carried to where the motion starts
        placed = garment.vertices @ first[:, :3].T + first[:, 3]
        placed_garment = Garment(placed.astype(np.float32), garment.faces, pins=garment.pins, name=garment.name)
        gate = QualityGate(garment, body.faces[collider])
        for frame, vertices in enumerate(
            simulate(placed_garment, edge, frames, body.faces[collider], fps=FPS, device=config.device)
        ):
            reason = gate.check(frame, vertices, frames[frame])
            if reason:
                break
            kept.append(vertices)
    except ValueError as error:  # a garment that cannot be cut for this body
        reason = str(error)
    if reason and len(kept) > config.least_frames:
        manifest["cut_short"] = reason
        kept = kept[:-5]  # the frames before a failure are on their way to it
        reason = None
    manifest |= {
        "status": "rejected" if reason else "good",
        "reason": reason,
        "frames": len(kept),
        "figures": gate.figures(len(kept)) if gate else {},
        "seconds": round(time.perf_counter() - began, 1),
    }
    arrays = {}
    if not reason:
        arrays = {
            "garment_rest_vertices": garment.vertices,
            "garment_faces": garment.faces,
            "pins": garment.pins,
            "garment_vertices": np.stack(kept),
            "body_rest_vertices": body.vertices,
            "body_faces": body.faces,
            "collider_faces": collider,
            "bone_indices": body.bone_indices,
            "bone_weights": body.bone_weights,
            "bone_transforms": transforms[: len(kept)],
        }
    write_sequence(folder, arrays, manifest)
    return manifest


def generate(config: GenerateConfig) -> Path:
    """Makes the sequences that are not there yet; returns the data set's folder."""
    from tqdm import tqdm

    config = replace(config, out=Path(config.out), motions=Path(config.motions) if config.motions else None)
    config.out.mkdir(parents=True, exist_ok=True)
    from .bodies import anny_bodies

    anny_bodies()  # builds the cache once, not in every worker
    done = {p.parent.name.split("_")[0] for p in config.out.glob(f"*/{MANIFEST}")}
    numbers = [n for n in range(config.first, config.first + config.sequences) if f"{n:05d}" not in done]
    counts = {"good": 0, "rejected": 0}
    frames = 0
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(config.workers, mp_context=context) as pool, tqdm(total=len(numbers), unit="seq") as bar:
        for future in as_completed([pool.submit(make_sequence, config, n) for n in numbers]):
            manifest = future.result()
            counts[manifest["status"]] += 1
            frames += manifest["frames"] if manifest["status"] == "good" else 0
            note = f"{manifest['garment']} on {manifest['motion']}: {manifest['status']} {manifest['frames']} frames"
            tqdm.write(note + (f" ({manifest['reason']})" if manifest["reason"] else ""))
            bar.set_postfix(good=counts["good"], rejected=counts["rejected"], frames=frames)
            bar.update()
    return config.out
