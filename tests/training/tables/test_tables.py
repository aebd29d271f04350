"""Figures of the paper: no recording in a rollout, distances as geometry has them, groups that hold what they say."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support import meshes
from support import sequences as synthetic_sequences
from support import tables as table_scenes
from support.tables import table_config

from warpgarment import cli
from warpgarment.nn import checkpoint
from warpgarment.objects.garment import Garment
from warpgarment.sim.simulator import Simulator
from warpgarment.training.data.sequence import Sequence, list_sequences
from warpgarment.training.evaluate.measure import EvaluateConfig, evaluate
from warpgarment.training.tables import figure7, meshing, protocol, report
from warpgarment.training.tables.options import DataLacks, OptionMissing, TableOptions


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return table_scenes.small_set(tmp_path_factory.mktemp("set"))


@pytest.fixture(scope="module")
def network(tmp_path_factory) -> Path:
    return table_scenes.random_network(tmp_path_factory.mktemp("network") / "random.safetensors")


def spoiled(sequence: Sequence, known: int) -> Sequence:
    """The same sequence with other garment positions after the known frames."""
    other = Sequence.load(sequence.folder)
    vertices = np.array(sequence.vertices)
    vertices[known:] = vertices[known:][::-1] + np.float32(0.05)
    other.__dict__["vertices"] = vertices
    return other


class Spoiling:
    """Stands in for `Sequence` where only `load` is asked for."""

    def __init__(self, known: int) -> None:
        self.known = known

    def load(self, folder: Path) -> Sequence:
        return spoiled(Sequence.load(folder), self.known)


@pytest.mark.parametrize(("start", "known"), [("warm", 10), ("cold", 1)])
def test_recorded_frames_after_the_start_do_not_reach_a_rollout(data, network, monkeypatch, start, known):
    """Ground truth leaks into the figures: other recorded frames after the tenth (or first) must give the same
    predictions, bit for bit, in the shared protocol and in figure 7."""
    simulator = Simulator(checkpoint.load(network), "cpu")
    folder = list_sequences(data, split="test")[0]
    config = EvaluateConfig(data=data, frames=4, tables=TableOptions(faces=(90,)))
    seen: list[list[np.ndarray]] = []
    errors: list[float] = []
    for change in (False, True):
        found: list[np.ndarray] = []

        def observe(sequence, body, begun, newest, vertices, found=found):
            if begun == start:
                found.append(vertices)

        with monkeypatch.context() as patch:
            if change:
                patch.setattr(protocol, "Sequence", Spoiling(known))
            measured = protocol.measure(simulator, [folder], frames=4, baselines=False, observe=observe)
        sequence = spoiled(Sequence.load(folder), known) if change else Sequence.load(folder)
        surfaces = figure7.resolutions(simulator, sequence, sequence.body(), config, start)
        found += [surface.vertices for surface in surfaces.values()]
        seen.append(found)
        row = next(row for row in measured.rows if row["start"] == start)
        errors.append(row["network"]["mean_vertex_error_cm"])
    assert len(seen[0]) == 3
    for plain, changed in zip(*seen, strict=True):
        assert np.isfinite(plain).all()
        np.testing.assert_array_equal(plain, changed)
    assert abs(errors[0] - errors[1]) > 1.0  # the figures did look at the changed recording


def test_surface_distance_of_spheres():
    """The distance of figure 7 is wrong: concentric spheres of radius 1 and 1.1 are 0.1 apart whatever their meshes,
    and a sphere meshed otherwise is hardly apart from itself. 2 mm: how far flat faces lie inside the sphere."""
    fine, finer = meshes.icosphere(4, radius=1.0), meshes.icosphere(5, radius=1.1)
    assert meshing.surface_distance(*fine, *finer) == pytest.approx(0.1, abs=2e-3)
    assert meshing.surface_distance(*finer, *fine) == pytest.approx(meshing.surface_distance(*fine, *finer), rel=1e-12)
    assert meshing.surface_distance(*fine, *meshes.icosphere(5, radius=1.0)) < 2e-3
    assert meshing.surface_distance(*fine, *fine) < 1e-9
    broken = fine.vertices.copy()
    broken[3] = np.nan
    assert np.isnan(meshing.surface_distance(broken, fine.faces, *fine))


def test_surface_distance_weighs_by_area():
    """Regions with many small faces would count more: a plane of which half is meshed finely and lies 1 higher. By
    area both halves count alike, so the directed mean of a flat plane below is 0.5 (exact but for the step's edge)."""
    coarse, fine = _plane(0.0, 1.0, 2), _plane(1.0, 2.0, 16)
    low = _plane(-4.0, 6.0, 4)
    raised = (np.concatenate([coarse[0], fine[0] + [0, 1, 0]]), np.concatenate([coarse[1], fine[1] + len(coarse[0])]))
    assert meshing._directed(*raised, *low) == pytest.approx(0.5, abs=1e-9)


def _plane(start: float, end: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    x, z = np.meshgrid(np.linspace(start, end, cells + 1), np.linspace(-3, 3, cells + 1), indexing="ij")
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (index[s] for s in (np.s_[:-1, :-1], np.s_[1:, :-1], np.s_[1:, 1:], np.s_[:-1, 1:]))
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    return np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3), faces


def test_remeshed_garments_follow_and_keep_their_pins():
    """A remeshed garment does not lie on the recorded one, or loses its waistband: carried at rest it lies on the old
    mesh where the new one is (4 mm: remeshing cuts the corners of a tube of 24 sides), and what carries it is
    barycentric, so an affine map of the old mesh is the same map of what was carried (1e-5 m: float32)."""
    vertices, faces = synthetic_sequences.tube(24, 9, 0.2, 0.8, 1.3)
    top = np.flatnonzero(vertices[:, 1] > 1.29)
    garment = Garment(vertices.astype(np.float32), faces.astype(np.int32), pins=top)
    new = meshing.remesh(garment, 900)
    assert abs(len(new.garment.faces) - 900) < 90
    at_rest = new.carried(garment.vertices)
    assert np.linalg.norm(at_rest - new.garment.vertices, axis=1).max() < 4e-3
    turn = np.array([[0.0, 0.2, 1.1], [0.1, 1.0, 0.0], [-0.9, 0.0, 0.3]])
    np.testing.assert_allclose(new.carried(garment.vertices @ turn.T + 0.5), at_rest @ turn.T + 0.5, atol=1e-5)
    assert len(new.garment.pins) > 12
    assert new.garment.vertices[new.garment.pins, 1].min() > 1.26
    beside = np.concatenate([vertices, vertices + [1.0, 0, 0]]).astype(np.float32)
    pieces = Garment(beside, np.concatenate([faces, faces + len(vertices)]).astype(np.int32))
    with pytest.raises(meshing.NotRemeshable, match="2 pieces"):
        meshing.remesh(pieces, 900)


def test_figure_7_measures_every_resolution_from_the_recorded_one(data, network, tmp_path):
    """Resolutions are missing or compared with the wrong surface: the distance in one frame against that to all
    triangles, one by one, by trimesh (1e-4: float32 positions)."""
    config = EvaluateConfig(
        data=data,
        out=tmp_path,
        network=str(network),
        table="figure7",
        frames=3,
        device="cpu",
        tables=TableOptions(faces=(90, 200)),
        picture=False,
    )
    result = evaluate(config)
    assert [(r["row"], r["start"]) for r in result["rows"]] == [
        (name, start) for start in ("warm", "cold") for name in ("recorded mesh", "90 faces", "200 faces")
    ]
    assert result["rows"][0]["distance_m"] == 0.0
    sequence = Sequence.load(list_sequences(data, split="test")[0])
    simulator = Simulator(checkpoint.load(network), "cpu")
    surfaces = figure7.resolutions(simulator, sequence, sequence.body(), config, "warm")
    ours = next(r for r in result["sequences"] if r["row"] == "200 faces" and r["start"] == "warm")
    a, b = surfaces["recorded mesh"], surfaces["200 faces"]
    directed = []
    for one, other in ((a, b), (b, a)):
        triangles, points = other.vertices[2][other.faces].astype(np.float64), one.vertices[2].astype(np.float64)
        pairs = np.tile(triangles, (len(points), 1, 1)), np.repeat(points, len(triangles), axis=0)
        distance = np.linalg.norm(trimesh.triangles.closest_point(*pairs) - pairs[1], axis=1)
        distance = distance.reshape(len(points), -1).min(axis=1)
        area = trimesh.triangles.area(points[one.faces])
        share = np.array([area[(one.faces == v).any(1)].sum() for v in range(len(points))])
        directed.append((distance * share).sum() / share.sum())
    assert ours["distance_over_time_m"][2] == pytest.approx(np.mean(directed), rel=1e-4)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["figure7.json", "figure7.md"]


@pytest.fixture(scope="module")
def grouped(tmp_path_factory) -> Path:
    """A set with seam cuts, bodies and categories of which some are for tests only."""
    root = tmp_path_factory.mktemp("groups") / "data"
    anny, wooden = {"body": {"kind": "anny"}}, {"body": {"kind": "mannequin"}}

    def cut(number):
        return {"parameters": {"cut": number}}

    for name, split, entries in (
        ("a", "train", anny | cut(0) | {"category": "dress"}),
        ("b", "validation", anny | cut(0) | {"category": "dress"}),
        ("c", "test", anny | cut(10) | {"category": "dress"}),
        ("d", "test", wooden | cut(11) | {"category": "dress"}),
        ("e", "test", anny | cut(10) | {"category": "skirt"}),
    ):
        synthetic_sequences.write(root, name, split, frames=13, seed=ord(name), manifest=entries)
    (root / "set.json").write_text(json.dumps({"configuration": {"held_out": ["skirt"]}}))
    return root


@pytest.mark.parametrize(
    ("table", "groups"),
    [
        ("figure9", {"unseen_cuts": "cde", "training_cuts": "b", "training_sequences": "a"}),
        ("figure12", {"seen": "ce", "seen_same_categories": "c", "mannequin": "d"}),
        ("category", {"seen": "cd", "dress": "cd", "skirt": "e"}),
    ],
)
def test_groups_hold_what_was_seen_and_what_was_not(grouped, network, tmp_path, table, groups):
    """A sequence stands in the wrong group, so that the unseen looks as good as the seen; means are over each group's
    own sequences (against a mean by hand, rel 1e-9)."""
    config = EvaluateConfig(
        data=grouped, out=tmp_path, network=str(network), table=table, frames=2, geodesic_frames=1, device="cpu",
        baselines=False, picture=table == "category",
    )  # fmt: skip
    result = evaluate(config)
    assert {r["row"]: "".join(sorted({s["sequence"] for s in r["sequences"]})) for r in result["rows"]} == groups
    row = result["rows"][0]
    warm = [s["network"]["mean_vertex_error_cm"] for s in row["sequences"] if s["start"] == "warm"]
    assert row["mean"]["warm"]["network"]["mean_vertex_error_cm"] == pytest.approx(np.mean(warm), rel=1e-9)
    if table == "category":
        names = {"category.json", "category.md", "category.png", "category_rollouts.png"}
        assert {p.name for p in tmp_path.iterdir()} == names


def test_data_that_lack_a_group_are_named_with_the_command(data, grouped, network, tmp_path, capsys):
    """A table of one row that compares nothing; the message must say what makes the missing data."""
    for table, command in (
        ("figure9", "--recipe seams"),
        ("figure12", "mannequin and a creature"),
        ("category", "--held-out"),
    ):
        arguments = ["evaluate", "--table", table, "--data", str(data), "--out", str(tmp_path), "--no-picture"]
        assert cli.main([*arguments, "--network", str(network)]) == 2
        line = capsys.readouterr().err.strip().splitlines()[-1]
        assert line.startswith("warpgarment: DataLacks:")
        assert "warpgarment generate" in line
        assert command in line
    config = EvaluateConfig(data=grouped, table="category", tables=TableOptions(held_out=("dress",)), picture=False)
    with pytest.raises(DataLacks, match="dress is not held out, 1 training"):
        evaluate(config)
    with pytest.raises(OptionMissing, match="--data"):
        evaluate(EvaluateConfig(table="figure12", picture=False))
    assert list(tmp_path.iterdir()) == []


def test_figure_5_times_every_stage(network, tmp_path):
    """Stages are missing, counted twice or from other frames: they must add up to the frame's time (1e-9), which lies
    between nothing and the time of the whole call."""
    config = EvaluateConfig(
        out=tmp_path, network=str(network), table="figure5", frames=3, device="cpu", tables=TableOptions(faces=(400,))
    )
    began = time.perf_counter()
    (row,) = evaluate(config)["rows"]
    spent = time.perf_counter() - began
    assert set(row["ms"]) >= {"features", "network", "singular values", "poisson", "collision"}
    assert sum(row["ms"].values()) == pytest.approx(row["frame_ms"], rel=1e-9)
    assert min(row["ms"].values()) > 0
    assert 1e-3 * row["frame_ms"] + row["setup_s"] < spent
    assert abs(row["faces"] - 400) < 60
    assert {p.suffix for p in tmp_path.iterdir()} == {".json", ".md", ".png"}


def test_the_command_in_a_table_parses_and_names_no_folders(data, tmp_path):
    """The command that stands in a result does not make it again, or tells where it was made."""
    import tyro

    config = table_config(data, tmp_path)
    text = report.command(config)
    assert str(tmp_path) not in text
    parsed = tyro.cli(EvaluateConfig, args=text.split()[2:])
    assert parsed.tables == dataclasses.replace(config.tables, runs=Path("runs"))
    assert (parsed.table, parsed.frames, parsed.device) == ("table2", 4, "cpu")
