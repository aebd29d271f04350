"""Several garments on the bundled body, over each other: crossings, depth and order measured by others."""

from __future__ import annotations

import json

import igl
import ipctk
import numpy as np
import pytest
from support import scenes

import warpgarment as wg
from warpgarment import cli
from warpgarment.dressing.beneath import Beneath
from warpgarment.errors import UsageError
from warpgarment.io.obj import obj_text
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment


@pytest.fixture(scope="module")
def collider() -> BodyMotion:
    """The body of the demo with which garments collide, its first frame only."""
    whole = wg.demo.assets().collider
    return BodyMotion(whole.vertices[:1], whole.faces)


def _crossing(meshes: list[tuple[np.ndarray, np.ndarray]], body: BodyMotion) -> bool:
    """Whether any two faces of garments and body cross, by the IPC Toolkit."""
    every = [*meshes, (body.vertices[0], body.faces)]
    starts = np.cumsum([0, *(len(points) for points, _ in every)])
    points = np.concatenate([p for p, _ in every]).astype(float)
    faces = np.concatenate([f + at for (_, f), at in zip(every, starts[:-1], strict=True)]).astype(np.int32)
    mesh = ipctk.CollisionMesh(points, ipctk.edges(faces), faces)
    mesh.can_collide = ipctk.make_static_obstacle_filter(int(starts[-2]))  # the body may cross itself
    return bool(ipctk.has_intersections(mesh, points))


def _height(points: np.ndarray, body: BodyMotion) -> np.ndarray:
    """Signed distance to the body [m], by libigl."""
    kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    at, faces = body.vertices[0].astype(float), body.faces.astype(np.int64)
    return igl.signed_distance(points.astype(float), at, faces, sign_type=kind)[0]


def _share_above(over: np.ndarray, under: np.ndarray, under_faces: np.ndarray, body: BodyMotion) -> float:
    """Share of the vertices of a garment, of those within 4 cm of another, that are farther from the body than the
    nearest point of that, by libigl; at least 20 are near."""
    squared, _, nearest = igl.point_mesh_squared_distance(
        over.astype(float), under.astype(float), under_faces.astype(np.int64)
    )
    near = squared < 0.04**2
    assert near.sum() >= 20
    return float((_height(over[near], body) > _height(nearest[near], body)).mean())


def _skirt(name: str, around: int, top: float, radius: tuple[float, float]) -> Garment:
    vertices, faces = scenes.tube(around, 8, bottom=0.0, top=top, radius=radius)
    return Garment(vertices, faces, pins=np.arange(2 * around), name=name)


@pytest.mark.parametrize("names", [("wide", "narrow"), ("narrow", "wide")], ids="-".join)
def test_layers_come_on_in_their_order_and_do_not_cross(collider, names) -> None:
    """A skirt over another would cross it, lie beneath it, or push it into the body: both begin at the same place, and
    the outer one is narrower at its hem. Given the other way round, the other one is outside. No crossing by the IPC
    Toolkit, depth at most 2 mm by libigl, nine tenths of the outer one farther from the body, and a 99th percentile of
    the stretch of 15 % at most, by hand."""
    both = {"wide": _skirt("wide", 28, 0.45, (0.26, 0.17)), "narrow": _skirt("narrow", 24, 0.4, (0.22, 0.17))}
    worn = wg.dress([both[name] for name in names], collider)
    assert worn.report.faults == ()
    assert tuple(one.garment for one in worn.report.garments) == names
    assert [(p.inner, p.outer, p.crossings) for p in worn.report.pairs] == [(*names, 0)]
    assert all(20 * p.beneath <= p.above for p in worn.report.pairs)
    meshes = [(one.vertices, one.garment.faces) for one in worn]
    assert not _crossing(meshes, collider)
    assert _share_above(meshes[1][0], *meshes[0], collider) > 0.9
    for one in worn:
        corners = one.vertices[one.garment.faces].mean(axis=1)
        assert _height(np.concatenate([one.vertices, corners]), collider).min() > -2e-3
        i, j = one.garment.edges.T
        lengths = [np.linalg.norm(p[i] - p[j], axis=1) for p in (one.garment.vertices, one.vertices)]
        assert np.percentile(lengths[1] / lengths[0], 99) < 1.15
    # the checks have teeth: moved by 1 cm they cross, and the inner one does not lie outside
    assert _crossing([meshes[0], (meshes[1][0] + np.float32([0.01, 0, 0]), meshes[1][1])], collider)
    assert _share_above(meshes[0][0], *meshes[1], collider) < 0.5
    assert tuple(one.name for one in worn.outfit) == names
    assert len(worn) == len(worn.vertices) == 2


def test_what_is_worn_is_carried_to_thin_and_turned_bodies() -> None:
    """Garments beneath would stay where they are while the limb in them turns, or not become thin with it. A limb that
    turns rigidly carries them rigidly (1e-9 m), one that shrinks to a line carries them to a tenth of their distance
    from it, and back at its pose they are where they were."""
    rng = np.random.default_rng(3)
    angle, along = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0, 1, 400)
    limb = np.stack([0.05 * np.cos(angle), along, 0.05 * np.sin(angle)], 1)
    worn = np.stack([0.07 * np.cos(angle[:50]), along[:50], 0.07 * np.sin(angle[:50])], 1)
    beneath = Beneath(worn, np.zeros((0, 3), np.int32), limb)
    np.testing.assert_allclose(beneath.at(limb), worn, atol=1e-12)
    c, s = np.cos(0.7), np.sin(0.7)
    turn, shift = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([0.3, -0.1, 0.2])
    np.testing.assert_allclose(beneath.at(limb @ turn.T + shift), worn @ turn.T + shift, atol=1e-9)
    line = limb * [0.0, 1.0, 0.0]
    thin = beneath.thin(limb, line, 1.0)
    middle = limb[beneath._around].mean(axis=1)
    np.testing.assert_allclose(thin - middle * [0, 1, 0], 0.1 * (worn - middle), atol=1e-12)
    np.testing.assert_allclose(beneath.thin(limb, limb, 0.0), worn, atol=1e-12)


def test_commands_dress_several(tmp_path, collider, capsys) -> None:
    """The command would write one garment for all, forget the report of pairs, or `simulate --dress` begin with layers
    that cross. Files hold what does not cross, by the IPC Toolkit; the rollout's first frame neither."""
    body, files = tmp_path / "body.npz", []
    BodyMotion(np.repeat(collider.vertices, 3, axis=0), collider.faces).save(body)
    for number, one in enumerate((_skirt("under", 24, 0.35, (0.2, 0.155)), _skirt("over", 28, 0.42, (0.24, 0.17)))):
        files.append(tmp_path / f"{one.name}.obj")
        scale = (100.0, 1.0)[number]
        files[-1].write_text(obj_text(scale * one.vertices, one.faces, one.name))
    out, report, picture = (tmp_path / name for name in ("{name}_worn.npz", "report.json", "worn.png"))
    arguments = ["dress", *files, "--body", body, "--out", out, "--report", report, "--picture", picture]
    more = ["--pins", "waist", "--unit", "cm", "--unit", "m"]
    assert cli.main([*map(str, arguments), *more]) == 0
    assert "vertices over it" in capsys.readouterr().out
    values = json.loads(report.read_text())
    assert [one["unit"] for one in values["garments"]] == ["cm", "m"]
    assert values["pairs"][0]["crossings"] == 0
    assert values["faults"] == []
    worn = [Garment.load(tmp_path / f"{name}_worn.npz") for name in ("under", "over")]
    assert [len(one.pins) for one in worn] == [24, 28]
    assert not _crossing([(one.vertices, one.faces) for one in worn], collider)
    assert picture.stat().st_size > 10_000
    out = tmp_path / "moving_{name}.npz"
    arguments = ["simulate", *files, body, "--dress", "--layers", "--out", out, "--weights", "small"]
    assert cli.main(list(map(str, arguments))) in (0, 3)  # 3: the free hems may still be on their way
    moving = [BodyMotion.load(tmp_path / f"moving_{name}.npz") for name in ("under", "over")]
    assert not _crossing([(one.vertices[0], one.faces) for one in moving], collider)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--out", "worn.npz"], "{name}.npz has their names"),
        (["--out", "{name}.npz", "--turn", "1", "--turn", "2", "--turn", "3"], "2 garments and 3 of --turn"),
        (["--out", "{name}.npz", "--scale", "0.2"], "under: the garment is too small"),
    ],
    ids=["out", "turn", "scale"],
)
def test_what_cannot_be_of_several_is_one_line(tmp_path, collider, capsys, monkeypatch, more, words) -> None:
    """A mistake would be a traceback, or leave one of two files. Exit status 2, one line, no new file."""
    monkeypatch.chdir(tmp_path)
    collider.save(tmp_path / "body.npz")
    for name in ("under", "over"):
        one = _skirt(name, 24, 0.35, (0.2, 0.155))
        (tmp_path / f"{name}.obj").write_text(obj_text(one.vertices, one.faces, name))
    before = sorted(tmp_path.iterdir())
    assert cli.main(["dress", "under.obj", "over.obj", "body.npz", *more]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warpgarment:")]
    assert len(lines) == 1
    assert words in lines[0]
    assert sorted(tmp_path.iterdir()) == before


def test_options_are_one_for_all_or_one_for_each(collider) -> None:
    """A list of another length would be cut off without a word, or an empty outfit end in a traceback."""
    two = [_skirt("a", 24, 0.35, (0.2, 0.155)), _skirt("b", 24, 0.35, (0.2, 0.155))]
    with pytest.raises(UsageError, match="2 garments and 3 of turn"):
        wg.dress(two, collider, turn=[0.0, 1.0, 2.0])
    with pytest.raises(UsageError, match="no garment"):
        wg.dress([], collider)
