"""`python -m benchmarks against COMMIT`."""

import subprocess

import numpy as np
import pytest

from benchmarks.against.environment import ROOT, NoSuchCommit, python_of
from benchmarks.against.processes import Worker, demo_motions


def test_each_build_runs_its_own_code(tmp_path):
    """Today's build would be compared with itself."""
    if not (ROOT / ".git").exists():
        pytest.fail("this test needs the repository, not an archive of it")
    try:
        worker = Worker(python_of("HEAD", tmp_path), 1)
        assert str(tmp_path) in worker.about["package"]
        motions = demo_motions(tmp_path)
        worker.ask("prepare", "case", "next", {"starts": [0], "motions": motions})
        answers = worker.ask("run", "case")["result"]
        worker.close()
        assert [name for name, _, _ in answers] == motions
        assert len(motions) == 2
        assert all(np.isfinite(np.array(positions)).all() for _, _, positions in answers)
    finally:
        for tree in tmp_path.glob("*/tree"):
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], cwd=ROOT, check=True)


def test_an_unknown_commit_is_named(tmp_path):
    """A misspelt commit would be a traceback of git, or make an environment of something else."""
    with pytest.raises(NoSuchCommit, match="'0000nothing'"):
        python_of("0000nothing", tmp_path)
