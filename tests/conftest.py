"""Tests keep what they compute in a folder of their own, not in the user's cache."""

from __future__ import annotations

import os
import shutil
import tempfile

import pytest

VARIABLE = "WARPGARMENT_CACHE"
FOLDER = pytest.StashKey[str]()


def pytest_configure(config: pytest.Config) -> None:
    """One cache folder a run, inherited by xdist's workers and by the processes that tests start."""
    if not hasattr(config, "workerinput"):
        config.stash[FOLDER] = os.environ[VARIABLE] = tempfile.mkdtemp(prefix="warpgarment-tests-")


def pytest_unconfigure(config: pytest.Config) -> None:
    """Removes it when the last test is done."""
    if FOLDER in config.stash:
        shutil.rmtree(config.stash[FOLDER], ignore_errors=True)
        os.environ.pop(VARIABLE, None)
