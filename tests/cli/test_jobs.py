"""Lists of jobs: what is refused before anything runs, what one job changes for others, and how a run goes on."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from support.outfits import layersnet
from support.scenes import Failing, network, tube, walk

from warpgarment import cli
from warpgarment.io.obj import obj_text
from warpgarment.kernels.features.channels import OUTDOOR
from warpgarment.nn import checkpoint
from warpgarment.objects.body import BodyMotion
from warpgarment.objects.motion import GarmentMotion
from warpgarment.sim import memory
from warpgarment.sim.simulator import Simulator

LARGE = 600  # faces: garments of more than 512 do not share a padded row, see docs/rounding.md


@pytest.fixture
def scene(tmp_path):
    """Three skirts of more than 512 faces, two small ones, two bodies, a bad mesh and two networks as files."""
    for k, name in enumerate(("under", "over", "third")):
        vertices, faces = tube(20, 16, bottom=-0.3, top=0.3 - 0.01 * k, radius=(0.3 + 0.012 * k, 0.19 + 0.012 * k))
        assert len(faces) == LARGE
        (tmp_path / f"{name}.obj").write_text(obj_text(vertices, faces, name))
    for along in (7, 6):
        vertices, faces = tube(16, along, bottom=-0.3, top=0.3)
        (tmp_path / f"small{along}.obj").write_text(obj_text(vertices, faces, "small"))
    vertices, faces = tube(20, 16, bottom=-0.3, top=0.3)
    (tmp_path / "away.obj").write_text(obj_text(vertices + np.float32([0, 3, 0]), faces, "away"))
    (tmp_path / "broken.obj").write_text("v 0 0 0\nv 0 0 1\nf 1 2 9\n")
    walk(5).save(tmp_path / "body.npz")
    walk(4, fps=24).save(tmp_path / "other.npz")
    checkpoint.save(network(), tmp_path / "plain.safetensors")
    checkpoint.save(network(outdoor=OUTDOOR.names), tmp_path / "outdoor.safetensors")
    checkpoint.save(layersnet(), tmp_path / "windy.safetensors")
    return tmp_path


def written(folder, *jobs):
    """The list of some jobs; the path of it."""
    rows = [row if isinstance(row, str) else json.dumps(row) for row in jobs]
    (folder / "jobs.jsonl").write_text("\n".join(rows) + "\n")
    return folder / "jobs.jsonl"


def job(garment="under.obj", out="a.npz", body="body.npz", **more):
    return {"garment": garment, "body": body, "out": out, **more}


def run(folder, *words, weights="plain") -> int:
    start = ["simulate", "--jobs", str(folder / "jobs.jsonl"), "--device", "cpu"]
    return cli.main([*start, "--weights", str(folder / f"{weights}.safetensors"), *map(str, words)])


def alone(folder, files, *words, weights="plain"):
    """The result of one `simulate` run."""
    start = ["simulate", *(str(folder / file) for file in files), "--device", "cpu", "--out", str(folder / "alone.npz")]
    assert cli.main([*start, "--weights", str(folder / f"{weights}.safetensors"), *map(str, words)]) == 0
    return GarmentMotion.load(folder / "alone.npz")


def results(folder):
    rows = [json.loads(row) for row in (folder / "jobs.results.jsonl").read_text().splitlines()]
    return {row["line"]: row for row in rows}


@pytest.fixture
def batches(monkeypatch):
    """Numbers of garments of each rollout, as they happen."""
    seen, rollout = [], Simulator.rollout

    def counted(self, garments, *args, **options):
        seen.append(len(garments) if isinstance(garments, list) else 1)
        return rollout(self, garments, *args, **options)

    monkeypatch.setattr(Simulator, "rollout", counted)
    return seen


def same(found, expected):
    """The bits, times and statuses agree; numbers of iterations are those of a solver that serves the whole batch."""
    np.testing.assert_array_equal(found.vertices, expected.vertices)
    assert (found.fps, found.start, found.last) == (expected.fps, expected.start, expected.last)
    plain = [[replace(s, collision_iterations=0, poisson_iterations=0) for s in m.status] for m in (found, expected)]
    assert plain[0] == plain[1]


def test_jobs_are_the_single_runs_bit_for_bit(scene, batches):
    """A job would move otherwise beside others: the bits of `simulate` alone, garments having more than 512 faces.

    Jobs of one kind run in one rollout; other rates, numbers of frames and layers are a batch of their own.
    """
    jobs = [job(), job("over.obj", "b.npz", "other.npz"), job("over.obj", "sub/c.npz"), "", job(out="d.npz", frames=2)]
    jobs += [job(["under.obj", "over.obj"], "e/{name}.npz", layers=True), job(out="f.npz", out_fps="network")]
    written(scene, *jobs)
    assert run(scene) == 0
    assert sorted(batches) == [1, 1, 2, 3]
    batches.clear()
    for path, files, words in [
        ("a.npz", ["under.obj", "body.npz"], []),
        ("b.npz", ["over.obj", "other.npz"], []),
        ("sub/c.npz", ["over.obj", "body.npz"], []),
        ("d.npz", ["under.obj", "body.npz"], ["--frames", 2]),
        ("f.npz", ["under.obj", "body.npz"], ["--out-fps", "network"]),
    ]:
        same(GarmentMotion.load(scene / path), alone(scene, files, *words))
    known = Simulator(checkpoint.load(scene / "plain.safetensors"), "cpu")
    expected = known.rollout(
        [cli_garment(scene, name) for name in ("under", "over")], BodyMotion.load(scene / "body.npz"), layers=True
    )
    for name, motion in zip(("under", "over"), expected, strict=True):
        same(GarmentMotion.load(scene / f"e/{name}.npz"), motion)


def cli_garment(folder, name):
    import warpgarment as wg

    return wg.Garment.load(folder / f"{name}.obj")


def test_small_garments_differ_by_rounding_only(scene, batches):
    """Padding in a batch would do more than change the order of sums: 0.01 mm in the first two frames, the bound of
    test_same_bits.py for garments of up to 512 faces."""
    written(scene, job("small7.obj", frames=2), job("small6.obj", "b.npz", frames=2))
    assert run(scene) == 0
    assert batches == [2]
    for name, path in (("small7.obj", "a.npz"), ("small6.obj", "b.npz")):
        apart = GarmentMotion.load(scene / path).vertices - alone(scene, [name, "body.npz"], "--frames", 2).vertices
        assert np.abs(apart).max() < 1e-5


def test_materials_wind_and_pins_are_of_their_job(scene, batches):
    """A fabric, a gust or a waistband would be another job's: the bits of each alone, in one batch."""
    np.savetxt(scene / "gust.csv", [[3, 0, 1], [4, 0, 1], [5, 0, 2]], delimiter=",")
    (scene / "denim.json").write_text('{"density": 0.4}')
    jobs = [job(material="cotton", wind=[-2, 0, 1]), job(out="b.npz", material={"bend": 0.01}, wind_file="gust.csv")]
    jobs.append(job("over.obj", "c.npz", material="denim.json", wind=[0, 0, 4], pins=list(range(20))))
    written(scene, *jobs)
    assert run(scene, weights="outdoor") == 0
    assert batches == [3]
    words = ["--material", "cotton", "--wind", -2, 0, 1]
    same(GarmentMotion.load(scene / "a.npz"), alone(scene, ["under.obj", "body.npz"], *words, weights="outdoor"))
    words = ["--material", "bend=0.01", "--wind-file", scene / "gust.csv"]
    same(GarmentMotion.load(scene / "b.npz"), alone(scene, ["under.obj", "body.npz"], *words, weights="outdoor"))
    garment = cli_garment(scene, "over")
    np.savez(scene / "pinned.npz", vertices=garment.vertices, faces=garment.faces, pins=np.arange(20))
    words = ["--material", "density=0.4", "--wind", 0, 0, 4]
    same(GarmentMotion.load(scene / "c.npz"), alone(scene, ["pinned.npz", "body.npz"], *words, weights="outdoor"))
    pinned = GarmentMotion.load(scene / "c.npz").vertices
    assert np.abs(pinned - alone(scene, ["over.obj", "body.npz"], *words, weights="outdoor").vertices).max() > 2e-4


def test_jobs_on_one_body_are_no_outfit(scene, batches):
    """A network that sees the garments on a body would see those of other jobs. What it predicts alone, up to
    the rounding of another batch: 0.02 mm in four steps (0.005 mm was seen); those that see each other are 20 times
    as far."""
    written(scene, job(), job("over.obj", "b.npz"))
    assert run(scene, weights="windy") == 0
    assert batches == [2]
    known = Simulator(checkpoint.load(scene / "windy.safetensors"), "cpu")
    body = BodyMotion.load(scene / "body.npz")
    seeing = known.rollout([cli_garment(scene, name) for name in ("under", "over")], body)
    for k, (name, path) in enumerate((("under.obj", "a.npz"), ("over.obj", "b.npz"))):
        lone = alone(scene, [name, "body.npz"], weights="windy").vertices
        assert np.abs(GarmentMotion.load(scene / path).vertices - lone).max() < 2e-5
        assert np.abs(seeing[k].vertices - lone).max() > 4e-4


def test_a_failing_job_takes_no_other_with_it(scene, batches, capsys):
    """A bad mesh, a garment far from its body, or NaN would end the run, or spoil what is beside it. The others have
    the bits of a run without these; status 4, and the table and the record say which failed and why."""
    jobs = [
        job(),
        job("broken.obj", "b.npz"),
        job("away.obj", "c.npz"),
        job("over.obj", "d.npz"),
        job("third.obj", "e.npz"),
    ]
    written(scene, *jobs)
    assert run(scene) == cli.JOBS_FAILED == 4
    said = capsys.readouterr()
    assert {row: entry["state"] for row, entry in results(scene).items()} == {
        1: "done",
        2: "failed",
        3: "failed",
        4: "done",
        5: "done",
    }
    assert "MeshError" in results(scene)[2]["reason"]
    assert "from the body" in results(scene)[3]["reason"] or "away" in results(scene)[3]["reason"]
    assert "line 3, c.npz: failed: MeshError" in said.out
    assert "5 jobs: 3 done, 0 skipped, done before, 2 failed" in said.out
    assert not (scene / "b.npz").exists()
    assert not (scene / "c.npz").exists()
    for name, path in (("under", "a"), ("over", "d"), ("third", "e")):
        same(GarmentMotion.load(scene / f"{path}.npz"), alone(scene, [f"{name}.obj", "body.npz"]))


def test_garments_that_stop_being_finite_fail(scene, monkeypatch, capsys):
    """A file of NaN would pass for a result. It is not written; the job beside it is."""
    torn = network(Failing)
    monkeypatch.setattr(checkpoint, "load", lambda *_, **__: torn)
    written(scene, job("small7.obj"), job("small6.obj", "b.npz"))  # padded together: the network fails the first
    assert run(scene) == 4
    assert "small7 is not finite from frame" in results(scene)[1]["reason"]
    assert not (scene / "a.npz").exists()
    assert results(scene)[2]["state"] == "done"
    assert np.isfinite(GarmentMotion.load(scene / "b.npz").vertices).all()
    assert "1 failed" in capsys.readouterr().err


def test_a_stopped_run_goes_on(scene, batches, monkeypatch, capsys):
    """What is done would be done again, or what is not be left out. Stopped in the second batch, a run goes on with
    exactly the jobs that are not written."""
    written(scene, job(), job("over.obj", "b.npz"), job("third.obj", "c.npz"))
    rollout = Simulator.rollout

    def stopped(self, *args, **options):
        if len(batches) == 2:
            raise KeyboardInterrupt
        return rollout(self, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Simulator, "rollout", stopped)
        assert run(scene, "--batch", 1) == 130
    assert "the same command goes on" in capsys.readouterr().err
    times = {path: os.stat(scene / path).st_mtime_ns for path in ("a.npz", "b.npz")}
    assert not (scene / "c.npz").exists()
    batches.clear()
    assert run(scene) == 0
    assert batches == [1]
    assert {path: os.stat(scene / path).st_mtime_ns for path in times} == times
    assert "2 skipped, done before" in capsys.readouterr().out
    assert run(scene) == 0
    assert batches == [1]
    assert run(scene, "--again") == 0
    assert batches == [1, 3]


def test_what_a_result_depends_on_is_run_again(scene, batches):
    """An old result would pass for that of a changed job. Options, bytes of inputs, the network, and outputs that are
    gone or written over each start exactly their job; the order of lines and names start none."""
    written(scene, job(), job("over.obj", "b.npz", name="coat"))
    assert run(scene) == 0
    first = GarmentMotion.load(scene / "a.npz").vertices

    def runs(*words, weights="plain"):
        batches.clear()
        assert run(scene, *words, weights=weights) == 0
        return batches

    written(scene, "", job("over.obj", "b.npz", name="my coat"), job())
    assert runs() == []
    assert results(scene)[2]["name"] == "my coat"
    assert results(scene)[3]["skipped"] is True
    written(scene, job(frames=3), job("over.obj", "b.npz"))
    assert runs() == [1]
    assert len(GarmentMotion.load(scene / "a.npz").vertices) == 3
    written(scene, job(), job("over.obj", "b.npz"))
    assert runs() == [1]
    np.testing.assert_array_equal(GarmentMotion.load(scene / "a.npz").vertices, first)
    (scene / "b.npz").unlink()
    assert runs() == [1]
    (scene / "a.npz").write_bytes((scene / "b.npz").read_bytes())
    assert runs() == [1]
    walk(5, fps=25).save(scene / "body.npz")
    assert runs() == [2]
    assert runs("--layers") == [2]
    checkpoint.save(network(embedding=24), scene / "plain.safetensors")
    assert runs("--layers") == [2]
    assert runs("--layers") == []


def test_batches_fit_in_memory(scene, batches, monkeypatch):
    """All jobs would be simulated at once, and the machine run out of memory. With room for the prediction of two
    garments, there are two at a time."""
    written(scene, *[job(out=f"{k}.npz") for k in range(5)])
    made = network()
    garment, body = cli_garment(scene, "under"), BodyMotion.load(scene / "body.npz")
    two, three = (memory.predict([garment] * n, [body], made.config).total for n in (2, 3))
    positions = 12 * 10 * (body.vertices.shape[1] + 2 * len(garment.vertices))
    room = (0.5 * (two + three) + 2.5 * positions) / memory.USABLE
    monkeypatch.setattr(memory, "free", lambda device: int(room))
    assert run(scene) == 0
    assert batches == [2, 2, 1]


def test_cloth_that_crosses_or_is_deep_is_said(scene, capsys):
    """A script would take crossing layers, or cloth in the body, for good results: status 3, and a line for each."""
    garment = cli_garment(scene, "over")
    moved = obj_text(garment.vertices + np.float32([0.02, 0, 0]), garment.faces, "over")
    (scene / "crossing.obj").write_text(moved)
    written(scene, job(["under.obj", "crossing.obj"], "{name}.npz", layers=True))
    assert run(scene) == cli.NOT_FREE
    said = capsys.readouterr().out
    assert "1 with cloth that crosses" in said
    assert "crossing crosses in" in said
    vertices, faces = tube(20, 16, bottom=-0.2, top=0.2, radius=(0.05, 0.05))
    (scene / "inside.obj").write_text(obj_text(vertices, faces, "inside"))
    written(scene, job("inside.obj", "deep.npz", frames=1))
    assert run(scene) == 0
    deepest = max(status.max_penetration for status in GarmentMotion.load(scene / "deep.npz").status)
    said = capsys.readouterr().out
    assert f"not free of the body: a point is {1e3 * deepest:.1f} mm deep" in said
    assert "1 not free of the body" in said
    assert results(scene)[1]["deepest"] == deepest > 0.01
