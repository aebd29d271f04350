"""`warpgarment dataset card`: the page says what the set holds."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np
import pytest
from support import sequences as synthetic_sequences

from warpgarment.training.data.card import EmptyDataset, chosen, kind_of_reason, write_card
from warpgarment.training.data.set_manifest import write_set_manifest

CMU = "mocap.cs.cmu.edu"
SLIP = "frame 9: slip 200.0 mm is over 150 mm"
DEEP = "frame 54: penetration 11.5 mm is over 10 mm"


def _add(root, number, split, category, motion, **entries):
    rng = np.random.default_rng(number)
    manifest = {
        "category": category,
        "motion": motion,
        "body": {"kind": "anny", "weight": float(rng.random()), "height": 0.5},
        "figures": {"penetration": 0.001 * number, "stretch_mean": 0.02, "layer_inside": 0.01},
        "garments": [{"name": "a", "category": category, "material": {"density": 0.1 * (1 + number), "bend": 1e-3}}],
    } | entries

    def blow(content):
        content["wind"] = np.full((5, 3), [3.0, 0.0, 4.0], np.float32)

    settings = {"frames": 5, "seed": number, "around": 8, "rings": 4, "spoil": blow if number == 1 else None}
    synthetic_sequences.write(root, f"{number:05d}_{category}", split, manifest=manifest, **settings)


@pytest.fixture
def root(tmp_path):
    root = tmp_path / "little"
    _add(root, 0, "train", "dress", "cmu_02_01")
    _add(root, 1, "train", "tshirt", "procedural:walk", cut_short=SLIP)
    _add(
        root, 2, "test", "dress", "procedural:walk", rejected_attempts=[{"reason": "frame 9: slip 0.2 mm is over 0 mm"}]
    )
    _add(
        root, 3, "train", "dress", "cmu_02_01", status="rejected", reason="frame 54: penetration 11.5 mm is over 10 mm"
    )
    configuration = {
        "recipe": "cloth3d",
        "seed": 4,
        "faces": 900,
        "wind": None,
        "held_out": ["skirt"],
        "clips": {"a": 1},
    }
    write_set_manifest(root, configuration | {"teacher": "newton"}, {"substeps": 10}, numbers=range(4))
    return root


def test_the_page_says_what_the_set_holds(root):
    """If this fails, the numbers on the page are not those of the set, or a credit that is due is missing."""
    before = sorted(path.name for path in root.iterdir())
    path = write_card(root, root.parent / "page", pictures=2, size=(48, 64))
    assert sorted(p.name for p in root.iterdir()) == before, "written into the data set although told not to"
    text = path.read_text()
    assert text.startswith("# little\n\n3 simulated sequences of clothed, moving bodies: 15 frames at 30 a second.")
    assert "| dress | 1 | 5 | 1 | 5 | 2 | 10 |" in text
    assert "| together | 2 | 10 | 1 | 5 | 3 | 15 |" in text
    options = "--sequences 4 --recipe cloth3d --seed 4 --faces 900 --held-out skirt --motions CLIPS --teacher newton"
    assert f"warpgarment generate --out DIR {options}\n" in text
    assert "Motions: cmu_02_01 (1), procedural:walk (2)." in text
    assert "| deepest vertex [mm] | 3 | 1 | 0 |" in text
    assert "| layer inside | 3 | 0.01 |" in text
    assert "| gusts [m/s] | 1 | 5 | 5 |" in text
    assert "| density [kg/m²] | 3 | 0.2 | 0.1 |" in text
    assert "2 attempts were rejected; 1 of the sequences above end early" in text
    assert "| penetration | 1 |" in text
    assert "| slip | 1 |" in text
    assert CMU in text
    assert "NSF EIA-0196217" in text
    assert "Anny" in text
    assert "Newton" in text
    drawn = {p.name for p in (path.parent / "card").iterdir()}
    assert drawn == {f"{name}.png" for name in ("sequences", "bodies", "figures", "materials", "wind", "rejections")}
    assert all(f"(card/{name})" in text for name in drawn)
    sheet = iio.imread(path.parent / "card" / "sequences.png")
    assert sheet.shape == (64 + 22, 2 * 48, 3)
    assert sheet.std() > 10, "the pictures are empty"


def test_credits_are_for_what_was_used(tmp_path):
    """If this fails, the page thanks for motions that nobody used, or fails on a plain set made by other means."""
    synthetic_sequences.write(tmp_path / "plain", "a", frames=3, around=8, rings=4)
    text = write_card(tmp_path / "plain", pictures=1, size=(32, 40)).read_text()
    assert (tmp_path / "plain" / "card" / "sequences.png").exists()
    assert CMU not in text
    assert "Anny" not in text
    assert "their licences are not known here" in text  # the motion is called "sway"
    assert "Bodies: capsule (1)." in text
    again = write_card(tmp_path / "plain", pictures=1, size=(32, 40)).read_text()
    assert again == text, "the card is counted as part of the set"


def test_the_sheet_shows_every_category(tmp_path):
    """If this fails, the pictures show dresses only."""
    categories = ["dress"] * 30 + ["tshirt", "skirt"] * 2
    good = {tmp_path / str(k): {"category": c} for k, c in enumerate(categories)}
    shown = [good[path]["category"] for path in chosen(good, 6)]
    assert shown == ["dress", "tshirt", "skirt"] * 2
    assert len(chosen(good, 100)) == 34
    assert chosen(good, 1) == [tmp_path / "0"]
    few = {path: good[path] for path in list(good)[20:32]}  # ten dresses, a T-shirt and a skirt
    assert len(set(chosen(few, 12))) == 12


@pytest.mark.parametrize(
    ("reason", "kind"),
    [
        (DEEP, "penetration"),
        ("frame 0: stretch_p99 30.4% is over 30%", "stretch_p99"),
        ("frame 3: 12 vertices are not finite", "N vertices are not finite"),
        ("no boundary loop at 0.35 of the height. Choose another.", "no boundary loop at N of the height"),
    ],
)
def test_reasons_are_counted_without_their_numbers(reason, kind):
    """If this fails, every rejection is a kind of its own."""
    assert kind_of_reason(reason) == kind


def test_a_set_without_good_sequences(tmp_path):
    """If this fails, an empty page is written, or a traceback."""
    with pytest.raises(FileNotFoundError, match="warpgarment generate"):
        write_card(tmp_path / "nowhere")
    _add(tmp_path, 3, "train", "dress", "x", status="rejected", reason="frame 1: slip")
    with pytest.raises(EmptyDataset, match="no good sequence"):
        write_card(tmp_path)
    assert not (tmp_path / "card.md").exists()
