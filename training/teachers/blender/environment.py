"""The Python that runs Blender: an existing one is detected, a new one is made on request.

    python -m warpgarment.training.teachers.blender.environment [--path DIR] [--python python3.11]

`bpy` is Blender as a Python module. It is GPL, needs NumPy 1 and one exact version of Python, so it lives in a virtual
environment of its own and is only ever run as a subprocess. $WARPGARMENT_BLENDER names another Python with `bpy`.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

from warpgarment.io.disk.cache import cache_folder
from warpgarment.training.teachers import TeacherError

PYTHON_VERSION = "3.11"
PACKAGES = ("bpy==4.5.15", "numpy<2")
VARIABLE = "WARPGARMENT_BLENDER"
COMMAND = "python -m warpgarment.training.teachers.blender.environment"


def default_folder() -> Path:
    """The folder in which the environment is made unless another one is given."""
    return cache_folder() / "blender"


def python_of(folder: Path) -> Path:
    """The Python of a virtual environment."""
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def find_environment(named: str | Path | None = None) -> Path:
    """The Python that has bpy.

    Args:
        named: Virtual environment or Python; None for $WARPGARMENT_BLENDER if that is set, otherwise for the
            environment in the default folder.

    Raises:
        TeacherError: There is none; the message names the command that makes one.
    """
    named = named or os.environ.get(VARIABLE) or default_folder()
    python = python_of(Path(named)) if Path(named).is_dir() else Path(named)
    if not python.is_file():
        raise TeacherError(
            f"there is no Python at {python} to run Blender with. Make an environment with `{COMMAND}` (Python "
            f"{PYTHON_VERSION}, 1 GB), or let {VARIABLE} name a Python that has {PACKAGES[0]}."
        )
    return python


@lru_cache(maxsize=8)
def version_of(python: Path) -> str:
    """The version of bpy in a Python.

    Raises:
        TeacherError: The Python has no bpy.
    """
    ask = "import importlib.metadata as m; print(m.version('bpy'))"
    answer = subprocess.run([python, "-I", "-c", ask], capture_output=True, text=True, check=False)
    if answer.returncode:
        raise TeacherError(f"{python} has no bpy. Make an environment with `{COMMAND}`.")
    return answer.stdout.strip()


def make_environment(path: str | Path | None = None, python: str | Path | None = None) -> Path:
    """Makes the virtual environment with bpy; an existing one that works is not changed.

    Args:
        path: Folder of the environment; None for the one in the cache folder that :func:`find_environment` reads.
        python: Python that makes the environment, of the version for which bpy was built; None for the running one if
            it has this version, otherwise for `python3.11`.

    Returns:
        Path of the environment's Python.

    Raises:
        TeacherError: The folder holds something else, the Python is of another version, or an installation failed.
    """
    folder = Path(path) if path is not None else default_folder()
    target, unfinished = python_of(folder), folder / "unfinished"
    if target.is_file() and not unfinished.exists() and not _failure([target, "-I", "-c", "import bpy"]):
        return target
    if folder.exists() and any(folder.iterdir()) and not unfinished.exists():
        raise TeacherError(f"{folder} holds something else than an environment with bpy. Name another, or remove it.")
    base = _checked_python(str(python) if python is not None else _default_python())
    print(f"making {folder} with {base}: {', '.join(PACKAGES)}", file=sys.stderr)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    unfinished.touch()
    for step in (
        [base, "-I", "-m", "venv", folder],
        [target, "-I", "-m", "pip", "install", "--disable-pip-version-check", "--quiet", *PACKAGES],
        [target, "-I", "-c", "import bpy"],
    ):
        failure = _failure(step)
        if failure:
            shutil.rmtree(folder, ignore_errors=True)
            raise TeacherError(f"`{' '.join(map(str, step))}` failed, and {folder} is removed again:\n{failure}")
    unfinished.unlink()
    return target


def _default_python() -> str:
    this = f"{sys.version_info.major}.{sys.version_info.minor}"
    return sys.executable if this == PYTHON_VERSION else f"python{PYTHON_VERSION}"


def _checked_python(python: str) -> str:
    """Path of a Python after a check that it has the version that bpy needs."""
    path = shutil.which(python)
    if path is None:
        raise TeacherError(
            f"{PACKAGES[0]} needs Python {PYTHON_VERSION}, and there is no {python}. Install it, or name one: "
            f"`{COMMAND} --python /path/to/python{PYTHON_VERSION}`."
        )
    ask = "import sys; print('%d.%d' % sys.version_info[:2])"
    version = subprocess.run([path, "-c", ask], capture_output=True, text=True, check=False).stdout.strip()
    if version != PYTHON_VERSION:
        raise TeacherError(
            f"{PACKAGES[0]} needs Python {PYTHON_VERSION}; {python} is {version or 'no Python'}. "
            f"Name another: `{COMMAND} --python python{PYTHON_VERSION}`."
        )
    return path


def _failure(command: list) -> str:
    """The last output of a command if it failed, otherwise an empty text."""
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    return (answer.stderr or answer.stdout)[-2000:] or "no message" if answer.returncode else ""


def main() -> None:
    """Makes the environment."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--path", type=Path, help="folder of the environment")
    parser.add_argument("--python", help=f"a Python {PYTHON_VERSION} to make it with")
    options = parser.parse_args()
    try:
        python = make_environment(options.path, options.python)
    except TeacherError as error:
        sys.exit(str(error))
    print(python)
    if options.path is not None:
        print(f"to use it: export {VARIABLE}={python}")


if __name__ == "__main__":
    main()
