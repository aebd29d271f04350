"""The demo: what ships fits together, and its files and table say what the rollout did."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from warpgarment import demo
from warpgarment.errors import MeshError
from warpgarment.metrics import mean_vertex_error
from warpgarment.objects.body import BodyMotion
from warpgarment.sim.simulator import Simulator
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
    names = {"rollout.png", "demo.mp4"} | {f"{n}.{s}" for n in ("dress", "tshirt") for s in ("usd", "pc2", "obj")}
    assert {p.name for p in (tmp_path / "demo").iterdir()} == names
    rows = {line.split("  ")[0].strip(): line.split()[-2:] for line in printed.splitlines()}
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
