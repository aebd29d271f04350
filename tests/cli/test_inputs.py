"""If these failed, what can be said of a file in Python could not be said on the command line."""

from __future__ import annotations

import numpy as np
import pytest
from support.meshes import capsule, skirt

import warpgarment as wg
from warpgarment.cli import main, spoken
from warpgarment.errors import MeshError
from warpgarment.io.obj import obj_text

BODY, CLOTH = capsule((0, 0.2, 0), (0, 1.5, 0), 0.18), skirt(16, 6)
FRAMES = BODY.vertices + np.arange(5, dtype=np.float32)[:, None, None] * np.float32([0, 0, 0.01])


def scene(path):
    shifted = CLOTH.faces + len(BODY.vertices)
    rows = obj_text(CLOTH.vertices, shifted, "skirt")
    path.write_text(obj_text(BODY.vertices, BODY.faces, "body") + rows)
    return str(path)


def test_the_rate_of_the_input_is_given_or_said(tmp_path, capsys):
    """A dance of 60 frames a second would take twice as long, unsaid."""
    wg.BodyMotion(FRAMES, BODY.faces, 60).save(tmp_path / "m.pc2")
    assert main(["convert", str(tmp_path / "m.pc2"), str(tmp_path / "a.npz"), "--input-fps", "60"]) == 0
    assert "assumed" not in capsys.readouterr().err
    assert wg.BodyMotion.load(tmp_path / "a.npz").fps == 60
    assert main(["convert", str(tmp_path / "m.pc2"), str(tmp_path / "b.npz")]) == 0
    said = capsys.readouterr().err
    assert "30 frames a second are assumed. Give it with --input-fps." in said
    assert len([line for line in said.splitlines() if "assumed" in line]) == 1


def test_meshes_of_one_file_and_their_axis(tmp_path, capsys):
    """Garment and body of one scene could not be told apart, and the error would speak Python."""
    path, out = scene(tmp_path / "scene.obj"), str(tmp_path / "out.npz")
    names = ["--garment-mesh", "skirt", "--body-mesh", "body"]
    assert main(["simulate", path, path, *names, "--out", out, "--device", "cpu", "--body-fps", "24"]) == 0
    assert wg.GarmentMotion.load(out).vertices.shape[1] == len(CLOTH.vertices)
    capsys.readouterr()
    assert main(["simulate", path, path, "--body-mesh", "body", "--out", out]) == 2
    said = capsys.readouterr().err
    assert "2 objects: body, skirt. Name one with --garment-mesh, or read them as one with --garment-mesh *." in said
    assert main(["simulate", path, path, "--garment-mesh", "skirt", "--out", out]) == 2
    assert "Name one with --body-mesh," in capsys.readouterr().err
    lying = np.stack([BODY.vertices[:, 0], -BODY.vertices[:, 2], BODY.vertices[:, 1]], axis=1)
    np.savez(tmp_path / "z.npz", vertices=lying[None], faces=BODY.faces, fps=30.0)
    assert main(["convert", str(tmp_path / "z.npz"), out, "--up", "z"]) == 0
    assert capsys.readouterr().err == ""
    np.testing.assert_array_equal(wg.BodyMotion.load(out).vertices[0], BODY.vertices)
    assert main(["convert", str(tmp_path / "z.npz"), out]) == 0
    assert "say so with --up z." in capsys.readouterr().err


def test_a_broken_mesh_is_cleaned_where_asked(tmp_path, capsys):
    """The remedy that messages name could not be had."""
    text = obj_text(CLOTH.vertices, CLOTH.faces)
    (tmp_path / "c.obj").write_text(text + text.splitlines()[-1] + "\n")
    (tmp_path / "b.obj").write_text(obj_text(BODY.vertices, BODY.faces))
    arguments = ["simulate", str(tmp_path / "c.obj"), str(tmp_path / "b.obj"), "--out", str(tmp_path / "o.npz")]
    assert main(arguments) == 2
    assert "Use --clean, or remove them." in capsys.readouterr().err
    assert main([*arguments, "--clean", "--device", "cpu"]) == 0


def test_other_words_stay_as_they_are():
    """A path or an argument of another kind would be rewritten."""
    with pytest.raises(MeshError, match=r"^my-mesh=x: try --unit cm or --unit in; up=, --mesh$"):
        with spoken(unit="--unit", mesh="--mesh"):
            raise MeshError('my-mesh=x: try unit="cm" or unit="in"; up=, mesh=')
