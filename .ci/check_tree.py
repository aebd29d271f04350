"""Checks of the whole tree that no linter makes: types of every host line, directions of imports, folders, packages.

    python .ci/check_tree.py        prints each fault, where it is and what to do; exit status 1 if there is any

`kernels/` and `training/` are installed as `warpgarment.kernels` and `warpgarment.training`. Tools that read files see
them under those names in `.links/` (git-ignored), a folder of symbolic links that every run makes anew.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10, where mypy brings the same under another name
    import tomli as tomllib

PACKAGES = {"warpgarment": "warpgarment", "kernels": "warpgarment.kernels", "training": "warpgarment.training"}
FOLDERS = (*PACKAGES, "tests", "benchmarks", "examples", "findings", "integrations", ".ci")
MOST_FILES, MOST_LINES = 15, 400  # in a folder, __init__.py not counted; in a file
WARP = ("kernel", "func", "func_grad", "func_replay", "func_native")  # wp.kernel ...: their bodies are not Python


def link(root: Path) -> Path:
    """Makes `.links/warpgarment/` below `root` anew, with one link for each entry of the package; returns `.links/`."""
    links = root / ".links"
    package = links / "warpgarment"
    shutil.rmtree(package, ignore_errors=True)
    package.mkdir(parents=True)
    for entry in [*(root / "warpgarment").iterdir(), root / "kernels", root / "training"]:
        (package / entry.name).symlink_to(os.path.relpath(entry, package))
    return links


def warp_lines(source: str) -> set[int]:
    """Numbers of the lines of functions that Warp compiles, their decorators and what is nested in them included."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef) and any(_is_warp(decorator) for decorator in node.decorator_list):
            lines.update(range(node.decorator_list[0].lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def _is_warp(decorator: ast.expr) -> bool:
    name = decorator.func if isinstance(decorator, ast.Call) else decorator
    return ast.unparse(name) in {f"{module}.{kind}" for module in ("wp", "warp") for kind in WARP}


def type_errors(root: Path) -> list[str]:
    """What mypy finds outside functions that Warp compiles, as "file:line: message  [code]"."""
    command = [sys.executable, "-m", "mypy", "--config-file", "../pyproject.toml", "--output", "json"]
    ran = subprocess.run(command, cwd=link(root), capture_output=True, text=True, check=False)
    try:
        found = [json.loads(line) for line in ran.stdout.splitlines()]
    except json.JSONDecodeError:
        found = []
    if ran.returncode and not found:
        return [f"mypy did not finish (exit status {ran.returncode}): {ran.stdout}{ran.stderr}"]
    places = {entry["file"]: (root / ".links" / entry["file"]).resolve() for entry in found}
    compiled = {name: warp_lines(place.read_text(encoding="utf-8")) for name, place in places.items()}
    return [
        f"{os.path.relpath(places[entry['file']], root)}:{entry['line']}: {entry['message']}  [{entry['code']}]"
        for entry in found
        if entry["severity"] == "error" and entry["line"] not in compiled[entry["file"]]
    ]


def wrong_imports(root: Path) -> list[str]:
    """What import-linter says where a contract of pyproject.toml is broken: one text, or none."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()"]
    command += ["../pyproject.toml", "--no-logo"]
    environment = os.environ | {"PYTHONPATH": "."}
    ran = subprocess.run(command, cwd=link(root), env=environment, capture_output=True, text=True, check=False)
    return [ran.stdout + ran.stderr] if ran.returncode else []


def wrong_packages(root: Path) -> list[str]:
    """Folders of code that `packages` in pyproject.toml lacks, and names in it that are no such folder."""
    listed = set(tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"])
    there = {}
    for tree, package in PACKAGES.items():
        for folder in {file.parent for file in _python(root, tree)}:
            there[".".join([package, *folder.relative_to(root / tree).parts])] = folder
    bare = [place for place in there.values() if not (place / "__init__.py").exists()]
    return [
        *(f"{there[name].relative_to(root)}: add {name}" for name in sorted(there.keys() - listed)),
        *(f"{name}: remove it, there is no such folder with Python files" for name in sorted(listed - there.keys())),
        *(f"{place.relative_to(root)}: holds Python files, add an __init__.py" for place in sorted(bare)),
    ]


def crowded_folders(root: Path) -> list[str]:
    """Folders with more than MOST_FILES Python files."""
    count: dict[str, int] = {}
    for file in _python(root, *FOLDERS):
        room = file.parent.relative_to(root).as_posix()
        count[room] = count.get(room, 0) + (file.name != "__init__.py")
    return [f"{room}/: {n} files, {MOST_FILES} allowed" for room, n in sorted(count.items()) if n > MOST_FILES]


def long_files(root: Path) -> list[str]:
    """Python files with more than MOST_LINES lines."""
    count = {
        file.relative_to(root).as_posix(): len(file.read_text(encoding="utf-8").splitlines())
        for file in _python(root, *FOLDERS)
    }
    return [f"{name}: {n} lines, {MOST_LINES} allowed" for name, n in sorted(count.items()) if n > MOST_LINES]


def borrowing_tests(root: Path) -> list[str]:
    """Imports of one test module by another file of tests/."""
    found = []
    for file in _python(root, "tests"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(part.startswith("test_") for name in names for part in name.split(".")):
                found.append(f"{file.relative_to(root)}:{node.lineno}: {ast.unparse(node)}")
    return found


def _python(root: Path, *folders: str) -> Iterator[Path]:
    for folder in folders:
        yield from sorted(file for file in (root / folder).rglob("*.py") if "__pycache__" not in file.parts)


CHECKS = {  # what is checked, and what to do where it finds faults
    type_errors: "mend the types: an annotation, a narrowing, a small protocol",
    wrong_imports: "move what is shared to a lower room, or the import to where it is allowed",
    wrong_packages: "change `packages` of [tool.setuptools] in pyproject.toml",
    crowded_folders: "give what belongs together a folder of its own",
    long_files: "move the second idea of the file to a file of its own",
    borrowing_tests: "move what two tests need to tests/support/",
}


def main(root: Path) -> int:
    """Runs all checks on the tree at `root` and prints their outcome; returns the exit status."""
    status = 0
    for check, remedy in CHECKS.items():
        faults = check(root)
        print(f"{check.__name__.replace('_', ' ')}: {len(faults)}")
        for fault in faults:
            print(f"  {fault}")
        if faults:
            print(f"  What to do: {remedy}.")
            status = 1
    return status


if __name__ == "__main__":
    sys.exit(main(Path(__file__).resolve().parent.parent))
