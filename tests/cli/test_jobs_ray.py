"""Lists of jobs on a Ray cluster: `warpgarment simulate --jobs jobs.jsonl --ray ADDRESS`."""

from __future__ import annotations

import json
import os
import sys

import numpy as np
import pytest
import ray
from support.scenes import network, tube, walk

from warpgarment import cli
from warpgarment.cli.jobs import spread
from warpgarment.cli.jobs.entries import read_jobs
from warpgarment.cli.jobs.progress import Progress
from warpgarment.cli.jobs.spread import Spread
from warpgarment.cli.shot import Shot
from warpgarment.cluster import Done
from warpgarment.io.obj import obj_text
from warpgarment.nn import checkpoint

JOBS = [
    {"garment": "a.obj", "body": "body.npz", "out": "1.npz"},
    {"garment": "b.obj", "body": "body.npz", "out": "2.npz"},
    {"garment": "broken.obj", "body": "body.npz", "out": "3.npz"},
    {"garment": "a.obj", "body": "other.npz", "out": "4.npz", "frames": 3},
    {"garment": "b.obj", "body": "other.npz", "out": "5.npz"},
]


@pytest.fixture(scope="module")
def cluster():
    """A cluster of two workers on this machine."""
    os.environ.setdefault("RAY_raylet_start_wait_time_s", "300")  # of a busy machine; 60 by default
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A list of five jobs, of which the third fails; garments of 600 faces, which do not depend on their batch."""
    for name, radius in (("a", 0.3), ("b", 0.33)):
        (tmp_path / f"{name}.obj").write_text(
            obj_text(*tube(20, 16, bottom=-0.3, top=0.3, radius=(radius, 0.19)), name)
        )
    (tmp_path / "broken.obj").write_text("v 0 0 0\nv 0 0 1\nf 1 2 9\n")
    walk(4).save(tmp_path / "body.npz")
    walk(4, fps=24).save(tmp_path / "other.npz")
    checkpoint.save(network(), tmp_path / "plain.safetensors")
    (tmp_path / "jobs.jsonl").write_text("".join(f"{json.dumps(job)}\n" for job in JOBS))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*words: str) -> int:
    """Runs the list, with paths from the working folder."""
    given = ["--weights", "plain.safetensors", "--batch", "2", "--device", "cpu"]
    return cli.main(["simulate", "--jobs", "jobs.jsonl", *given, *words])


def entries(name: str = "jobs.results.jsonl") -> dict[int, dict]:
    """The record, by line."""
    return {row["line"]: row for row in map(json.loads, open(name).read().splitlines())}


def frames(numbers) -> dict[int, np.ndarray]:
    return {k: np.load(f"{k}.npz")["vertices"] for k in numbers}


def test_a_cluster_does_what_one_machine_does(scene, cluster, capfd):
    """Batches would be lost, run twice, or come out otherwise: results are equal bit for bit, the record has the same
    entries but for times, the job that fails is named and takes no other with it, and nothing runs again after that;
    with or without a cluster."""
    assert run("--results", "plain.jsonl") == cli.JOBS_FAILED
    expected = frames((1, 2, 4, 5))
    plain = entries("plain.jsonl")
    for k in expected:
        os.remove(f"{k}.npz")
    capfd.readouterr()
    assert run("--ray", "auto") == cli.JOBS_FAILED
    said = capfd.readouterr()
    assert "jobs.jsonl:3: 3.npz failed: MeshError" in said.err
    assert "5 of 5 jobs, 1 failed" in said.err
    for k, positions in frames(expected).items():
        np.testing.assert_array_equal(positions, expected[k])
    changing = ("seconds", "outputs")
    found = entries()
    assert {k: {**row, **dict.fromkeys(changing)} for k, row in found.items()} == {
        k: {**row, **dict.fromkeys(changing)} for k, row in plain.items()
    }
    os.remove("2.npz")
    assert run("--ray", "auto") == cli.JOBS_FAILED
    assert [row.get("skipped", False) for row in entries().values()] == [True, False, False, True, True]
    np.testing.assert_array_equal(np.load("2.npz")["vertices"], expected[2])
    assert run() == cli.JOBS_FAILED
    assert [row.get("skipped", False) for row in entries().values()] == [True, True, False, True, True]


def test_a_run_that_is_stopped_goes_on(scene, cluster, monkeypatch):
    """What a cluster had done before it was stopped would be done again: the first batch stays as it was written."""
    passed = Progress.passed

    def interrupted(self, *figures):
        passed(self, *figures)
        if self.through < self.total:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "passed", interrupted)
        assert run("--ray", "auto") == 130
    done = [k for k, row in entries().items() if row["state"] == "done"]
    times = {k: os.stat(f"{k}.npz").st_mtime_ns for k in done}
    assert 0 < len(entries()) < 5
    assert run("--ray", "auto") == cli.JOBS_FAILED
    assert sorted(k for k, row in entries().items() if row["state"] == "done") == [1, 2, 4, 5]
    assert {k: os.stat(f"{k}.npz").st_mtime_ns for k in done} == times


def test_parts_are_of_one_kind_and_no_larger_than_a_batch(scene):
    """A task would get garments for which there is no memory, or a rollout of other frames."""
    jobs, _ = read_jobs(scene / "jobs.jsonl", Shot())
    parts = Spread("local", scene / "jobs.jsonl", scene / "plain.safetensors", "cpu", 2).parts(
        [(job, "") for job in jobs]
    )
    lines = sorted([job.line for job, _ in part.jobs] for part in parts)
    assert lines == [[1, 2], [3, 5], [4]]  # job 4 has other frames


def test_a_process_that_dies_takes_one_job_with_it(scene, monkeypatch, capsys):
    """A job that fills the memory would take down all jobs of its batch. Ray is played by a function whose process
    dies with job 2 in it; that a real one is reported as lost is tested in tests/test_cluster.py."""

    def dying(function, parts, address, *, gpus):
        for part in parts:
            lines = [job.line for job, _ in part.jobs]
            if 2 in lines:
                yield Done(part, error="WorkerCrashedError: it died", lost=True)
            else:
                yield Done(part, ([{"line": line, "state": "done"} for line in lines], "", 1.0))

    monkeypatch.setattr(spread, "on_cluster", dying)
    jobs, _ = read_jobs(scene / "jobs.jsonl", Shot())
    made = Spread("local", scene / "jobs.jsonl", scene / "plain.safetensors", "cpu", 2)
    found = [entry for listed, _ in made.outcomes([(job, "") for job in jobs]) for entry in listed]
    assert sorted((entry["line"], entry["state"]) for entry in found) == [
        (1, "done"), (2, "failed"), (3, "done"), (4, "done"), (5, "done"),
    ]  # fmt: skip
    assert "jobs.jsonl:2: 2.npz failed: WorkerCrashedError" in capsys.readouterr().err


def test_without_ray_it_is_said(scene, monkeypatch, capsys):
    """The user would see that a module is missing, and not which extra brings it; or --ray be left out in silence."""
    monkeypatch.setitem(sys.modules, "ray", None)
    assert run("--ray", "local") == 2
    assert 'pip install "warpgarment[cluster]"' in capsys.readouterr().err
    assert cli.main(["simulate", "a.obj", "body.npz", "--out", "x.npz", "--ray", "local"]) == 2
    assert "belong to a list of jobs" in capsys.readouterr().err
