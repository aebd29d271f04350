"""`warpgarment dataset`: checks a data set, writes a page about it, or imports sequences that others have made."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from warpgarment.errors import UsageError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.outputs import check_writable


@dataclass
class Verify:
    """Check that every sequence is whole and unchanged, and that test data are not trained on."""

    root: tyro.conf.Positional[Path]
    """The data set's folder."""
    json: Path | None = None
    """Write the report to this file, too."""


@dataclass
class Card:
    """Write card.md: what the set consists of, how it was made, pictures, histograms, licences."""

    root: tyro.conf.Positional[Path]
    """The data set's folder."""
    out: Path | None = None
    """Folder for card.md and card/; by default the data set's."""
    pictures: int = 12
    """Sequences on the contact sheet."""


@dataclass
class Import:
    """Turn a recording (CLOTH3D, VTO, D-LAYERS, or animation files) into a sequence that can be trained on."""

    source: tyro.conf.Positional[Path]
    """CLOTH3D or D-LAYERS sample folder, VTO pickle, or the garment's animation (.pc2, .usd, .npz, folder of .obj)."""
    out: tyro.conf.Positional[Path]
    """Folder of the sequence, inside the data set's folder; must not exist."""
    body: Path | None = None
    """The body's animation; the data sets above hold poses only, see docs/readers.md."""
    rest: Path | None = None
    """The garment's rest shape (mesh file); by default the mesh beside a .pc2, else the first frame."""
    split: Literal["train", "validation", "test"] = "train"
    """What the sequence is for."""
    motion: str | None = None
    """Name of the motion, by which `verify` finds those both trained and tested on; by default what the files say."""
    fps: float | None = None
    """Frames per second, where the files do not say, or say something else."""
    unit: Literal["m", "dm", "cm", "mm", "in"] | None = None
    """Length unit of animation files."""
    body_unit: Literal["m", "dm", "cm", "mm", "in"] | None = None
    """That of the body, where it is another."""
    clean: bool = False
    """Repair rest meshes that have defects."""
    unrecorded: bool = False
    """The animation is a network's own, such as of `simulate`: training takes its garment, body and states, but not
    its positions as targets (`train --cloth.physics`)."""


@dataclass
class Dataset:
    """Options of `dataset`."""

    command: tyro.conf.OmitSubcommandPrefixes[Verify | Card | Import]


def run(options: Dataset) -> None:
    """Runs one of the three."""
    if isinstance(options.command, Verify):
        _verify(options.command)
    elif isinstance(options.command, Import):
        _import(options.command)
    else:
        from warpgarment.training.data.card import write_card

        print(f"wrote {write_card(options.command.root, options.command.out, pictures=options.command.pictures)}")


_UNUSED = {"cloth3d": ("rest", "unit", "body_unit"), "vto": ("fps", "unit", "body_unit"),
           "dlayers": ("rest", "fps", "unit", "body_unit")}  # fmt: skip


def _import(options: Import) -> None:
    from .readers import detect, read_recording, write_as_sequence

    if options.out.exists():
        raise FileExistsError(f"{options.out} exists. Remove it, or choose another folder.")
    check_writable(options.out, folder=True)
    if options.unrecorded and options.split != "train":
        raise UsageError("--unrecorded: a sequence without a recording is for training only. Leave --split out.")
    kind = detect(options.source)
    names = ("body", "rest", "fps", "unit", "body_unit")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    for name in _UNUSED.get(kind, ()):
        if name in given:
            raise UsageError(f"--{name.replace('_', '-')}: a {kind} sample says this itself. Leave the option out.")
    recording = read_recording(options.source, kind, clean=options.clean, **given)
    extra = {"recorded": False} if options.unrecorded else None
    print(f"wrote {write_as_sequence(recording, options.out, split=options.split, motion=options.motion, extra=extra)}")


def _verify(options: Verify) -> None:
    from warpgarment.training.data.verify import VerificationFailed, verify

    if options.json is not None:
        check_writable(options.json)
    report = verify(options.root)
    print(report)
    if options.json is not None:
        with atomic_file(options.json) as temporary:
            temporary.write_text(json.dumps(report.as_dict(), indent=1), "utf-8")
    if report.problems:
        first, count = report.problems[0], len(report.problems)
        many = "1 problem" if count == 1 else f"{count:,} problems"
        raise VerificationFailed(f"{options.root}: {many}, first {first.where}: {first.what}")
