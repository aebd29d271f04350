"""The examples run, in a shorter setting, and print what they promise."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.outfits import layersnet
from support.runs import entries_of

import warpgarment as wg
from warpgarment.nn import checkpoint
from warpgarment.objects.motion import GarmentMotion

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def _run(name: str, **settings) -> None:
    runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](**settings)


def test_every_example_is_tested() -> None:
    """An example would not be run by any test, and break unnoticed."""
    tested = Path(__file__).read_text()
    assert all(f'"{path.stem}"' in tested for path in EXAMPLES.glob("*.py"))


def test_first_rollout(tmp_path, capsys) -> None:
    """The first thing a reader tries fails, or prints no figures."""
    _run("01_first_rollout", out=tmp_path, frames=4)
    assert "mean vertex error" in capsys.readouterr().out
    assert {p.name for p in tmp_path.iterdir()} == {"dress.usd", "dress.png"}


def test_own_garment_own_body(tmp_path, capsys) -> None:
    """Files in centimetres, or a body that is not a person, would be simulated wrongly: over 1 cm inside the body."""
    _run("02_own_garment_own_body", out=tmp_path, frames=4)
    printed = capsys.readouterr().out
    assert float(printed.split("deepest penetration ")[1].split(" mm")[0]) < 10
    assert {"bottle.pc2", "sleeve.obj", "sleeve.usd", "sleeve.png"} <= {p.name for p in tmp_path.iterdir()}


def test_batch(tmp_path, capsys) -> None:
    """A batch gives another result than its members one by one: more than 1 mm apart after 3 frames."""
    _run("03_batch", out=tmp_path, frames=4)
    apart = [
        float(line.split(" mm from")[0].split()[-1])
        for line in capsys.readouterr().out.splitlines()
        if " mm from" in line
    ]
    assert len(apart) == 4
    assert max(apart) < 1.0


def test_live_body(tmp_path, capsys) -> None:
    """Streaming stops early or loses frames."""
    _run("04_live_body", out=tmp_path, frames=5)
    assert "5 frames on" in capsys.readouterr().out
    motion = GarmentMotion.load(tmp_path / "tshirt.npz")
    assert motion.frames == 5
    assert np.isfinite(motion.vertices).all()


def test_train_on_own_data(tmp_path, capsys) -> None:
    """A sequence written as the example says cannot be trained on: losses are not finite, or do not fall. On average
    over three entries of the log: single ones are of two samples each."""
    _run("05_train_on_own_data", out=tmp_path, frames=16, steps=24, batch_size=2)
    losses = np.array([entry["loss"] for entry in entries_of(tmp_path / "run")])
    assert len(losses) == 6
    assert np.isfinite(losses).all()
    assert losses[3:].mean() < 0.9 * losses[:3].mean()
    printed = capsys.readouterr().out
    assert f"loss {losses[-1]:.3f}" in printed
    assert np.isfinite(float(printed.split(" cm from the truth")[0].split()[-1]))


def test_layered_outfit_in_the_wind(tmp_path, capsys) -> None:
    """Layers of the example cross, or are not counted; or a network that reads wind gets none: another motion."""
    _run("06_layered_outfit_in_the_wind", out=tmp_path / "still", frames=4, weights="fast")
    printed = capsys.readouterr().out
    assert "this network reads neither materials nor wind" in printed
    for name in ("dress", "jacket"):
        assert f"{name:8} 4 frames, 4 of them counted, 0 with crossing triangles, held back by up to " in printed
    assert {p.name for p in (tmp_path / "still").iterdir()} == {
        *("outfit.png", "dress.pc2", "dress.obj", "jacket.pc2", "jacket.obj")
    }
    checkpoint.save(layersnet(), tmp_path / "windy.safetensors")
    _run("06_layered_outfit_in_the_wind", out=tmp_path / "windy", frames=3, weights=tmp_path / "windy.safetensors")
    assert "reads neither" not in capsys.readouterr().out
    assets = wg.demo.assets()
    assert assets.outfit is not None
    outfit = wg.Outfit(assets.outfit.outfit.garments, [wg.Material.cotton(), wg.Material.denim()])
    still = wg.Simulator.from_pretrained(tmp_path / "windy.safetensors").rollout(
        outfit, assets.collider, first_vertices=assets.outfit.first_vertices, frames=3
    )
    for motion in still:
        found = GarmentMotion.load(tmp_path / "windy" / f"{motion.name}.pc2", fps=30.0)
        assert np.abs(found.vertices[1:] - motion.vertices[1:]).max() > 1e-5


def test_wind_that_lifts_a_hem(tmp_path, capsys) -> None:
    """Gradient descent does not come to the lift that was asked for, or the wind it finds does not lift the hem in an
    ordinary rollout: 1 cm in six frames, within 1 mm, from a wind that lifts it by 3 mm."""
    _run("08_wind_that_lifts_a_hem", out=tmp_path, frames=6, lift=0.01, steps=4)
    printed = capsys.readouterr().out
    assert float(printed.split("an ordinary rollout lifts the hem by ")[1].split(" cm")[0]) == pytest.approx(1, abs=0.1)
    assert {p.name for p in tmp_path.iterdir()} == {"hem.png", "dress.pc2", "dress.obj"}


def test_newton_humanoid(tmp_path, capsys) -> None:
    """The solver for Newton does not run in a script, or the humanoid comes out of its dress: over 2 cm deep."""
    _run("09_newton_humanoid", out=tmp_path, seconds=0.2, substeps=1, around=20, rings=12)
    printed = capsys.readouterr().out
    assert printed.startswith("7 frames of 2 worlds")
    assert float(printed.split("at the end ")[1].split(" mm")[0]) < 20
    assert {f"{what}_{world}.usd" for what in ("dress", "humanoid") for world in (0, 1)} <= {
        path.name for path in tmp_path.iterdir()
    }


def test_a_hundred_garments(tmp_path, capsys) -> None:
    """Garments that were cut are no garments, or go into the body: deeper than 5 mm in the last of three frames."""
    _run("07_a_hundred_garments", out=tmp_path, count=5, frames=3)
    printed = capsys.readouterr().out
    assert "5 garments" in printed
    assert float(printed.split(" mm deep at most")[0].split()[-1]) < 5
    assert min(Image.open(tmp_path / "hundred.png").size) > 200
