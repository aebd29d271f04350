"""`python -m benchmarks against COMMIT`."""

import subprocess

import numpy as np
import pytest
from matplotlib import image

from benchmarks.against.environment import ROOT, NoSuchCommit, python_of
from benchmarks.against.picture import draw
from benchmarks.against.processes import Worker, demo_motions


def test_each_build_runs_its_own_code(tmp_path):
    """Today's build would be compared with itself."""
    if not (ROOT / ".git").exists():
        pytest.fail("this test needs the repository, not an archive of it")
    try:
        worker = Worker(python_of("HEAD", tmp_path), 1)
        assert str(tmp_path) in worker.about["package"]
        motions = demo_motions(tmp_path)
        worker.ask("prepare", "case", "next", {"starts": [0], "motions": motions, "noise": 1e-7, "seeds": [0, 1]})
        answers = worker.ask("run", "case")["result"]
        worker.close()
        assert [name for name, _, _ in answers] == [name for name in motions for _ in range(2)]
        assert not np.array_equal(answers[0][2], answers[1][2])
        assert len(motions) == 2
        assert all(np.isfinite(np.array(positions)).all() for _, _, positions in answers)
    finally:
        for tree in tmp_path.glob("*/tree"):
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)


def test_an_unknown_commit_is_named(tmp_path):
    """A misspelt commit would be a traceback of git, or make an environment of something else."""
    with pytest.raises(NoSuchCommit, match="'0000nothing'"):
        python_of("0000nothing", tmp_path)


def test_the_picture_has_a_line_for_each_build_and_number_of_cores(tmp_path):
    """A line of the picture would be missing, or a broken picture would be written; rows of batches are not drawn."""
    rows = [
        {"what": "frame", "faces": faces, "threads": threads, "before_least": 0.02 * faces, "now_least": 0.01 * faces}
        for faces in (10_000, 1000)
        for threads in (1, 2)
    ]
    draw([*rows, {"what": "batch", "before_least": 1.0, "now_least": 1.0}], tmp_path / "times.png", "1a9fae1")
    pixels = image.imread(tmp_path / "times.png")[..., :3]
    assert pixels.shape[0] > 300
    coloured = np.ptp(pixels, axis=2) > 0.3  # today's lines are blue
    assert coloured.sum() > 500
