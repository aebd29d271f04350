"""Plans carried out up to the simulation: cuts that are open, layers and wind in the scene, torn motions cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warpgarment.training.generate import placement
from warpgarment.training.generate.recipes import GenerateConfig, plan_sequence
from warpgarment.training.generate.run import prepare


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    return GenerateConfig(
        out=tmp_path_factory.mktemp("unused"), frames=20, faces=500, bodies="bundled", procedural_share=1.0,
        least_frames=5, categories=("top", "skirt"),
    )  # fmt: skip


def test_cuts_are_open_when_the_simulation_begins(config):
    """If this fails, the two sides of a cut start at one place, and self-contact tears them apart."""
    seams = replace(config, recipe="seams", out=config.out / "seams")
    attempt = prepare(plan_sequence(seams, 0), seams)
    (cloth,) = attempt.scene.cloths
    _, place, uses = np.unique(cloth.garment.vertices, axis=0, return_inverse=True, return_counts=True)
    double = np.flatnonzero(uses[place.ravel()] == 2)
    assert len(double) > 4
    sides = cloth.start[double[np.argsort(place.ravel()[double], kind="stable")]].reshape(-1, 2, 3)
    apart = np.linalg.norm(sides[:, 0] - sides[:, 1], axis=1)
    assert np.median(apart) > 0.5 * placement.PARTED
    assert attempt.plan.cut == 0
    lengths = np.linalg.norm(cloth.garment.vertices - cloth.garment.vertices[0], axis=1)
    moved = np.linalg.norm(cloth.start - cloth.start[0], axis=1)
    assert np.abs(moved - lengths).max() < 2 * placement.PARTED  # otherwise moved rigidly


def test_an_outfit_comes_with_its_materials_and_the_wind(config):
    """If this fails, layers are simulated as one garment, all of one cloth, or without the air."""
    layers = replace(config, recipe="layers", out=config.out / "layers")
    number = next(n for n in range(40) if (p := plan_sequence(layers, n)).wind and len(p.outfit.layers) == 2)
    attempt = prepare(plan_sequence(layers, number), layers)
    scene, arrays = attempt.scene, attempt.arrays
    assert [c.garment.name for c in scene.cloths] == attempt.plan.category.split("+")
    assert scene.cloths[0].material != scene.cloths[1].material
    assert scene.wind.shape == (len(scene), 3)
    np.testing.assert_array_equal(arrays["wind"], scene.wind)
    np.testing.assert_array_equal(arrays["garment_starts"], scene.starts)
    assert len(arrays["garment_rest_vertices"]) == scene.starts[-1]
    assert arrays["garment_faces"].max() == scene.starts[-1] - 1


def test_the_longest_stretch_that_is_whole_is_kept(config, monkeypatch):
    """If this fails, lost markers are simulated, or a motion is thrown away for one frame of them."""
    plan = plan_sequence(config, 0)
    _, whole, _ = placement.body_motion(plan, config)
    monkeypatch.setattr(placement, "jumps", lambda body, poses: np.arange(len(poses)) == 6)
    _, cut, _ = placement.body_motion(plan, config)
    assert len(whole) - len(cut) == 7
    monkeypatch.setattr(placement, "jumps", lambda body, poses: np.arange(len(poses)) % 4 == 0)
    with pytest.raises(placement.UnusableMotion, match="jumps in 5; 3 in a row"):
        placement.body_motion(plan, config)
