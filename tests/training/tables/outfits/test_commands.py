"""Tables 4 and 5 from a small set: every rollout is in them, once measured, and what is lacking is said."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support import sequences
from support.tables import random_network

from warpgarment.training.tables.options import DataLacks, OptionMissing
from warpgarment.training.tables.outfits import rows as rows_module
from warpgarment.training.tables.outfits.__main__ import Table4, Table5, command, make
from warpgarment.training.tables.outfits.rows import Missing
from warpgarment.training.tables.outfits.static import StaticGarment


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A long test sequence in wind, a short one without, one for validation, and one that is not finite."""
    root = tmp_path_factory.mktemp("worn")
    sequences.write_worn(root, "long", frames=98)
    sequences.write_worn(root, "short", frames=14, wind=0.0, wide=1.25)
    sequences.write_worn(root, "other", "validation", frames=5)
    sequences.write_worn(root, "nowhere", frames=14)
    positions = np.load(root / "nowhere" / "garment_boxes.npy")
    positions[3] = np.nan
    np.save(root / "nowhere" / "garment_boxes.npy", positions)
    return root


@pytest.fixture(scope="module")
def made(data, tmp_path_factory):
    """Options of a quick table with every kind of row, and its result."""
    root = tmp_path_factory.mktemp("tables")
    StaticGarment().save(root / "static.safetensors", {"minutes": 1.0, "steps": 1200, "train": 3})
    network = random_network(root / "random.safetensors")
    options = Table4(
        data, root / "out", (f"random={network}",), apart=("random",), static=root / "static.safetensors", frames=3,
        device="cpu", page=root / "page.md",
    )  # fmt: skip
    return options, make(options)


def test_every_rollout_is_in_the_table(made):
    """A row, sequence or start would be dropped silently. Two test sequences, of which one fits the window; the
    recording has no error; the one that is not finite is named."""
    _, result = made
    names = ["recording", "random", "random, contact", "random, garments apart", "static (DeePSD-like)", "skinned"]
    assert list(result["rows"]) == [*names, "rigid"]
    for rollouts in result["rows"].values():
        found = {(r["start"], r["sequence"]): r["frames"] for r in rollouts}
        assert found == {("window", "long"): 35, ("whole", "long"): 3, ("whole", "short"): 3}
    assert set(result["skipped"]) == {"nowhere", "short (window)"}
    assert all(r["error_mm"] == [0.0, 0.0] for r in result["rows"]["recording"])
    assert all(r["finite"] for rollouts in result["rows"].values() for r in rollouts)
    assert {r["sequence"]: r["cell"][1:] for r in result["rows"]["rigid"]} == {"long": "+W", "short": ""}
    errors = [r["error_mm"][0] for r in result["rows"]["random"] if r["start"] == "whole"]
    assert result["means"]["whole"]["random"]["sequences"] == len(errors) == 2


def test_files_say_how_they_were_made(made):
    """A table could not be made again, or would show folders: JSON, Markdown and page have command, numbers of
    sequences, what is lacking and the paper's figures."""
    options, result = made
    content = json.loads((options.out / "table4.json").read_text("utf-8"))
    assert content["command"] == result["command"]
    assert result["command"] == (
        f"python -m warpgarment.training.tables.outfits table4 --data {options.data.name} "
        "--network random=random.safetensors --apart random --static static.safetensors --frames 3 --device cpu"
    )
    for file in (options.out / "table4.md", options.page):
        text = file.read_text("utf-8")
        for line in (
            "1 sequence (1 test), 35 predicted frames", "2 sequences skipped:", "short (window): too short",
            "1.0 minutes of one processor: 1,200 steps on 3 sequences", "| LayersNet | 49.0±44.8 | 50.9±56.3 |",
        ):  # fmt: skip
            assert line in text
        assert str(options.out.parent) not in text


def test_table5_takes_what_table4_has_measured(made, monkeypatch):
    """Hours would be spent twice, or old figures shown for new frames: with the same options nothing moves again;
    with more frames only whole sequences do; the page then has both tables."""
    options, result = made
    moved = []

    def counted(self):
        def move(sequence, body, start, steps):
            moved.append((self.name, sequence.name, start.name, steps))
            return np.array(sequence.vertices[start.newest + 1 : start.newest + 1 + steps])

        return move

    monkeypatch.setattr(rows_module.Row, "mover", counted)
    again = make(Table5(**vars(options)))
    assert not moved
    assert again["means"] == result["means"]
    text = options.page.read_text("utf-8")
    assert text.count("\n## Table") == 2
    assert "| dress (1) | jacket (1) |" in text.replace("jacket (1) | dress (1)", "dress (1) | jacket (1)")
    make(Table5(**(vars(options) | {"frames": 4, "page": None})))
    assert {(start, steps) for _, _, start, steps in moved} == {("whole", 4)}
    assert len(moved) == 2 * len(result["rows"])


def test_rollouts_that_fail_are_counted(data, tmp_path, monkeypatch):
    """A network that breaks would look as good as one that does not: NaN in one sequence, an error in another."""

    def broken(self):
        def move(sequence, body, start, steps):
            if sequence.name == "short":
                raise ValueError("the garment is lost")
            found = np.array(sequence.vertices[1 : 1 + steps])
            found[-1] = np.nan if self.kind == "rigid" else 0.0
            return found

        return move

    monkeypatch.setattr(rows_module.Row, "mover", broken)
    result = make(Table4(data, tmp_path, (), starts=("whole",), frames=3, device="cpu"))
    mean = result["means"]["whole"]
    assert {name: (mean[name]["failed"], mean[name]["sequences"]) for name in ("skinned", "rigid")} == {
        "skinned": (1, 2), "rigid": (2, 2),
    }  # fmt: skip
    text = (tmp_path / "table4.md").read_text("utf-8")
    assert "2 of 2" not in "\n".join(line for line in text.splitlines() if line.startswith("| skinned"))
    assert "A rollout failed: ValueError: the garment is lost" in text
    failed = [line for line in text.splitlines() if line.startswith("| rigid")]
    assert failed
    assert "failed" in failed[0]


def test_what_is_lacking_is_said(data, tmp_path):
    """A misspelt network or an empty split would give an empty table."""
    with pytest.raises(OptionMissing, match="NAME=CHECKPOINT"):
        make(Table4(data, tmp_path, ("fast",)))
    with pytest.raises(OptionMissing, match="a name is given twice"):
        make(Table4(data, tmp_path, ("a=fast", "a=small")))
    with pytest.raises(Missing, match=r"'Net' and 'Net\+' would share the file net.json"):
        make(Table4(data, tmp_path, ("Net=fast", "Net+=small")))
    with pytest.raises(Missing, match="there is no --network other=CHECKPOINT"):
        make(Table4(data, tmp_path, ("fast=fast",), apart=("other",)))
    with pytest.raises(DataLacks, match="no sequence of train to measure"):
        make(Table4(data, tmp_path, (), splits=("train",)))
    assert command(Table4(data, contact=False), "table4").endswith(f"--data {data.name} --no-contact")
