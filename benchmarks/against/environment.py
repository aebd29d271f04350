"""An earlier commit of this repository, with an environment of its own beside today's.

The commit is checked out as a git worktree below `out/against/`, which git ignores. Its environment holds links to the
worktree's three folders, as `.ci/check_tree.py` makes them, and takes every other package from today's environment: the
same torch and Warp run both, and no package index is needed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

ROOT = Path(__file__).parents[2]
MAPPED = ("kernels", "training")  # installed as warpgarment.kernels, warpgarment.training: see pyproject.toml


class NoSuchCommit(ValueError):
    """The repository has no such commit."""


def python_of(commit: str, folder: Path = ROOT / "out" / "against") -> Path:
    """The interpreter of an environment in which `import warpgarment` is that of the commit; made at the first call.

    Args:
        commit: Any name that git has for a commit.
        folder: Folder in which worktrees and environments are made.

    Raises:
        NoSuchCommit: Git does not know the commit.
    """
    name = f"{commit}^{{commit}}"
    known = subprocess.run(["git", "rev-parse", "--verify", "--quiet", name], cwd=ROOT, capture_output=True, text=True)
    if known.returncode:
        raise NoSuchCommit(f"there is no commit {commit!r} in {ROOT}; a shallow clone needs `git fetch --unshallow`")
    full = known.stdout.strip()
    tree, environment = folder / full[:12] / "tree", folder / full[:12] / "environment"
    if not tree.exists():
        command = ["git", "worktree", "add", "--force", "--detach", "--quiet", str(tree), full]
        subprocess.run(command, cwd=ROOT, check=True)
    python = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
    shutil.rmtree(environment, ignore_errors=True)
    venv.create(environment, symlinks=os.name != "nt", with_pip=False)
    paths = {"base": str(environment), "platbase": str(environment)}
    packages = Path(sysconfig.get_path("purelib", "venv" if os.name != "nt" else "nt", vars=paths))
    (packages / "warpgarment").mkdir()
    for entry in [*(tree / "warpgarment").iterdir(), *(tree / name for name in MAPPED)]:
        (packages / "warpgarment" / entry.name).symlink_to(entry)
    # Folders in a .pth file follow those of the environment, and .pth files in them, which would install today's build,
    # are not read.
    shared = dict.fromkeys(path for path in sys.path if "site-packages" in path or "dist-packages" in path)
    (packages / "shared.pth").write_text("".join(f"{path}\n" for path in shared))
    return python
