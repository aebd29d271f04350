"""`warpgarment dataset`: checks a data set, writes a page about it, or imports sequences that others have made."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from ..io.atomic import atomic_file


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
    split: Literal["train", "validation", "test"] = "train"
    """What the sequence is for."""
    clean: bool = False
    """Repair rest meshes that have defects."""


@dataclass
class Dataset:
    """Options of `dataset`."""

    command: tyro.conf.OmitSubcommandPrefixes[Verify | Card | Import]


def run(options: Dataset) -> None:
    """Runs one of the three."""
    if isinstance(options.command, Verify):
        _verify(options.command)
    elif isinstance(options.command, Import):
        from ..training.readers import read_recording, write_as_sequence

        chosen = options.command
        recording = read_recording(chosen.source, body=chosen.body, clean=chosen.clean)
        print(f"wrote {write_as_sequence(recording, chosen.out, split=chosen.split)}")
    else:
        from ..training.card import write_card

        print(f"wrote {write_card(options.command.root, options.command.out, pictures=options.command.pictures)}")


def _verify(options: Verify) -> None:
    from ..training.verify import VerificationFailed, verify

    report = verify(options.root)
    print(report)
    if options.json is not None:
        with atomic_file(options.json) as temporary:
            temporary.write_text(json.dumps(report.as_dict(), indent=1), "utf-8")
    if report.problems:
        first, count = report.problems[0], len(report.problems)
        many = "1 problem" if count == 1 else f"{count:,} problems"
        raise VerificationFailed(f"{options.root}: {many}, first {first.where}: {first.what}")
