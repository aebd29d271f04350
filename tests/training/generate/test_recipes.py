"""Plans of data sets."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest
from support.bodies import write_bvh

from warpgarment.training.data.splits import split_of_clips, split_of_number
from warpgarment.training.generate.recipes import ConfigurationError, GenerateConfig, plan_sequence


@pytest.fixture
def config(tmp_path):
    clips = tmp_path / "clips"
    clips.mkdir()
    for k in range(24):
        joints = [("Hips", None, (0, 0, 0)), ("Head", "Hips", (0, 1, 0))]
        write_bvh(clips / f"clip_{k:02d}.bvh", joints, [[0] * 9] * (60 + 10 * k))
    return GenerateConfig(out=tmp_path / "data", motions=clips, bodies="bundled", frames=100)


def test_the_standard_set_has_the_papers_split():
    """If this fails, the standard set has another number of test sequences than the paper's protocol asks for."""
    assert Counter(map(split_of_number, range(240))) == {"train": 200, "test": 30, "validation": 10}


def test_plans_are_functions_of_their_number(config):
    """If this fails, a set cannot be made again, or in pieces."""
    for recipe in ("cloth3d", "layers", "seams"):
        settings = replace(config, recipe=recipe)
        assert plan_sequence(settings, 11) == plan_sequence(settings, 11)
        assert plan_sequence(settings, 11) != plan_sequence(settings, 11, attempt=1)
        assert plan_sequence(settings, 11) != plan_sequence(replace(settings, seed=1), 11)


def test_what_is_tested_is_never_trained_on(config):
    """If this fails, test figures flatter the network: a motion, category or body of the test was in its training."""
    plans = [plan_sequence(config, n) for n in range(240)]
    train = [p for p in plans if p.split == "train"]
    test = [p for p in plans if p.split == "test"]
    held = split_of_clips([f"clip_{k:02d}" for k in range(24)])
    assert {p.category for p in train} == {c for c in config.categories if c != "skirt"}
    assert "skirt" in {p.category for p in test}
    assert all(p.motion.startswith("procedural:") or held[p.motion] == p.split for p in plans)
    assert not {p.motion for p in test} & {p.motion for p in train}
    assert {p.body for p in train} == {"bundled"}
    assert "creature" in {p.body for p in test}
    lengths = {f"clip_{k:02d}": 60 + 10 * k for k in range(24)}
    assert all(lengths[p.motion] >= config.frames + 8 for p in test), "a test motion is too short"


def test_seams_hold_two_cuts_out(config):
    """If this fails, the cuts that are tested were trained on, or every sequence has a dress of its own."""
    plans = [plan_sequence(replace(config, recipe="seams"), n) for n in range(96)]
    cuts = {split: {p.seams for p in plans if p.split == split} for split in ("train", "test")}
    assert (len(cuts["train"]), len(cuts["test"])) == (10, 2)
    assert not cuts["train"] & cuts["test"]
    assert len({p.outfit for p in plans}) == 1


def test_layers_have_materials_and_wind(config):
    """If this fails, layered sets lack what D-LAYERS is about."""
    plans = [plan_sequence(replace(config, recipe="layers"), n) for n in range(40)]
    assert {len(p.outfit.layers) for p in plans} == {2, 3}
    assert all(len(p.materials) == len(p.outfit.layers) for p in plans)
    assert len({m for p in plans for m in p.materials}) > 40
    assert 8 < sum(p.wind is not None for p in plans) < 32
    assert all(p.wind is None for p in (plan_sequence(config, n) for n in range(40)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"categories": ("shirt",)}, "unknown garment categories"),
        ({"categories": ("skirt",)}, "none is left"),
        ({"shard": "2/2"}, "shard must be"),
        ({"workers": 0}, "workers must be at least 1"),
    ],
)
def test_options_that_do_not_fit(config, change, message):
    """If this fails, a mistake in the options shows after hours instead of at once."""
    with pytest.raises(ConfigurationError, match=message):
        replace(config, **change)


def test_a_folder_without_clips(config, tmp_path):
    """If this fails, a wrong folder silently gives procedural motions only."""
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"no \.bvh or \.npz clips"):
        replace(config, motions=tmp_path / "empty")
