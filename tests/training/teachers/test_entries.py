"""If these failed, a teacher could be named that is not there, or data would not say whose work they are."""

from __future__ import annotations

import inspect
import subprocess
import sys
from importlib import import_module, metadata
from types import SimpleNamespace
from typing import get_args, get_type_hints

import pytest

from warpgarment.training.data.card_page import credits
from warpgarment.training.data.set_manifest import PACKAGES
from warpgarment.training.generate.recipes import GenerateConfig
from warpgarment.training.teachers import TEACHERS, make_teacher

EXTRAS = metadata.metadata("warpgarment").get_all("Provides-Extra")
REQUIRES = metadata.requires("warpgarment")


def test_the_command_line_offers_the_teachers_there_are():
    """`--teacher` would refuse one that is there, or offer one that is not."""
    assert get_args(get_type_hints(GenerateConfig)["teacher"]) == tuple(TEACHERS)


@pytest.mark.parametrize("name", TEACHERS)
def test_entries_say_what_is_true(name):
    """An entry names a module without `make`, an extra that is not in pyproject.toml or does not bring its packages."""
    entry = TEACHERS[name]
    assert list(inspect.signature(import_module(entry.module).make).parameters) == ["device"]
    assert entry.extra in (None, *EXTRAS)
    brought = [line for line in REQUIRES if "extra ==" not in line or f'extra == "{entry.extra}"' in line]
    for package in entry.packages:
        assert any(line.startswith(package) for line in brought), f"nothing brings {package}"
        assert package in PACKAGES, "a manifest would not name the version"


def test_the_card_credits_the_teacher():
    """The page about a data set would not say what it was simulated with, or under which licence."""
    facts = SimpleNamespace(good={}, common={"configuration": {"teacher": "blender"}})
    assert "simulated with Blender (GPL; not its output)." in credits(facts)[-1]


def test_naming_the_teachers_imports_none():
    """`generate --help` and a card would need Newton, and take seconds."""
    code = "import sys, warpgarment.training.teachers; sys.exit('newton' in sys.modules or 'torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_an_unknown_teacher_is_named():
    """The user would not learn which teachers there are."""
    with pytest.raises(ValueError, match="'maya'; there are newton, blender"):
        make_teacher("maya")
