"""The demo: what ships fits together, and its files and table say what the rollout did."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import ipctk
import numpy as np
import pytest
from pxr import Usd, UsdGeom
from support.outfits import layersnet

from warpgarment import demo
from warpgarment.errors import MeshError
from warpgarment.metrics import mean_vertex_error
from warpgarment.nn import checkpoint
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.outfit import Outfit
from warpgarment.sim.simulator import Simulator
from warpgarment.training.generate import demo_outfit
from warpgarment.training.generate.recipes import GenerateConfig, plan_sequence
from warpgarment.training.rollouts import skinned
from warpgarment.view.report import table


@pytest.fixture(scope="module")
def bundle() -> demo.DemoAssets:
    return demo.assets()


def test_assets_fit_together(bundle) -> None:
    """Garments of other lengths than the body, or draped somewhere else: nothing would line up.

    Every garment vertex is within 40 cm of the body, and at least 150 frames can be compared.
    """
    assert set(bundle.garments) == {"dress", "tshirt"}
    assert bundle.collider.frames == bundle.body.frames >= 150
    assert len(bundle.collider.faces) < len(bundle.body.faces)
    for item in bundle.garments.values():
        assert item.truth.vertices.shape == (bundle.body.frames, *item.garment.vertices.shape)
        assert np.isfinite(item.truth.vertices).all()
        for t in (0, 100):
            apart = np.linalg.norm(item.truth.vertices[t][:, None] - bundle.body.vertices[t][None], axis=-1).min(1)
            assert apart.max() < 0.40


def test_the_network_that_ships_moves_like_cloth(bundle) -> None:
    """Weights that do not fit the code any more, or a worse network by mistake: three seconds on motion it never saw,
    at most half as far from the simulation as the garment skinned to the body, with no vertex inside.
    """
    frames = 90
    body = BodyMotion(bundle.collider.vertices[:frames], bundle.collider.faces, bundle.collider.fps)
    simulator = Simulator.from_pretrained(device="cpu")
    for item in bundle.garments.values():
        truth = item.truth.vertices[:frames]
        found = simulator.rollout(item.garment, body, first_vertices=item.first_vertices)
        moved = skinned(item.garment, item.first_vertices, body)
        assert mean_vertex_error(found.vertices, truth) < 0.5 * mean_vertex_error(moved, truth)
        assert max(status.max_penetration for status in found.status) < 1e-4


def test_demo_writes_what_it_prints(tmp_path, capsys, bundle) -> None:
    """Files that hold something else than the rollout, or a table whose figures are not its figures.

    Read back with USD's own library and from PC2; the error recomputed in NumPy, to the two digits printed.
    """
    motions = demo.run(tmp_path / "demo", device="cpu", frames=4, moments=2)
    printed = capsys.readouterr().out
    names = {"rollout.png", "outfit.png", "outfit.usd", "demo.mp4"} | {
        f"{n}.{s}" for n in ("dress", "tshirt") for s in ("usd", "pc2", "obj")
    }
    assert {p.name for p in (tmp_path / "demo").iterdir()} == names
    first, second = printed.split("faces ")[1:]
    rows = {line.split("  ")[0].strip(): line.split()[-2:] for line in first.splitlines()}
    layers = [motions.pop(f"outfit {name}") for name in ("dress", "jacket")]
    assert "outfit of dress under jacket, network 'layers'\n" in printed
    below = {line.split("  ")[0].strip(): line.split()[-2:] for line in second.splitlines()}
    for row, of in (
        ("crossing pairs with other garments, most", "layer"),
        ("crossing pairs with itself, most", "self"),
    ):
        found = [max(getattr(s, f"{of}_crossings") for s in motion.status) for motion in layers]
        assert below[row] == [str(count) for count in found] == ["0", "0"]
    for stage in ("features", "network", "singular values", "poisson", "collision"):
        assert all(float(cell) > 0 for cell in rows[f"{stage} [ms/frame]"])
    assert rows["frames"] == ["4", "4"]
    for column, (name, motion) in enumerate(motions.items()):
        truth = bundle.garments[name].truth.vertices[:4].astype(np.float64)
        error = 100 * np.linalg.norm(motion.vertices - truth, axis=-1).mean()
        assert float(rows["mean vertex error [cm]"][column]) == pytest.approx(error, abs=0.006)
        depth = 1e3 * max(s.max_penetration for s in motion.status)
        assert float(rows["deepest penetration [mm]"][column]) == pytest.approx(depth, abs=0.06)
        np.testing.assert_array_equal(BodyMotion.load(tmp_path / "demo" / f"{name}.pc2").vertices, motion.vertices)
        stage = Usd.Stage.Open(str(tmp_path / "demo" / f"{name}.usd"))
        meshes = {p.GetName(): UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)}
        for part, expected in ((name, motion.vertices), ("body", bundle.body.vertices[:4])):
            points = [np.array(meshes[part].GetPointsAttr().Get(t)) for t in range(4)]
            np.testing.assert_array_equal(np.stack(points), expected)
    stage = Usd.Stage.Open(str(tmp_path / "demo" / "outfit.usd"))
    for motion in layers:
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/root/{motion.name}"))
        np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get(3)), motion.vertices[3])


def test_the_outfit_is_of_the_test_split(bundle) -> None:
    """An outfit of the training data, in another material or wind, or one that crosses at the start: by ipctk."""
    item = bundle.outfit
    assert item is not None
    plan = plan_sequence(GenerateConfig(Path("."), recipe="layers", faces=demo_outfit.FACES), demo_outfit.NUMBER)
    assert plan.split == "test"
    assert [garment.name for garment in item.outfit] == [p.category for p in plan.outfit.layers] == ["dress", "jacket"]
    assert item.outfit.materials == plan.materials
    assert plan.wind is not None
    blown = plan.wind.velocities(bundle.body.frames, bundle.body.fps)
    np.testing.assert_allclose(item.wind.velocities(bundle.body.fps), blown, atol=1e-5)
    assert sum(len(garment.faces) for garment in item.outfit) < 1600
    starts = np.cumsum([0, *(len(first) for first in item.first_vertices)])
    faces = np.concatenate([g.faces + s for g, s in zip(item.outfit, starts, strict=False)]).astype(np.int32)
    vertices = np.concatenate(item.first_vertices).astype(float)
    assert not ipctk.has_intersections(ipctk.CollisionMesh(vertices, ipctk.edges(faces), faces), vertices)
    assert (demo.ASSETS / "outfit.npz").stat().st_size < 300_000
    for other in (None, False):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            Simulator.from_pretrained("fast", device="cpu").rollout(
                Outfit(item.outfit.garments),
                bundle.collider,
                first_vertices=item.first_vertices,
                frames=1,
                layers=other,
            )


def test_the_outfit_moves_in_its_wind(tmp_path, capsys, bundle, monkeypatch) -> None:
    """A network that reads wind would move the outfit in still air, or be said not to read it, or one that ships for
    layers would not be taken. Without the wind, the same network gives another motion."""
    checkpoint.save(layersnet(), tmp_path / "layers.safetensors")
    for file in checkpoint.WEIGHTS.glob("fast.*"):
        shutil.copy(file, tmp_path)
    (tmp_path / "default.txt").write_text("fast")
    monkeypatch.setattr(checkpoint, "WEIGHTS", tmp_path)
    found = demo.run(tmp_path / "demo", device="cpu", frames=3, moments=2, film=False)
    assert "outfit of dress under jacket, network 'layers'\n" in capsys.readouterr().out
    item = bundle.outfit
    simulator = Simulator.from_pretrained("layers", device="cpu")
    for wind, same in ((item.wind, True), (None, False)):
        options = {"first_vertices": item.first_vertices, "wind": wind, "frames": 3}
        expected = simulator.rollout(item.outfit, bundle.collider, **options)
        for motion in expected:
            assert np.array_equal(found[f"outfit {motion.name}"].vertices, motion.vertices) == same
    (tmp_path / "layers.safetensors").unlink()
    demo.run(tmp_path / "without", device="cpu", frames=2, moments=2, film=False)
    told = "outfit of dress under jacket, network 'default', which does not read materials and wind"
    assert told in capsys.readouterr().out


def test_other_assets_are_checked(tmp_path, bundle) -> None:
    """A garment file without its ground truth ends in a KeyError."""
    bundle.body.save(tmp_path / "body.npz")
    with pytest.raises(FileNotFoundError, match=r"dress\.npz"):
        demo.assets(tmp_path)
    dress = bundle.garments["dress"].garment
    np.savez(tmp_path / "dress.npz", rest_vertices=dress.vertices, faces=dress.faces, pins=dress.pins)
    with pytest.raises(MeshError, match="no array named 'truth'"):
        demo.assets(tmp_path)


def test_table_lines_up() -> None:
    """Columns that cannot be read."""
    text = table(["", "a", "long name"], [["first", 1, 2.5], ["x", "wide cell", ""]])
    assert text.splitlines() == [
        "               a  long name",
        "---------------------------",
        "first          1        2.5",
        "x      wide cell",
    ]
