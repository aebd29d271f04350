"""Outfits on the command line: several garments, materials, wind, an output for each, and what is not certified."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from alembic3d import Abc, AbcGeom
from pxr import Usd, UsdGeom
from support.outfits import layersnet
from support.scenes import network, tube, walk

from warpgarment import cli
from warpgarment.cli.outdoors import materials_of, wind_of
from warpgarment.cli.pieces import pieces_of
from warpgarment.errors import UsageError
from warpgarment.io.obj import obj_text
from warpgarment.nn import checkpoint
from warpgarment.objects.garment import Garment
from warpgarment.objects.material import Material
from warpgarment.objects.motion import GarmentMotion
from warpgarment.objects.outfit import Outfit
from warpgarment.objects.wind import Wind
from warpgarment.sim.simulator import Simulator


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Two skirts over each other, a body and two networks as files."""
    folder = tmp_path_factory.mktemp("outfit")
    for k, name in enumerate(("under", "over")):
        vertices, faces = tube(16, 7, bottom=-0.3, top=0.3 - 0.01 * k, radius=(0.3 + 0.012 * k, 0.19 + 0.012 * k))
        (folder / f"{name}.obj").write_text(obj_text(vertices, faces, name))
    walk(4).save(folder / "body.npz")
    checkpoint.save(network(), folder / "plain.safetensors")
    checkpoint.save(layersnet(), folder / "windy.safetensors")
    return folder


def garments(folder) -> list[Garment]:
    return [Garment.load(folder / f"{name}.obj") for name in ("under", "over")]


def simulate(folder, *words, weights="plain", files=("under.obj", "over.obj", "body.npz")) -> int:
    start = ["simulate", *(str(folder / file) for file in files), "--device", "cpu"]
    return cli.main([*start, "--weights", str(folder / f"{weights}.safetensors"), *map(str, words)])


def refused(capsys, *arguments, **options) -> str:
    """Runs a verb that must fail with status 2; returns its only line on stderr."""
    assert simulate(*arguments, **options) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warpgarment:")]
    assert len(lines) == 1
    return lines[0]


def test_layers_are_simulated_and_written_each(scene, tmp_path, capsys):
    """Garments would not see each other, or be written to each other's files. The same bits as from Python, in files of
    their own; the table has both garments, their crossings, and the summary says that they are free."""
    assert simulate(scene, "--layers", "--out", tmp_path / "new" / "{name}.npz", "--out-fps", "network") == 0
    printed = capsys.readouterr().out
    simulator = Simulator(checkpoint.load(scene / "plain.safetensors"), "cpu")
    simulator.timings.synchronise = True
    expected = simulator.rollout(Outfit(garments(scene)), walk(4))
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"under.npz", "over.npz"}
    for name, motion in zip(("under", "over"), expected, strict=True):
        found = GarmentMotion.load(tmp_path / "new" / f"{name}.npz")
        np.testing.assert_array_equal(found.vertices, motion.vertices)
        assert f"{name}: free of crossings in every frame" in printed
    rows = {line.split("  ")[0].strip(): line.split()[-2:] for line in printed.splitlines() if line}
    assert rows["crossing pairs with other garments, most"] == ["0", "0"]
    assert rows["lag, most [mm]"] == [f"{1e3 * max(s.lag for s in m.status[1:]):.1f}" for m in expected]
    titles = [line.split() for line in printed.splitlines() if line.split()[:2] == ["under", "over"]]
    assert titles == [["under", "over", "body"], ["under", "over", "all"]]


def test_all_garments_go_into_one_stage(scene, tmp_path, capsys):
    """A USD would hold one garment, or a rate of its own; without --layers it would not be said that they cross."""
    assert simulate(scene, "--out", tmp_path / "o.usda") == 0
    assert "without --layers, garments do not see each other" in capsys.readouterr().out
    expected = Simulator(checkpoint.load(scene / "plain.safetensors"), "cpu").rollout(garments(scene), walk(4))
    stage = Usd.Stage.Open(str(tmp_path / "o.usda"))
    assert stage.GetTimeCodesPerSecond() == 30
    for name, motion in zip(("under", "over"), expected, strict=True):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/root/{name}"))
        np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get(3)), motion.vertices[3], atol=1e-6)


def test_all_garments_go_into_one_archive(scene, tmp_path):
    """An Alembic archive would hold one garment, inside out, or be read by its numbers of samples as seconds. Every
    frame at its time, by Alembic's own library; faces are clockwise."""
    assert simulate(scene, "--out", tmp_path / "o.abc") == 0
    expected = Simulator(checkpoint.load(scene / "plain.safetensors"), "cpu").rollout(garments(scene), walk(4))
    top = Abc.IArchive(str(tmp_path / "o.abc")).getTop()
    assert [top.getChildHeader(k).getName() for k in range(top.getNumChildren())] == ["under", "over"]
    for name, motion in zip(("under", "over"), expected, strict=True):
        schema = AbcGeom.IPolyMesh(top, name).getSchema()
        assert schema.getNumSamples() == 4
        for k in range(4):
            value = schema.getValue(Abc.ISampleSelector(k / 30))  # whole numbers would be seconds too
            np.testing.assert_allclose(np.array(value.getPositions()), motion.vertices[k], atol=1e-6)
        corners = np.array(value.getFaceIndices()).reshape(-1, 3)
        np.testing.assert_array_equal(corners[:, [0, 2, 1]], motion.faces)


def test_crossing_starts_have_a_status_of_their_own(scene, tmp_path, capsys):
    """A script would take crossing layers for free ones. The numbers of pairs are those of the rollout."""
    moved = garments(scene)[1]
    text = obj_text(moved.vertices + np.float32([0.02, 0, 0]), moved.faces, "over")
    (scene / "crossing.obj").write_text(text)
    files = ("under.obj", "crossing.obj", "body.npz")
    assert simulate(scene, "--layers", "--out", tmp_path / "{name}.npz", files=files) == cli.NOT_FREE == 3
    printed = capsys.readouterr()
    for name in ("under", "crossing"):
        status = GarmentMotion.load(tmp_path / f"{name}.npz").status
        pairs = [s.layer_crossings + s.self_crossings for s in status]
        assert pairs[0] > 0
        said = f"{name}: crosses in {np.count_nonzero(pairs)} of 4 frames (first: frame 0), {max(pairs)} pairs at most"
        assert said in printed.out
    assert "cross in the first frame" in printed.err


def test_materials_and_wind_reach_the_network(scene, tmp_path):
    """Materials would be those of other garments, or the wind blow at another rate. The same bits as from Python, with
    a row of wind for each frame of the body."""
    np.savetxt(tmp_path / "wind.csv", [[3, 0, 1], [4, 0, 1], [5, 0, 2]], delimiter=",", header="x,y,z", comments="")
    words = ["--material", "cotton", "density=0.3,bend=0.01", "--wind-file", tmp_path / "wind.csv", "--layers"]
    simulate(scene, *words, "--out", tmp_path / "{name}.npz", weights="windy")
    simulator = Simulator(checkpoint.load(scene / "windy.safetensors"), "cpu")
    outfit = Outfit(garments(scene), [Material.cotton(), Material(density=0.3, bend=0.01)])
    expected = simulator.rollout(outfit, walk(4), wind=Wind.of_velocities([[3, 0, 1], [4, 0, 1], [5, 0, 2]]))
    for name, motion in zip(("under", "over"), expected, strict=True):
        np.testing.assert_array_equal(GarmentMotion.load(tmp_path / f"{name}.npz").vertices, motion.vertices)
    simulate(scene, "--wind", "-2", "0", "1e0", "--out", tmp_path / "{name}.npz", weights="windy")
    expected = simulator.rollout(garments(scene), walk(4), wind=[-2, 0, 1])
    np.testing.assert_array_equal(GarmentMotion.load(tmp_path / "over.npz").vertices, expected[1].vertices)


def test_what_a_network_does_not_read_is_refused(scene, tmp_path, capsys):
    """The user would believe that wind or material changed the result. Nothing is written."""
    out = ["--out", tmp_path / "{name}.npz"]
    said = refused(capsys, scene, "--wind", 1, 0, 0, *out)
    assert "--wind: the network" in said
    assert "reads no wind" in said
    assert "--weights, such as layers" in said
    assert "--material: the network" in refused(capsys, scene, "--material", "cotton", *out)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--out", "o.npz"],
            "2 garments do not go into one .npz. Write them into one .usd or .abc, or each into a file of its",
        ),
        (["--out", "o/"], "{name}/ has their names"),
        (["--out", "{name}.xyz"], "cannot write 'under.xyz'"),
        (["--out", "{name}.npz", "--garment-mesh", "under"], "2 garments and 1 of --garment-mesh"),
        (["--out", "{name}.npz", "--material", "wool"], "--material wool: no material 'wool'. There are cotton, denim"),
        (["--out", "{name}.npz", "--material", "density=-1"], "density must be positive, got -1.0. Give the mass per"),
        (["--out", "{name}.npz", "--material", "weight=1"], "materials have no 'weight'. They have density"),
        (["--out", "{name}.npz", "--material", "cotton,bend"], "'bend' is no assignment of a number"),
        (["--out", "{name}.npz", "--material", *["silk"] * 3], "3 materials and 2 garments"),
        (["--out", "{name}.npz", "--wind", "0", "0", "1000"], "--wind: wind of 1,000 m/s; it must be at most 100 m/s"),
        (["--out", "{name}.npz", "--wind", "0", "nan", "1"], "velocity holds NaN or infinity"),
        (["--out", "{name}.npz", "--wind-fps", "24"], "--wind-fps without --wind-file"),
        (["--out", "{name}.npz", "--wind-file", "missing.csv"], "No such file: missing.csv"),
        (["--out", "{name}.npz", "--wind-file", __file__], "wind is read from .npz or .csv"),
    ],
)
def test_mistakes_are_one_line(scene, tmp_path, monkeypatch, capsys, words, message):
    """A traceback, or minutes of work before a mistake is told."""
    monkeypatch.chdir(tmp_path)
    assert message in refused(capsys, scene, *words, weights="windy")
    assert not list(tmp_path.iterdir())


def test_a_body_alone_is_told(scene, tmp_path, capsys):
    """One file would be taken for the body, and nothing simulated."""
    said = refused(capsys, scene, "--out", tmp_path / "a.npz", files=("body.npz",))
    assert "simulate was given one file. Name garments, innermost first, and then the body." in said


def test_names_of_garments():
    """Two garments would be written to one file, or a name leave its folder."""
    files = [Path(name) for name in ("a/shirt.obj", "b/shirt.obj", "shirt_2.obj", "s_x.obj", "s.obj")]
    named = [piece.name for piece in pieces_of(files, ())]
    assert named == ["shirt", "shirt_2", "shirt_2_2", "s_x", "s"] == list(dict.fromkeys(named))
    meshes = [(piece.mesh, piece.name) for piece in pieces_of([Path("s.usd")], ("/root/top", "..", "*"))]
    assert meshes == [("/root/top", "_root_top"), ("..", "garment"), ("*", "s")]


def test_materials_in_words_and_files(tmp_path):
    """A material would be another one than what was typed, or one for all be the first garment's."""
    assert materials_of([], 2) == []
    assert materials_of(["denim"], 3) == [Material.denim()] * 3
    assert materials_of(["none", "silk,density=0.2"], 2) == [None, Material(0.2, 63.7, 63.7, 4.9e-5)]
    (tmp_path / "m.json").write_text(json.dumps([{"density": 0.5, "friction": 0}, None, "cotton"]))
    assert materials_of([str(tmp_path / "m.json")], 3) == [Material(0.5, friction=0), None, Material.cotton()]
    for held, message in (("{", "m.json"), ('{"density": "a"}', "no object of numbers"), ("[]", "an empty list")):
        (tmp_path / "m.json").write_text(held)
        with pytest.raises(UsageError, match=message):
            materials_of([str(tmp_path / "m.json")], 1)


def test_wind_in_files(tmp_path):
    """Rows would be at another rate than the file or the user says, or a table be read as other numbers."""
    rows = np.array([[0.0, 0, 1], [0, 0, 3]])
    np.savez(tmp_path / "w.npz", velocity=rows, fps=15.0)
    found = wind_of(None, tmp_path / "w.npz", None, 24.0)
    assert found.fps == 15
    np.testing.assert_array_equal(found.rows, rows)
    assert wind_of(None, tmp_path / "w.npz", 60.0, 24.0).fps == 60
    np.savez(tmp_path / "d.npz", direction=[0, 0, 2], speed=[1.0, 3.0])
    found = wind_of(None, tmp_path / "d.npz", None, 24.0)
    assert found.fps == 24
    np.testing.assert_array_equal(found.rows, rows)
    (tmp_path / "w.csv").write_text("0, 0, 1\n\n0, 0, 3\n")
    np.testing.assert_array_equal(wind_of(None, tmp_path / "w.csv", None, 24.0).rows, rows)
    for text, message in (("x,y,z\n", "no rows"), ("1,2,3\n4,5\n", "row 2 is not x, y, z"), ("1,nan,3", "row 1 holds")):
        (tmp_path / "w.csv").write_text(text)
        with pytest.raises(UsageError, match=message):
            wind_of(None, tmp_path / "w.csv", None, 24.0)
    np.savez(tmp_path / "n.npz", vertices=rows)
    with pytest.raises(UsageError, match="no array named velocity"):
        wind_of(None, tmp_path / "n.npz", None, 24.0)
    with pytest.raises(UsageError, match="give one of them"):
        wind_of((0, 0, 1), tmp_path / "n.npz", None, 24.0)
