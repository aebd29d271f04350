"""The check of what is built (.ci/check_dist.py), on small trees and wheels with one known fault each."""

from __future__ import annotations

import email.parser
import importlib.util
import zipfile
from pathlib import Path

import pytest

ROOT = next(folder for folder in Path(__file__).resolve().parents if (folder / ".ci").is_dir())
_spec = importlib.util.spec_from_file_location("check_dist", ROOT / ".ci/check_dist.py")
check_dist = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(check_dist)

TREE = {
    "warpgarment/__init__.py": "", "warpgarment/py.typed": "", "warpgarment/assets/demo/body.npz": "numbers",
    "warpgarment/assets/fast.md": "card", "kernels/__init__.py": "", "kernels/sdf/query.py": "a",
    "training/cli.py": "b", "training/README.md": "a page",
}  # fmt: skip
METADATA = """Metadata-Version: 2.4
Name: warpgarment
Version: 0.1.0
Summary: Neural garment dynamics
License-Expression: Apache-2.0
License-File: LICENSE
Provides-Extra: usd
Requires-Dist: usd-core>=25.5; extra == "usd"
Provides-Extra: all
Requires-Dist: warpgarment[usd]; extra == "all"
Provides-Extra: dev
Requires-Dist: pytest>=8; extra == "dev"

# warpgarment
"""


@pytest.fixture
def tree(tmp_path):
    """A tree with code, data and a page about the code."""
    for name, text in TREE.items():
        (tmp_path / "tree" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "tree" / name).write_text(text)
    return check_dist.expected(tmp_path / "tree")


def wheel(path: Path, files) -> Path:
    """A wheel with the contents of some files, and metadata."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, file in files.items():
            archive.writestr(name, file if isinstance(file, str) else file.read_bytes())
        archive.writestr("warpgarment-0.1.0.dist-info/METADATA", METADATA)
    return path


def test_files_of_the_package_are_known_by_their_installed_names(tree):
    """Kernels would be sought at another place, or a page about the code be missed in the wheel."""
    assert set(tree) == {
        "warpgarment/__init__.py", "warpgarment/py.typed", "warpgarment/assets/demo/body.npz",
        "warpgarment/assets/fast.md", "warpgarment/kernels/__init__.py", "warpgarment/kernels/sdf/query.py",
        "warpgarment/training/cli.py",
    }  # fmt: skip


def test_a_sound_wheel_has_no_fault(tmp_path, tree):
    """The check would fail whatever is built."""
    assert check_dist.wrong_files(wheel(tmp_path / "a.whl", tree), tree) == []
    assert check_dist.wrong_metadata(email.parser.Parser().parsestr(METADATA)) == []


@pytest.mark.parametrize(
    "name", ["warpgarment/py.typed", "warpgarment/assets/demo/body.npz", "warpgarment/kernels/sdf/query.py"]
)
def test_a_file_that_is_left_out_is_named(tmp_path, tree, name):
    """A wheel without a folder of code, the weights or the types would be published."""
    kept = {key: file for key, file in tree.items() if key != name}
    (fault,) = check_dist.wrong_files(wheel(tmp_path / "a.whl", kept), tree)
    assert fault.startswith(f"{name} is missing")


def test_a_file_too_many_or_changed_is_named(tmp_path, tree):
    """Tests, or code of an old build folder, would be published."""
    more = wheel(tmp_path / "a.whl", tree | {"tests/test_a.py": "x"})
    assert check_dist.wrong_files(more, tree) == ["tests/test_a.py is in the wheel, and not part of the package"]
    old = wheel(tmp_path / "b.whl", tree | {"warpgarment/training/cli.py": "old"})
    assert check_dist.wrong_files(old, tree) == ["warpgarment/training/cli.py is not as in the tree"]


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("License-File: LICENSE\n", "", "no License-File"),
        ("# warpgarment", "", "the README is not the description"),
        ("Provides-Extra: dev", "Provides-Extra: view\nProvides-Extra: dev", "the extra all lacks view"),
    ],
)
def test_metadata_that_are_not_there_are_named(old, new, fault):
    """A page on an index would be empty, or `pip install warpgarment[all]` leave something out."""
    assert check_dist.wrong_metadata(email.parser.Parser().parsestr(METADATA.replace(old, new))) == [fault]
