"""The contents of a data set: recipes, and the plan of every sequence.

A plan holds all parameters of one sequence and is a pure function of the set's configuration, the sequence's number and
the attempt, so any sequence can be made again, on any machine, in any order. There are three recipes:

- `cloth3d`: single garments in the manner of CLOTH3D: seven categories, cut and resized, one material. As in
  *Neural Garment Dynamics via Manifold-Aware Transformers* (section 4), skirts are only ever tested on.
- `layers`: outfits of two and three garments in the manner of D-LAYERS, each with a material of its own, in the wind.
- `seams`: one dress with random slits and open seams, ten cuts to train on and two to test (figure 9 there).
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from warpgarment.bodies.clips import clip_frames, list_clips
from warpgarment.objects.material import Material
from warpgarment.training.data.schema import MOST_FRAMES, MOST_PLANNED
from warpgarment.training.data.splits import split_of_clips, split_of_number
from warpgarment.training.garments.outfits import OutfitPattern, sampled_outfit
from warpgarment.training.garments.pattern import CATEGORIES, sampled_pattern
from warpgarment.training.garments.seams import Seams, sampled_seams
from warpgarment.training.materials import sampled_fabric, sampled_material
from warpgarment.training.motions.procedural import KINDS

from .wind import Wind, sampled_wind

FPS = 30.0
BLEND = 30
TRAINING_CUTS, TEST_CUTS = 10, 2
GAP = 0.011  # least distance of a single garment from the body at the start [m]

Recipe = Literal["cloth3d", "layers", "seams"]


@dataclass(frozen=True)
class GenerateConfig:
    """Options of `warpgarment generate`. The first group determines the sequences; the second only how they are made.

    Attributes:
        out: Folder of the data set.
        recipe: Kind of set: "cloth3d" has single garments, "layers" outfits in wind, "seams" a dress with random cuts.
        sequences: Number of sequences; the standard set is 240 of `cloth3d`.
        frames: Number of frames of motion per sequence, after 30 frames that blend in from the rest pose.
        faces: Number of faces of a T-shirt; other categories have more or fewer, by their area.
        categories: Categories of `cloth3d`, which take turns.
        held_out: Categories that are only in the test split.
        motions: Folder of BVH and AMASS clips; None for procedural motions alone.
        procedural_share: Share of procedural motions among the training sequences, if there are clips.
        bodies: "anny" samples Anny's shapes (extra `bodies`); "bundled" uses the one body of this package.
        teacher: Physics solver that simulates the sequences.
        materials: "fixed" gives all garments the same cloth, "sampled" each its own, of wide ranges, "fabrics" each
            one like a measured fabric; None for the recipe's default.
        wind: Whether there is wind, in about half of the sequences; None for the recipe's default.
        velocities: Whether the teacher's velocity of each vertex at the end of each frame is recorded, too, for
            restarts; not by Blender. Sequences take almost twice the space, and are the same otherwise.
        seed: Seed of the whole set.
        attempts: Largest number of attempts at a sequence, of which the quality gate may reject some.
        least_frames: Number of good frames; a sequence that fails after more of them is kept up to the failure.
        first: Number of the first sequence to make.
        shard: "i/n" makes only the sequences whose number is i modulo n, for n machines.
        workers: Number of processes.
        worlds: Number of sequences that each process simulates at once, on a GPU.
        device: Warp device of the teacher.
        ray: Address of a Ray cluster to run on, or "local" for one on this machine (extra `cluster`).
        attempt: Number of the only attempt to make, to reproduce a rejection; None for all.
        keep_rejected: Whether the frames of rejected sequences are written too.
        make_blender: Whether to make the virtual environment of the Blender teacher first.
    """

    out: Path
    recipe: Recipe = "cloth3d"
    sequences: int = 240
    frames: int = 270
    faces: int = 1200
    categories: tuple[str, ...] = CATEGORIES
    held_out: tuple[str, ...] = ("skirt",)
    motions: Path | None = None
    procedural_share: float = 0.25
    bodies: Literal["anny", "bundled"] = "anny"
    teacher: Literal["newton", "blender", "warp"] = "newton"
    materials: Literal["fixed", "sampled", "fabrics"] | None = None
    wind: bool | None = None
    velocities: bool = False
    seed: int = 0
    attempts: int = 4
    least_frames: int = 150

    first: int = 0
    shard: str = "0/1"
    workers: int = 1
    worlds: int = 1
    device: str = "cpu"
    ray: str | None = None
    attempt: int | None = None
    keep_rejected: bool = False
    make_blender: bool = False

    def __post_init__(self) -> None:
        unknown = sorted({*self.categories, *self.held_out} - set(CATEGORIES))
        if unknown:
            raise ConfigurationError(f"unknown garment categories {unknown}; there are {', '.join(CATEGORIES)}.")
        if not set(self.categories) - set(self.held_out):
            raise ConfigurationError("every category is held out; none is left to train on.")
        match = re.fullmatch(r"(\d+)/(\d+)", self.shard)
        if not match or int(match[1]) >= int(match[2]):
            raise ConfigurationError(f"shard must be i/n with i below n, such as 0/2, got {self.shard!r}.")
        for name in ("sequences", "frames", "faces", "attempts", "workers", "worlds"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} must be at least 1, got {getattr(self, name)}.")
        if not 0 <= self.first <= MOST_PLANNED or self.sequences > MOST_PLANNED or self.frames > MOST_FRAMES:
            raise ConfigurationError(
                f"{self.sequences:,} sequences of {self.frames:,} frames, from number {self.first:,}: there are at "
                f"most {MOST_PLANNED:,} in a set, of {MOST_FRAMES:,} frames, numbered from 0."
            )
        if self.motions is not None and not list_clips(Path(self.motions)):
            raise FileNotFoundError(f"no .bvh or .npz clips in {self.motions}")

    def material(self, rng: np.random.Generator) -> Material:
        """Draws the material of a garment; one that is the same for all draws nothing."""
        kind = self.materials or ("sampled" if self.recipe == "layers" else "fixed")
        draw = {"fixed": lambda _: Material(), "sampled": sampled_material, "fabrics": sampled_fabric}[kind]
        return draw(rng)

    @property
    def with_wind(self) -> bool:
        """Whether the air moves in some sequences."""
        return self.recipe == "layers" if self.wind is None else self.wind

    def determining(self) -> dict[str, Any]:
        """The options on which the sequences depend, as plain values; clips appear by name and size, not by folder."""
        values = {k: v for k, v in asdict(self).items() if k in _DETERMINING}
        clips = list_clips(Path(self.motions)) if self.motions else []
        values["clips"] = {p.name: p.stat().st_size for p in clips}
        if self.velocities:  # sets without say nothing of it, as before there was a choice
            values["velocities"] = True
        single = self.recipe == "cloth3d"
        chosen = {"categories": list(self.categories), "held_out": list(self.held_out)}
        return values | (chosen if single else {"categories": [], "held_out": []})

    def command(self) -> str:
        """The command that makes the set again; the folder of clips is left to the user."""
        words = ["warpgarment generate --out DIR"] + (["--motions CLIPS"] if self.motions else [])
        said = (*_DETERMINING, "velocities", "sequences", "categories", "held_out")
        for option in fields(self):
            value = getattr(self, option.name)
            if option.name not in said or value == option.default:
                continue
            shown = " ".join(map(str, value)) if isinstance(value, tuple) else value
            flag = f"--{option.name.replace('_', '-')}"
            words.append(flag if option.name == "velocities" else f"{flag} {shown}")
        return " ".join(words)


_DETERMINING = (
    "recipe", "frames", "faces", "procedural_share", "bodies", "teacher", "materials", "wind", "seed", "attempts",
    "least_frames",
)  # fmt: skip


class ConfigurationError(ValueError):
    """Options that do not fit together."""


@dataclass(frozen=True)
class Plan:
    """All parameters of a sequence.

    Attributes:
        number: Number of the sequence.
        attempt: Number of the attempt, from 0; it grows by one when the gate has rejected the one before.
        recipe: Recipe of the set.
        split: "train", "validation" or "test".
        motion: Name of a clip, or "procedural:kind".
        start: Start of the window in the clip, as a share (0 to 1) of the possible range.
        mirror: Whether left and right are exchanged.
        body: "anny", "bundled", "mannequin" or "creature".
        phenotype: Anny's shape parameters by name.
        outfit: Measures of the garments, innermost first.
        materials: Material of each garment.
        wind: Wind of the sequence; None for still air.
        seams: Cuts of the only garment; None for no cuts.
        cut: Number of these cuts in the recipe; None for no cuts.
        frames: Number of frames of motion.
    """

    number: int
    attempt: int
    recipe: str
    split: str
    motion: str
    start: float
    mirror: bool
    body: str
    phenotype: dict[str, float]
    outfit: OutfitPattern
    materials: tuple[Material, ...]
    wind: Wind | None
    seams: Seams | None
    cut: int | None
    frames: int

    @property
    def category(self) -> str:
        """The category, or those of an outfit joined by "+"."""
        return "+".join(pattern.category for pattern in self.outfit.layers)

    @property
    def name(self) -> str:
        """Name of the sequence's folder."""
        return f"{self.number:05d}_{self.category}"


def plan_sequence(config: GenerateConfig, number: int, attempt: int = 0) -> Plan:
    """The parameters of a sequence: a pure function of the configuration, its number and the attempt."""
    rng = np.random.default_rng([config.seed, number, attempt])
    split = split_of_number(number)
    order = sum(split_of_number(n) == split for n in range(number))
    motion = _motion(config, split, rng)
    start, mirror = float(rng.random()), bool(rng.random() < 0.5)
    body, phenotype = _body(config, split, order, rng)
    outfit, cut = _outfit(config, split, order, rng)
    seams = None
    if cut is not None:
        seams = sampled_seams(np.random.default_rng([config.seed, 2, cut]), "dress")
    count = len(outfit.layers)
    materials = tuple(config.material(rng) for _ in range(count))
    wind = sampled_wind(rng) if config.with_wind and rng.random() < 0.5 else None
    return Plan(
        number, attempt, config.recipe, split, motion, start, mirror, body, phenotype, outfit, materials, wind, seams,
        cut, config.frames,
    )  # fmt: skip


def _motion(config: GenerateConfig, split: str, rng: np.random.Generator) -> str:
    clips = list_clips(Path(config.motions)) if config.motions else []
    splits = split_of_clips([p.stem for p in clips])
    candidates = [p for p in clips if splits[p.stem] == split]
    if split != "train":  # held-out rollouts should run for the whole length
        candidates = [p for p in candidates if clip_frames(p) >= config.frames + 8] or candidates
    if candidates and not (split == "train" and rng.random() < config.procedural_share):
        return candidates[int(rng.integers(len(candidates)))].stem
    return f"procedural:{KINDS[int(rng.integers(len(KINDS)))]}"


def _body(config: GenerateConfig, split: str, order: int, rng: np.random.Generator) -> tuple[str, dict[str, float]]:
    """Every tenth test sequence is on the mannequin, another on the creature."""
    from warpgarment.bodies.anny import sampled_phenotype

    if config.recipe == "seams":  # one body throughout
        rng = np.random.default_rng([config.seed, 3])
    phenotype = sampled_phenotype(rng)
    if config.recipe == "cloth3d" and split == "test" and order % 10 in (4, 9):
        other = "mannequin" if order % 10 == 4 else "creature"
        if config.bodies == "anny" or other == "creature":
            return other, {}
    return config.bodies, phenotype if config.bodies == "anny" else {}


def _outfit(
    config: GenerateConfig, split: str, order: int, rng: np.random.Generator
) -> tuple[OutfitPattern, int | None]:
    """Measures of the garments, and the number of their cuts, or None if the recipe has no cuts."""
    if config.recipe == "layers":
        return sampled_outfit(rng, config.faces), None
    if config.recipe == "seams":
        cut = TRAINING_CUTS + order % TEST_CUTS if split == "test" else order % TRAINING_CUTS
        dress = sampled_pattern("dress", np.random.default_rng([config.seed, 1]), config.faces)
        return OutfitPattern((dress,), (GAP,)), cut
    kept = [c for c in config.categories if split == "test" or c not in config.held_out]
    return OutfitPattern((sampled_pattern(kept[order % len(kept)], rng, config.faces),), (GAP,)), None
