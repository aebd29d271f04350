"""The checks of the whole tree (.ci/check_tree.py), on small trees with one known fault each."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

ROOT = next(folder for folder in Path(__file__).resolve().parents if (folder / ".ci").is_dir())
_spec = importlib.util.spec_from_file_location("check_tree", ROOT / ".ci/check_tree.py")
check_tree = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(check_tree)

PYPROJECT = """
[tool.setuptools]
packages = ["warpgarment", "warpgarment.io", "warpgarment.kernels", "warpgarment.training"]

[tool.mypy]
packages = ["warpgarment"]
ignore_missing_imports = true
[[tool.mypy.overrides]]
module = "warp"
follow_imports = "skip"
follow_imports_for_stubs = true

[tool.importlinter]
root_package = "warpgarment"
exclude_type_checking_imports = true
[[tool.importlinter.contracts]]
name = "arrows"
type = "layers"
containers = ["warpgarment"]
layers = ["training", "io", "kernels"]
[[tool.importlinter.contracts]]
name = "circles"
type = "acyclic_siblings"
ancestors = ["warpgarment"]
"""


@pytest.fixture
def tree(tmp_path):
    """A tree of four packages without a fault."""
    (tmp_path / "pyproject.toml").write_text(PYPROJECT)
    for name in ("warpgarment", "warpgarment/io", "kernels", "training", "tests"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    (tmp_path / "kernels/gap.py").write_text("WIDTH: int = 3\n")
    (tmp_path / "training/loop.py").write_text("from warpgarment.kernels.gap import WIDTH\nSTEPS: int = WIDTH\n")
    return tmp_path


def test_errors_in_warp_functions_are_dropped_and_those_beside_them_kept(tree):
    """A kernel's body is taken for Python (hundreds of false errors), or the line before or after it is taken for the
    kernel's, or a host function is dropped because its decorator looks alike: then the lines named are others."""
    (tree / "kernels/scale.py").write_text(
        "import warp as wp\n"
        "def plain(f): return f\n"
        "before: int = 'host'\n"  # 3
        "@wp.kernel\n"
        "def a(x: float) -> None:\n"
        "    y: int = 'warp'\n"
        "after: int = 'host'\n"  # 7
        "@wp.kernel(enable_backward=False)\n"
        "def b(x: float) -> None:\n"
        "    y: int = 'warp'\n"
        "@wp.func_grad(a)\n"
        "def adj_a(x: float) -> None: y: int = 'warp'\n"
        "@plain\n"
        "def kernel(x: float) -> None: y: int = 'host'\n"  # 14
        "def make() -> object:\n"
        "    z: int = 'host'\n"  # 16
        "    @wp.func\n"
        "    def inner(x: float) -> float:\n"
        "        y: int = 'warp'\n"
        "        return x\n"
        "    w: int = 'host'\n"  # 21
        "    return inner\n"
    )
    errors = check_tree.type_errors(tree)
    assert [error.split(" ")[0] for error in errors] == [f"kernels/scale.py:{line}:" for line in (3, 7, 14, 16, 21)]
    assert all("[assignment]" in error for error in errors)


def test_a_type_error_across_packages_is_seen(tree):
    """`warpgarment.kernels` is not found under its installed name, so that all of it counts as Any."""
    (tree / "training/loop.py").write_text("from warpgarment.kernels.gap import WIDTH\nNAME: str = WIDTH\n")
    (error,) = check_tree.type_errors(tree)
    assert error.startswith("training/loop.py:2: Incompatible types in assignment")


def test_a_type_checker_that_does_not_run_is_a_fault(tree):
    """mypy stops before it has looked at a file, and no message is taken for no error."""
    (tree / "pyproject.toml").write_text(PYPROJECT.replace('packages = ["warpgarment"]\n', 'packages = ["nowhere"]\n'))
    assert "mypy did not finish" in check_tree.type_errors(tree)[0]


@pytest.mark.parametrize(
    ("place", "line", "named"),
    [
        ("kernels/gap.py", "from warpgarment.io import files", "warpgarment.kernels.gap -> warpgarment.io"),
        ("warpgarment/io/files.py", "import warpgarment.training.loop", "warpgarment.io.files -> warpgarment.training"),
        ("kernels/gap.py", "from warpgarment.kernels.twin import X", "No cycles are allowed"),
    ],
    ids=["kernels import the library", "the library imports training", "a circle of two files"],
)
def test_an_upward_import_and_a_circle_are_named(tree, place, line, named):
    """An arrow that points up, or two files that import each other, pass unseen: links or contracts are not used."""
    (tree / "warpgarment/io/files.py").touch()
    (tree / "kernels/twin.py").write_text("import warpgarment.kernels.gap\nX = 1\n")
    assert check_tree.wrong_imports(tree) == []
    with (tree / place).open("a") as file:
        file.write(f"{line}\n")
    (report,) = check_tree.wrong_imports(tree)
    assert named in " ".join(report.split()), report


def test_imports_for_types_alone_may_point_up(tree):
    """An import under TYPE_CHECKING, which never runs, is taken for an arrow."""
    (tree / "kernels/gap.py").write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import warpgarment.training.loop\n"
    )
    assert check_tree.wrong_imports(tree) == []


def test_packages_that_are_not_listed_and_listed_ones_that_are_not_there(tree):
    """A new folder of code is missing from the wheel, or one that is gone stops the build."""
    assert check_tree.wrong_packages(tree) == []
    (tree / "kernels/sdf").mkdir()
    (tree / "kernels/sdf/__init__.py").touch()
    (tree / "training/tables").mkdir()
    (tree / "training/tables/report.py").touch()
    (tree / "warpgarment/io/__init__.py").unlink()
    assert check_tree.wrong_packages(tree) == [
        "kernels/sdf: add warpgarment.kernels.sdf",
        "training/tables: add warpgarment.training.tables",
        "warpgarment.io: remove it, there is no such folder with Python files",
        "training/tables: holds Python files, add an __init__.py",
    ]


def test_folders_and_files_are_counted(tree):
    """A limit is off by one, counts __init__.py or something else than Python, or stops at the packages."""
    for folder in ("kernels", "tests"):
        for number in range(check_tree.MOST_FILES - 1):
            (tree / folder / f"part_{number}.py").touch()
        (tree / folder / "notes.md").touch()
    (tree / "training/loop.py").write_text("x = 1\n" * check_tree.MOST_LINES)
    assert check_tree.crowded_folders(tree) == check_tree.long_files(tree) == []
    (tree / "tests/one_more.py").touch()
    (tree / "tests/another.py").touch()
    assert check_tree.crowded_folders(tree) == ["tests/: 16 files, 15 allowed"]
    (tree / "training/loop.py").write_text("x = 1\n" * (check_tree.MOST_LINES + 1))
    assert check_tree.long_files(tree) == ["training/loop.py: 401 lines, 400 allowed"]


def test_a_test_that_imports_another_is_named(tree):
    """A test borrows from another test's file in one of the three ways to write it, and is not named."""
    (tree / "tests/test_a.py").write_text("from test_b import f\nimport kernels.test_c\nfrom kernels import test_c\n")
    (tree / "tests/test_b.py").write_text("import meshes\nfrom poison import tested\n")
    assert [fault.split(" ")[0] for fault in check_tree.borrowing_tests(tree)] == [
        f"tests/test_a.py:{line}:" for line in (1, 2, 3)
    ]


def test_the_exit_status_says_whether_anything_is_wrong(tree, capsys, monkeypatch):
    """A fault is printed and the status is 0 all the same, so that `make lint` passes; or it is not said what to do."""
    check = check_tree.wrong_packages
    monkeypatch.setattr(check_tree, "CHECKS", {check: check_tree.CHECKS[check]})
    assert check_tree.main(tree) == 0
    (tree / "kernels/sdf").mkdir()
    (tree / "kernels/sdf/__init__.py").touch()
    assert check_tree.main(tree) == 1
    printed = capsys.readouterr().out
    assert "wrong packages: 1" in printed
    assert "kernels/sdf: add warpgarment.kernels.sdf" in printed
    assert "What to do: change `packages`" in printed


def test_packages_of_this_project_are_all_listed():
    """A folder of code is missing from `packages` in pyproject.toml: an installed copy lacks it."""
    assert check_tree.wrong_packages(ROOT) == []
