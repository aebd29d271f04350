"""Checks whether a data set is complete, unchanged and correctly split: `warpgarment dataset verify DIR`.

In every sequence the manifest has all its entries, every file has its checksum, arrays fit each other, values are
finite, and the rest mesh is valid for a garment. In the set no number occurs twice, no planned sequence is missing, no
sequence has another seed, no clip (or clip of the same performance) and no garment is both trained and tested on, no
held-out category is trained on, and there are no unfinished sequences.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import open_plain
from warpgarment.progress import counted
from warpgarment.view.report import table

from .layout import SPLITS
from .schema import SEQUENCE, faults, is_finite, shown
from .sequence import MANIFEST, Sequence, check_array_file
from .set_manifest import planned_numbers, read_checked, read_set_manifest

NOT_SEQUENCES = ("card", "twins")  # other folders that a set may hold
_OF_FRAMES = ("garment_vertices", "garment_velocities", "wind")
_HELD_OUT_BY_CATEGORY = ("cloth3d",)  # recipes with held-out categories; outfits and cuts are split otherwise


class VerificationFailed(ValueError):
    """Something is wrong with a data set."""


@dataclass(frozen=True)
class Problem:
    """A fault (`what`) and its place (`where`): a sequence's folder, or a file or folder of the set."""

    where: str
    what: str


@dataclass(frozen=True)
class Entry:
    """The facts about one sequence.

    Attributes:
        name: Name of its folder.
        manifest: Its manifest; empty if it cannot be read.
        size: Size on disk [bytes].
        garments: A fingerprint of the rest mesh of each garment; empty if they could not be read.
        problems: Faults of the sequence.
    """

    name: str
    manifest: dict[str, Any]
    size: int
    garments: tuple[str, ...]
    problems: tuple[Problem, ...]


@dataclass
class Report:
    """Result of :func:`verify`.

    Attributes:
        root: Name of the folder.
        sequences, rejected: Number of good and of rejected sequences.
        frames: Number of frames of the good sequences.
        size: Size of the set on disk [bytes].
        rejected_attempts: Number of times that a sequence was rejected and drawn anew.
        splits: Number of good sequences, of their frames, and of sequences by category, for each split.
        problems: All faults of the set.
    """

    root: str
    sequences: int = 0
    rejected: int = 0
    rejected_attempts: int = 0
    frames: int = 0
    size: int = 0
    splits: dict[str, dict[str, Any]] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """The attributes as plain values."""
        return asdict(self)

    def __str__(self) -> str:
        categories = sorted({c for split in self.splits.values() for c in split["categories"]})
        rows = [
            [name, split["sequences"], f"{split['frames']:,}", *(split["categories"].get(c, "-") for c in categories)]
            for name, split in self.splits.items()
        ]
        lines = [
            table(["split", "sequences", "frames", *categories], rows) if rows else "no sequence",
            f"{self.sequences:,} sequences, {self.frames:,} frames, {self.size / 1e6:,.1f} MB; {self.rejected:,} "
            f"rejected, {self.rejected_attempts:,} attempts drawn anew",
            *(f"{p.where}: {p.what}" for p in self.problems[:20]),
            *([f"and {len(self.problems) - 20:,} more problems"] if len(self.problems) > 20 else []),
        ]
        return "\n".join(lines)


def verify(root: str | Path) -> Report:
    """Checks a data set.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"no data set at {root}")
    report = Report(root.resolve().name)
    entries = []
    folders = sorted(p for p in root.iterdir() if p.is_dir() and p.name not in NOT_SEQUENCES)
    for path in counted(folders, "checking", unit="sequence"):
        if path.name.startswith("."):
            report.problems.append(Problem(path.name, "unfinished. Remove it, unless a sequence is being written."))
        else:
            entries.append(check_sequence(path))
    report.problems += [p for entry in entries for p in entry.problems]
    try:
        manifest = read_set_manifest(root) or {}
    except MeshError as error:
        manifest = {}
        report.problems.append(Problem("set.json", str(error)))
    report.problems += [*_numbers(entries, manifest), *_splits(entries), *_held_out(entries, manifest)]
    _count(report, entries)
    if not entries:
        report.problems.append(Problem(report.root, "holds no sequence. Make some with `warpgarment generate`."))
    return report


def check_sequence(folder: Path) -> Entry:
    """Reads one sequence completely and lists its faults."""
    try:
        size = sum(p.stat().st_size for p in folder.iterdir() if p.is_file())
        manifest = read_checked(folder / MANIFEST, None)
    except (MeshError, OSError) as error:
        return Entry(folder.name, {}, 0, (), (Problem(folder.name, str(error)),))
    problems = _manifest_problems(manifest)
    if problems:  # the entries of this manifest are not reliable
        return Entry(folder.name, {}, size, (), tuple(Problem(folder.name, p) for p in problems))
    problems = _file_problems(folder, manifest)
    garments: tuple[str, ...] = ()
    if not problems and manifest["checksums"]:
        try:
            garments = _content(Sequence.load(folder))
        except (ValueError, OSError) as error:
            problems.append(str(error).removeprefix(f"{folder.name}: "))
    return Entry(folder.name, manifest, size, garments, tuple(Problem(folder.name, p) for p in problems))


def _manifest_problems(manifest: dict[str, Any]) -> list[str]:
    """Entries that a manifest must have and lacks."""

    rejected = manifest.get("status") == "rejected"
    needed = ["status", "split", "garment", "motion", "fps", "frames", "checksums", *(["reason"] if rejected else [])]
    problems = [f"{MANIFEST} does not say {key}" for key in needed if key not in manifest]
    wrong = faults(manifest, SEQUENCE)
    figures = manifest.get("figures", {})
    if isinstance(figures, dict):
        wrong.pop("figures", None)  # reported below with the names of the figures
    problems += [f"{MANIFEST} {fault}" for fault in wrong.values()]
    empty = ["garment", "motion", *(["reason"] if rejected else ["frames", "checksums"])]
    problems += [
        f"{MANIFEST} says {shown(manifest[key])} for {key}"
        for key in empty
        if key in manifest and key not in wrong and not manifest[key]
    ]
    if not isinstance(figures, dict):
        problems.append(f"{MANIFEST} has figures that are not named")
    elif bad := [key for key, value in figures.items() if not (isinstance(value, bool) or is_finite(value))]:
        problems.append(f"{MANIFEST} has {len(bad)} figures that are not finite (first: {bad[0]})")
    return problems


def _file_problems(folder: Path, manifest: dict[str, Any]) -> list[str]:
    """Files that are missing, changed, or not in the manifest."""
    checksums = manifest["checksums"]
    present = {path.name for path in folder.iterdir()} - {MANIFEST}
    problems = [f"{name} is missing" for name in sorted(set(checksums) - present)]
    problems += [f"{name} is not in {MANIFEST}" for name in sorted(present - set(checksums))]
    for name in sorted(present & set(checksums)):
        try:
            if _sha256(folder / name) != checksums[name]:
                problems.append(f"{name} does not have its checksum. Generate the sequence again.")
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else str(error).removeprefix(f"{folder / name} ")
            problems.append(f"{name} cannot be read ({reason}). Generate the sequence again.")
    return problems


def _sha256(path: Path) -> str:
    """Checksum of a file, read in pieces; "" for an array whose file has another number of bytes than its header says.

    Raises:
        MeshError: It is not a plain file.
        OSError: It cannot be read.
    """
    with open_plain(path) as file:
        if path.suffix == ".npy":
            try:
                check_array_file(path)
            except ValueError:
                return ""
        digest = hashlib.sha256()
        while piece := file.read(1 << 20):
            digest.update(piece)
        return digest.hexdigest()


def _content(sequence: Sequence) -> tuple[str, ...]:
    """Fingerprints of the garments of a sequence whose arrays are sound.

    Raises:
        MeshError: The arrays are not sound; the message names the fault.
    """
    if len(sequence) != sequence.manifest["frames"]:
        raise MeshError(f"{len(sequence)} frames, {MANIFEST} says {sequence.manifest['frames']}")
    arrays = sequence.arrays()
    for name, array in arrays.items():
        bad = ~np.isfinite(array)
        if bad.any():
            where = f" (first: frame {int(np.argwhere(bad)[0][0])})" if name in _OF_FRAMES else ""
            raise MeshError(f"{name} holds {np.count_nonzero(bad):,} values that are not finite{where}")
    sequence.body_in(slice(0, 1)).submesh(arrays["collider_faces"])
    garment = sequence.garment
    return tuple(
        hashlib.sha256(
            garment.vertices[layer.vertices].tobytes() + (garment.faces[layer.faces] - layer.vertices.start).tobytes()
        ).hexdigest()
        for layer in sequence.layers
    )


def _numbers(entries: list[Entry], manifest: dict[str, Any]) -> Iterable[Problem]:
    """Sequences that exist twice, are missing, or have another seed."""
    count = Counter(entry.manifest["number"] for entry in entries if "number" in entry.manifest)
    for entry in entries:
        if count[entry.manifest.get("number")] > 1:
            yield Problem(entry.name, f"another sequence has the number {entry.manifest['number']} too")
    missing = [number for number in planned_numbers(manifest) if number not in count]
    if missing:
        text = f"{len(missing):,} of {len(planned_numbers(manifest)):,} planned sequences are missing (first: number "
        yield Problem("set.json", f"{text}{missing[0]}). Run `warpgarment generate` with the same options again.")
    seed = manifest.get("configuration", {}).get("seed")
    for entry in entries:
        if seed is not None and entry.manifest.get("seed", seed) != seed:
            yield Problem(entry.name, f"made with seed {entry.manifest['seed']}, the set with {seed}")


def _splits(entries: list[Entry]) -> Iterable[Problem]:
    """Clips and garments that are both trained and tested on."""
    from .splits import clip_group

    clips: dict[str, str] = {}
    garments: dict[str, str] = {}
    for entry in _good(entries, "train"):
        clips.setdefault(clip_group(str(entry.manifest.get("motion"))), entry.name)
        garments |= {fingerprint: entry.name for fingerprint in entry.garments}
    for entry in _good(entries, "test"):
        motion = str(entry.manifest.get("motion"))
        if not motion.startswith("procedural:") and clip_group(motion) in clips:
            yield Problem(entry.name, f"tests on {motion}, of a performance trained on in {clips[clip_group(motion)]}")
        if shared := [f for f in entry.garments if f in garments]:
            yield Problem(entry.name, f"tests on a garment trained on in {garments[shared[0]]}")


def _held_out(entries: list[Entry], manifest: dict[str, Any]) -> Iterable[Problem]:
    """Held-out categories, only for testing, that are trained on."""
    configuration = manifest.get("configuration", {})
    if configuration.get("recipe", "cloth3d") in _HELD_OUT_BY_CATEGORY:
        for entry in _good(entries, "train"):
            held_out = set(_categories(entry.manifest)) & set(configuration.get("held_out", []))
            if held_out:
                yield Problem(entry.name, f"trains on {', '.join(sorted(held_out))}, held out for tests")


def _good(entries: list[Entry], split: str) -> list[Entry]:
    return [e for e in entries if e.manifest.get("status") == "good" and e.manifest.get("split") == split]


def _categories(manifest: dict[str, Any]) -> list[str]:
    garments = manifest.get("garments") or [manifest]
    return [str(garment.get("category", "")) for garment in garments]


def _count(report: Report, entries: list[Entry]) -> None:
    for split in SPLITS:
        good = _good(entries, split)
        if good:
            categories = Counter(str(entry.manifest.get("category", "-")) for entry in good)
            frames = sum(entry.manifest.get("frames", 0) for entry in good)
            report.splits[split] = {"sequences": len(good), "frames": frames, "categories": dict(categories)}
    report.sequences = sum(split["sequences"] for split in report.splits.values())
    report.frames = sum(split["frames"] for split in report.splits.values())
    report.rejected = sum(entry.manifest.get("status") == "rejected" for entry in entries)
    report.rejected_attempts = sum(len(entry.manifest.get("rejected_attempts", [])) for entry in entries)
    report.size = sum(entry.size for entry in entries)
