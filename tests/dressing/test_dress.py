"""Garments from elsewhere on the bundled body: depth, crossings and stretch measured by others."""

from __future__ import annotations

import json

import igl
import ipctk
import numpy as np
import pytest
from support import scenes

import warpgarment as wg
from benchmarks.dressing.patterns import boxy_tshirt
from warpgarment import cli
from warpgarment.dressing.measure import unworn
from warpgarment.dressing.openings import roles_of
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.garment import Garment


@pytest.fixture(scope="module")
def collider() -> BodyMotion:
    """The body of the demo with which garments collide, its first frame only."""
    whole = wg.demo.assets().collider
    return BodyMotion(whole.vertices[:1], whole.faces)


def _crossing(points: np.ndarray, faces: np.ndarray, body: BodyMotion) -> bool:
    """Whether any two faces of garment and body cross, by the IPC Toolkit."""
    both = np.concatenate([points.astype(float), body.vertices[0].astype(float)])
    together = np.concatenate([faces, body.faces + len(points)]).astype(np.int32)
    mesh = ipctk.CollisionMesh(both, ipctk.edges(together), together)
    mesh.can_collide = ipctk.make_static_obstacle_filter(len(points))  # the body may cross itself
    return bool(ipctk.has_intersections(mesh, both))


def _depth(points: np.ndarray, faces: np.ndarray, body: BodyMotion) -> float:
    """Depth of the deepest corner or middle of a face [m], by libigl."""
    at = np.concatenate([points, points[faces].mean(axis=1)]).astype(float)
    kind = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    signed = igl.signed_distance(at, body.vertices[0].astype(float), body.faces.astype(np.int64), sign_type=kind)[0]
    return float(-signed.min())


def test_a_box_of_panels_in_centimetres_comes_on(collider) -> None:
    """A garment of flat panels in a T-pose, in centimetres and with Z up, would not arrive on a body in an A-pose: its
    arms outside of the sleeves, cloth in the body, torn or tangled. Depth at most 2 mm by libigl, no crossing by the
    IPC Toolkit, and a 99th percentile of the stretch of 15 % at most, by hand."""
    plain = boxy_tshirt()
    points = plain.vertices.astype(float)
    away = 100.0 * np.stack([points[:, 0], -points[:, 2], points[:, 1]], 1) + [50.0, 10.0, 20.0]
    garment = Garment(away, plain.faces, name="box")
    dressed = wg.dress(garment, collider)
    report, worn = dressed.report, dressed.vertices
    assert (report.kind, report.unit, report.up) == ("shirt", "cm", "z")
    assert (report.unit_from, report.up_from) == ("guessed", "guessed")
    assert report.faults == ()
    assert _depth(worn, plain.faces, collider) < 2e-3
    assert not _crossing(worn, plain.faces, collider)
    # the check has teeth: moved by 5 cm it crosses
    assert _crossing(worn + np.float32([0.05, 0, 0]), plain.faces, collider)
    i, j = plain.edges.T
    ratio = np.linalg.norm(worn[i] - worn[j], axis=1) / np.linalg.norm(plain.vertices[i] - plain.vertices[j], axis=1)
    assert np.percentile(ratio, 99) < 1.15
    np.testing.assert_allclose(report.stretch[2], np.percentile(ratio, 99) - 1, atol=1e-3)
    at_rest = dressed.garment.vertices.astype(float)
    np.testing.assert_allclose(np.ptp(at_rest, axis=0), np.ptp(points, axis=0), atol=1e-4)
    from warpgarment.dressing.limbs import limbs_of

    limbs = limbs_of(collider.vertices[0].astype(float), collider.faces)
    roles = roles_of(worn, plain.faces)
    assert unworn(worn.astype(float), plain.faces, roles, limbs) == []
    assert unworn(worn + np.float32([0.0, 0.0, 1.0]), plain.faces, roles, limbs) == ["neck", "cuff 1", "cuff 2", "hem"]


def _skirt_file(folder, scale: float = 1000.0):
    """A skirt in millimetres as an OBJ with a group for its waistband."""
    vertices, faces = scenes.tube(28, 9, bottom=0.0, top=0.5, radius=(0.25, 0.145))
    lines = [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in scale * vertices]
    for k, face in enumerate(faces + 1):
        lines += ["g waistband"] if k == 0 else ["g skirt"] if k == 56 else []
        lines.append("f " + " ".join(map(str, face)))
    path = folder / "skirt.obj"
    path.write_text("\n".join(lines))
    return path


def test_the_command_writes_garment_report_and_picture(tmp_path, collider, capsys) -> None:
    """The command would not write what it says, guess without a word, or forget the pins. The report's own figures are
    in the JSON; pins are the two rings of the group."""
    skirt, body = _skirt_file(tmp_path), tmp_path / "body.npz"
    collider.save(body)
    out, report, picture = (tmp_path / name for name in ("worn.npz", "report.json", "worn.png"))
    arguments = ["dress", skirt, body, "--out", out, "--report", report, "--picture", picture]
    assert cli.main(list(map(str, arguments))) == 0
    text = capsys.readouterr().out
    assert "mm is assumed" in text
    values = json.loads(report.read_text())
    assert values["unit"] == "mm"
    assert values["faults"] == []
    assert values["pins"] == 56
    worn = Garment.load(out)
    np.testing.assert_array_equal(worn.pins, np.arange(56))
    assert _depth(worn.vertices, worn.faces, collider) < 2e-3
    assert worn.vertices[:, 1].min() > 0.3  # it hangs at the waist and not on the floor
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--scale", "0.3"], "too small"),
        (["--scale", "big"], "a number between"),
        (["--pins", "collar"], "no group, material or object named 'collar': it has"),
        (["--material", "denm"], "Did you mean denim"),
        (["--report", "report.txt"], "must end with .json"),
    ],
    ids=["size", "scale", "pins", "material", "report"],
)
def test_what_cannot_be_is_one_line_and_nothing_is_written(tmp_path, collider, capsys, more, words) -> None:
    """A mistake would be a traceback, or leave files. Exit status 2, one line, no new file."""
    skirt, body = _skirt_file(tmp_path), tmp_path / "body.npz"
    collider.save(body)
    before = sorted(tmp_path.iterdir())
    assert cli.main(["dress", str(skirt), str(body), "--out", str(tmp_path / "worn.obj"), *more]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warpgarment:")]
    assert len(lines) == 1
    assert words in lines[0]
    assert sorted(tmp_path.iterdir()) == before


def test_a_body_that_is_not_in_metres_is_refused() -> None:
    """A body of 178 m would be dressed in a garment of as many."""
    whole = wg.demo.assets().collider
    with pytest.raises(wg.MeshError, match="178 m tall"):
        wg.dress(boxy_tshirt(), (100 * whole.vertices[0], whole.faces))


def test_simulate_dresses_before(tmp_path, collider, capsys) -> None:
    """`simulate --dress` would begin with the garment where its file has it. The first frame lies on the body, 2 mm by
    libigl, and what was guessed is said."""
    skirt, body, out = _skirt_file(tmp_path), tmp_path / "body.npz", tmp_path / "out.npz"
    BodyMotion(np.repeat(collider.vertices, 3, axis=0), collider.faces).save(body)
    assert cli.main(list(map(str, ["simulate", skirt, body, "--dress", "--out", out, "--weights", "small"]))) == 0
    assert "mm is assumed" in capsys.readouterr().err
    first = BodyMotion.load(out)
    assert _depth(first.vertices[0], first.faces, collider) < 2e-3
