"""If these failed, users would not see what a file holds before it is simulated, or be told something else."""

from __future__ import annotations

import numpy as np
import pytest
from support.meshes import capsule, skirt

import warpgarment as wg
from warpgarment.cli import main
from warpgarment.io.obj import obj_text
from warpgarment.objects.facts import Facts

BODY, CLOTH = capsule((0, 0.2, 0), (0, 1.5, 0), 0.18), skirt(16, 6)
FRAMES = BODY.vertices + np.arange(5, dtype=np.float32)[:, None, None] * np.float32([0, 0, 0.01])


def rows(text):
    """Rows of a table by their title: cells of the columns."""
    lines = text.splitlines()
    start = next(k for k, line in enumerate(lines) if set(line) == {"-"})
    found = {}
    for line in lines[start + 1 :]:
        if not line.strip():
            break
        title, *cells = [cell.strip() for cell in line.split("  ") if cell.strip()]
        found[title] = cells
    return found


def panels(path):
    """The skirt as two panels in an OBJ of two objects, in centimetres."""
    left = CLOTH.vertices[CLOTH.faces].mean(1)[:, 0] < 0
    text, base = "", 0
    for name, side in (("Front", left), ("Back", ~left)):
        used, local = np.unique(CLOTH.faces[side], return_inverse=True)
        text += obj_text(100 * CLOTH.vertices[used], local.reshape(-1, 3) + base, name)
        base += len(used)
    path.write_text(text)
    return base


def test_simulate_shows_what_it_will_simulate(tmp_path, capsys):
    """A garment in another unit, or a body at an assumed rate, would be seen only afterwards."""
    count = panels(tmp_path / "skirt.obj")
    wg.BodyMotion(FRAMES, BODY.faces, 30).save(tmp_path / "b.pc2")
    arguments = ["simulate", str(tmp_path / "skirt.obj"), str(tmp_path / "b.pc2"), "--unit", "cm", "--clean"]
    arguments += ["--garment-mesh", "*", "--device", "cpu", "--out", str(tmp_path / "o.npz")]
    assert main(arguments) == 0
    heard = capsys.readouterr()
    table = rows(heard.out)
    width, height, depth = np.ptp(CLOTH.vertices, axis=0)
    assert table["file"] == ["skirt.obj", "b.pc2"]
    assert table["object"] == ["all 2: Front, Back", "b"]
    assert table["pieces"] == ["1", "1"]
    assert table["vertices"] == [str(count), str(len(BODY.vertices))]
    assert table["faces"] == [str(len(CLOTH.faces)), str(len(BODY.faces))]
    assert table["seams"] == [f"{count - len(CLOTH.vertices)} vertices joined", "-"]
    assert table["size x, y, z [m]"][0] == f"{width:.3g} x {height:.3g} x {depth:.3g}"
    assert table["unit"] == ["cm, given", "m, assumed"]
    assert table["up"] == ["Y, assumed", "Y, assumed"]
    assert table["rate [fps]"] == ["-", "30, assumed"]
    assert table["frames"] == ["-", "5"]
    assert table["duration [s]"] == ["-", "0.133"]
    assert "vertices on open borders" in heard.err
    assert wg.GarmentMotion.load(tmp_path / "o.npz").vertices.shape == (5, count, 3)


def test_a_seam_that_is_not_joined_is_said_with_the_option(tmp_path, capsys):
    """The remedy would be named in Python's words on the command line."""
    panels(tmp_path / "skirt.obj")
    wg.BodyMotion(FRAMES, BODY.faces, 30).save(tmp_path / "b.npz")
    arguments = ["simulate", str(tmp_path / "skirt.obj"), str(tmp_path / "b.npz"), "--unit", "cm", "--device", "cpu"]
    assert main([*arguments, "--garment-mesh", "*", "--frames", "2", "--out", str(tmp_path / "o.npz")]) == 0
    heard = capsys.readouterr()
    assert "If they are the sides of seams, --clean joins them." in heard.err
    assert rows(heard.out)["seams"][0].endswith("vertices at the same place, not joined")


def test_info_lists_every_object_of_every_kind_of_file(tmp_path, capsys):
    """What can be named with --mesh could not be found out, or a file of several objects would be an error."""
    text = obj_text(BODY.vertices, BODY.faces, "Avatar") + obj_text(
        CLOTH.vertices, CLOTH.faces + len(BODY.vertices), "Skirt"
    )
    (tmp_path / "scene.obj").write_text(text)
    assert main(["info", str(tmp_path / "scene.obj")]) == 0
    table = rows(capsys.readouterr().out)
    assert table["object"] == ["Avatar of 2: Avatar, Skirt", "Skirt of 2: Avatar, Skirt"]
    assert table["faces"] == [str(len(BODY.faces)), str(len(CLOTH.faces))]
    assert main(["info", str(tmp_path / "scene.obj"), "--mesh", "Skirt", "--up", "z", "--unit", "cm"]) == 0
    table = rows(capsys.readouterr().out)
    x, y, z = 0.01 * np.ptp(CLOTH.vertices, axis=0)
    assert table["size x, y, z [m]"] == [f"{x:.3g} x {z:.3g} x {y:.3g}"]
    assert (table["up"], table["unit"]) == (["Z, given"], ["cm, given"])
    for name in ("m.npz", "m.pc2", "m"):
        wg.BodyMotion(FRAMES, BODY.faces, 24).save(tmp_path / name)
        assert main(["info", str(tmp_path / name), *(() if name == "m.npz" else ("--fps", "24"))]) == 0
        table = rows(capsys.readouterr().out)
        assert table["rate [fps]"] == ["24, from the file" if name == "m.npz" else "24, given"]
        assert table["frames"] == ["5"]
        assert table["duration [s]"] == ["0.167"]
    assert main(["info", str(tmp_path / "nothing.obj")]) == 2
    assert main(["info", str(tmp_path / "scene.obj"), "--mesh", "Shirt"]) == 2
    assert "no mesh named 'Shirt'" in capsys.readouterr().err


def test_info_of_formats_that_say_more(tmp_path, capsys):
    """The unit, axis and rate that a stage or a scene states would be called assumed."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    wg.BodyMotion(FRAMES, BODY.faces, 24).save(tmp_path / "m.usda")
    stage = Usd.Stage.Open(str(tmp_path / "m.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.Save()
    assert main(["info", str(tmp_path / "m.usda")]) == 0
    table = rows(capsys.readouterr().out)
    assert table["unit"] == ["cm, from the file"]
    assert table["up"] == ["Z, from the file"]
    assert table["rate [fps]"] == ["24, from the file"]
    import trimesh

    scene = trimesh.Scene(
        {"Avatar": trimesh.Trimesh(*BODY, process=False), "Skirt": trimesh.Trimesh(*CLOTH, process=False)}
    )
    scene.export(tmp_path / "two.glb")
    assert main(["info", str(tmp_path / "two.glb")]) == 0
    table = rows(capsys.readouterr().out)
    assert [cell.split()[0] for cell in table["object"]] == ["Avatar", "Skirt"]
    assert table["unit"][0] == "m, from the file"


def test_facts_are_data():
    """What the table shows could not be asked for in Python. Pieces, size and duration by hand."""
    facts = Facts.of(wg.BodyMotion(FRAMES, BODY.faces, 24))
    assert (facts.frames, facts.fps, facts.pieces) == (5, 24, 1)
    assert facts.seconds == pytest.approx(4 / 24)
    assert facts.size == pytest.approx(np.ptp(BODY.vertices, axis=0), abs=1e-6)
    assert Facts.of(wg.Garment(*CLOTH)).source is None
