"""Lists of jobs that cannot run: every fault is named by its line, before anything is loaded or written."""

from __future__ import annotations

import json

import pytest
from support.scenes import network, tube, walk

from warpgarment import cli
from warpgarment.io.obj import obj_text
from warpgarment.nn import checkpoint
from warpgarment.sim.simulator import Simulator


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Two garments, two bodies and a network as files; a rollout would fail."""
    for name in ("under", "over"):
        (tmp_path / f"{name}.obj").write_text(obj_text(*tube(16, 7, bottom=-0.3, top=0.3), name))
    walk(5).save(tmp_path / "body.npz")
    walk(4).save(tmp_path / "other.npz")
    checkpoint.save(network(), tmp_path / "plain.safetensors")
    monkeypatch.setattr(Simulator, "rollout", None)
    return tmp_path


def written(folder, *jobs) -> None:
    rows = [row if isinstance(row, str) else json.dumps(row) for row in jobs]
    (folder / "jobs.jsonl").write_text("\n".join(rows) + "\n")


def job(garment="under.obj", out="a.npz", body="body.npz", **more):
    return {"garment": garment, "body": body, "out": out, **more}


def run(folder, *words) -> int:
    start = ["simulate", "--jobs", str(folder / "jobs.jsonl"), "--device", "cpu"]
    return cli.main([*start, "--weights", str(folder / "plain.safetensors"), *map(str, words)])


def faults(folder, capsys, *words):
    """Runs a list that must be refused before anything runs; returns lines of stderr about its lines."""
    before = sorted(folder.rglob("*"))
    assert run(folder, *words) == 2
    assert sorted(folder.rglob("*")) == before
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("warpgarment: UsageError: ")
    return {line.partition(".jsonl:")[2].partition(":")[0]: line for line in lines[:-1]}


def test_every_bad_line_is_named_before_anything_runs(scene, capsys):
    """A typo in line 900 would be found after a night. All faults are named at once, each by its line."""
    lines = [
        (job(garment="none.obj"), "no such file:"),
        (job(garmnt_mesh="x"), "a job has no 'garmnt_mesh'. Is it 'garment_mesh'?"),
        ('{"garment": "under.obj"', "no JSON: "),
        ("[1]", "no object."),
        ('{"out": 1, "out": 2}', "'out' is there twice"),
        ({"garment": "under.obj"}, "'body' and 'out' missing"),
        (job(unit="feet"), "'unit' must be one of m, dm, cm"),
        (job(frames=0), "'frames' must be a whole number of at least 1, got 0"),
        (job(frames=1e400), "Infinity is no number"),
        (job(layers="yes"), "'layers' must be true or false"),
        (job(wind=[1, 2]), "'wind' must be three numbers"),
        (job(wind=[0, 0, 1000]), "wind: wind of 1,000 m/s"),
        (job(wind_fps=3), "wind_fps without wind_file"),
        (job(material="wool"), "material wool: no material 'wool'"),
        (job(material=["silk", "silk"]), "2 materials and 1 garment"),
        (job(material=3), "3 is no object of numbers"),
        (job(pins=[-1]), "'pins' must be numbers of vertices"),
        (job(pins=[[1], [2]]), "2 lists of 'pins' for 1 garments"),
        (job(out="a.xyz"), "cannot write 'a.xyz'"),
        (job(body="under.safetensors"), "no such file"),
        (job(body="plain.safetensors"), "cannot read .safetensors"),
        (job(["under.obj", "over.obj"]), "2 garments do not go into one .npz"),
        (job(out_fps=-1), "'out_fps' must be positive"),
        (job(garment_mesh=["a", "b", "c"], garment=["under.obj", "over.obj"], out="{name}.npz"), "2 garments and 3 of"),
        (job(material="cotton", out="q.npz"), "material: the network"),
    ]
    written(scene, *(row for row, _ in lines))
    said = faults(scene, capsys)
    for number, (row, text) in enumerate(lines[:-1], 1):
        assert text in said[str(number)], row
    written(scene, lines[-1][0])
    assert lines[-1][1] in faults(scene, capsys)["1"]


def test_jobs_that_meet_are_refused(scene, capsys):
    """Two jobs would write one file, or one read what another is about to write, in an order that nobody knows."""
    written(scene, job(), job("over.obj", "sub/../a.npz"), job(out="b.npz"), job(body="other.npz", out="under.obj/"))
    assert "written by line 1 too" in faults(scene, capsys)["2"]
    written(scene, job(out="c.pc2"), job(out="c.obj.d/", garment="over.obj"), job(out="other.npz", body="body.npz"))
    (scene / "jobs.jsonl").write_text(
        (scene / "jobs.jsonl").read_text() + json.dumps(job(out="e.npz", body="other.npz"))
    )
    assert "is read, and line 3 writes it" in faults(scene, capsys)["4"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["under.obj", "body.npz"], "leave out GARMENT, BODY and --out"),
        (["--out", "x.npz"], "leave out GARMENT, BODY and --out"),
        (["--batch", "0"], "--batch 0: at least 1"),
        (["--results", "{folder}/under.obj"], "under.obj: where outcomes are kept is a file of line 1"),
        (["--results", "{folder}/jobs.jsonl"], "is a file of the list"),
        (["--results", "{folder}/over.obj"], "is no record of jobs"),
    ],
)
def test_options_beside_a_list(words, message, scene, capsys):
    """A file would be written over, or an option have no effect, unsaid."""
    written(scene, job())
    assert run(scene, *(word.format(folder=scene) for word in words)) == 2
    assert message in capsys.readouterr().err
    assert (scene / "over.obj").read_text().startswith(("o over", "v ", "#"))


def test_no_list_and_no_files(scene, capsys):
    """A missing or empty list, or options without one, would be a traceback."""
    assert run(scene) == 2
    assert "No such file" in capsys.readouterr().err
    written(scene, "", "  ")
    assert run(scene) == 2
    assert "it holds no job" in capsys.readouterr().err
    assert cli.main(["simulate", "--batch", "3"]) == 2
    assert "belong to a list of jobs" in capsys.readouterr().err
    assert cli.main(["simulate"]) == 2
    assert "or --jobs" in capsys.readouterr().err
