"""`view --browser` and `simulate --browser`: what they show, what they refuse, on a page that is closed at once."""

from __future__ import annotations

import numpy as np
import pytest
from support.scenes import network, skirt, walk

import warpgarment as wg
from warpgarment import cli
from warpgarment.kernels.features.channels import OUTDOOR
from warpgarment.nn import checkpoint
from warpgarment.view.browser.page import Browser

pytest.importorskip("viser", reason='the page needs viser: pip install "warpgarment[browser]"')


@pytest.fixture
def shown(monkeypatch):
    """The page of the command, which is closed as soon as it would be waited for."""
    pages: list[Browser] = []

    def wait(page: Browser) -> None:
        pages.append(page)
        raise KeyboardInterrupt

    monkeypatch.setattr(Browser, "wait", wait)
    return pages


@pytest.fixture
def files(tmp_path):
    """A body, a garment, its motion, another result, and a network that reads wind and materials, as files."""
    body, garment = walk(8), skirt()
    body.save(tmp_path / "body.npz")
    garment.save(tmp_path / "skirt.npz")
    moved = np.repeat(garment.vertices[None], 8, axis=0)
    wg.GarmentMotion(moved, garment.faces, 30.0, name="skirt").save(tmp_path / "motion.npz")
    wg.GarmentMotion(moved * np.float32(1.1), garment.faces, 30.0, name="skirt").save(tmp_path / "other.npz")
    checkpoint.save(network(outdoor=OUTDOOR.names), tmp_path / "network.safetensors")
    return tmp_path


def test_view_shows_what_it_is_given(files, shown, capsys) -> None:
    """The page would lack the second result, the garment at rest, or the body."""
    told = ["--body", files / "body.npz", "--beside", files / "other.npz", "--rest", files / "skirt.npz", "--port", "0"]
    assert cli.main(["view", str(files / "motion.npz"), "--browser", *map(str, told)]) == 0
    (page,) = shown
    first, second = page.stage.sides
    assert first.body is not None
    np.testing.assert_array_equal(first.body.frames, walk(8).vertices)
    np.testing.assert_array_equal(first.garments[0].rest, skirt().vertices)
    np.testing.assert_allclose(second.garments[0].frames, 1.1 * first.garments[0].frames, atol=1e-6)
    assert second.x - first.x > np.ptp(first.garments[0].frames[..., 0])
    assert page.url in capsys.readouterr().out


def test_a_file_with_several_meshes_is_shown_whole(tmp_path, shown) -> None:
    """An outfit's stage would need a name for each of its meshes, or its body be coloured as a garment."""
    from warpgarment.io.usd import write_usd

    body, garment = walk(5), skirt()
    moved = np.repeat(garment.vertices[None], 5, axis=0)
    meshes = [("inner", moved, garment.faces), ("outer", moved * 1.1, garment.faces)]
    write_usd(tmp_path / "outfit.usd", [*meshes, ("body", body.vertices, body.faces)], 30.0)
    assert cli.main(["view", str(tmp_path / "outfit.usd"), "--browser", "--port", "0"]) == 0
    (side,) = shown[0].stage.sides
    assert [part.name for part in side.garments] == ["inner", "outer"]
    assert side.body is not None
    np.testing.assert_allclose(side.body.frames, body.vertices, atol=1e-6)


def test_simulate_is_live(files, shown) -> None:
    """The page would show a run with other settings than the command's."""
    told = ["--weights", files / "network.safetensors", "--browser", "--port", "0", "--frames", "4"]
    command = ["simulate", str(files / "skirt.npz"), str(files / "body.npz"), *map(str, told)]
    assert cli.main([*command, "--wind", "0", "0", "-4", "--material", "denim"]) == 0
    (page,) = shown
    assert page.live is not None
    settings = page.live.settings
    assert settings.materials == (wg.Material.denim(),)
    np.testing.assert_allclose(settings.wind.rows, [[0, 0, -4]])
    assert (page.live.speed.value, page.live.angle.value) == (4.0, 0.0), "it blows from the front"
    assert page.playhead.frames == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["view", "motion.npz", "--browser", "--out", "x.png"], "--browser and --out"),
        (["view", "motion.npz", "--beside", "other.npz"], "give them with --browser"),
        (["view", "motion.npz", "--browser", "--rest", "skirt.npz", "skirt.npz"], "2 meshes for 1 garments"),
        (["view", "motion.npz", "--browser", "--port", "99999"], "between 0 and 65535"),
        (["view", "missing.npz", "--browser"], "No such file"),
        (["simulate", "skirt.npz", "body.npz", "--browser", "--out", "x.npz"], "Leave one of them out"),
        (["simulate", "skirt.npz", "body.npz", "--browser", "--wind", "0", "0", "1"], "reads no wind"),
        (["simulate", "--jobs", "jobs.jsonl", "--browser"], "--browser and --jobs"),
    ],
)
def test_what_cannot_be_is_one_line(files, shown, capsys, monkeypatch, arguments, message) -> None:
    """A traceback, or a page without what was asked for, in place of a line that says what to do."""
    monkeypatch.chdir(files)
    assert cli.main(arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warpgarment:")]
    assert len(lines) == 1
    assert message in lines[0]
    assert not shown


def test_the_extra_is_named_where_it_is_missing(files, shown, capsys, monkeypatch) -> None:
    """A ModuleNotFoundError says nothing of what to install."""
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert cli.main(["view", str(files / "motion.npz"), "--browser"]) == 2
    assert 'pip install "warpgarment[browser]"' in capsys.readouterr().err
