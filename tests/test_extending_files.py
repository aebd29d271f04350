"""If these failed, docs/extending.md would tell people to write what does not work."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

TEXT = (Path(__file__).parents[1] / "docs" / "extending.md").read_text("utf-8")
PROGRAMS = dict(re.findall(r"`(\w+\.py)`:\n\n```python\n(.*?)```", TEXT, re.DOTALL))


def run(folder: Path, script: str) -> subprocess.CompletedProcess:
    for name, program in PROGRAMS.items():
        (folder / name).write_text(program)
    return subprocess.run([sys.executable, script], cwd=folder, capture_output=True, text=True)


@pytest.mark.parametrize("script", ["use_tri.py", "use_carried.py"])
def test_the_recipe_works_from_outside_as_it_stands(tmp_path, script):
    """The code of the page, copied into files of somebody's own folder, does not run."""
    done = run(tmp_path, script)
    assert done.returncode == 0, done.stderr


def test_the_format_refuses_half_a_file_and_is_named_in_messages(tmp_path):
    """What the page says about errors does not hold for its own example."""
    (tmp_path / "half.tri").write_text("3 1\n0 0 0\n1 0 0\n")
    (tmp_path / "other.xyz").write_text("")
    PROGRAMS["errors.py"] = (
        "import warpgarment as wg\n"
        "from warpgarment.io.files import FORMATS\n"
        "FORMATS[('.tri',)] = 'tri'\n"
        "for name in ('half.tri', 'other.xyz'):\n"
        "    try:\n"
        "        wg.Garment.load(name)\n"
        "    except wg.MeshError as error:\n"
        "        print(error)\n"
    )
    half, other = run(tmp_path, "errors.py").stdout.splitlines()
    assert half.startswith("half.tri: not a readable .tri file (2 rows where the first line promises 4)")
    assert ".usdz or .tri" in other


def test_all_programs_of_the_page_are_run():
    """A block that no test runs may be wrong."""
    assert {"tri.py", "use_tri.py", "carried.py", "use_carried.py"} <= set(PROGRAMS)
    sections = TEXT.split("## A file format\n")[1].split("## A contact source\n")[0]
    assert sections.count("```python") == 4
