"""Builds the sdist and, from it, the wheel; installs the wheel into an empty environment, and runs the demo there.

    python .ci/check_dist.py [FOLDER]     writes both into FOLDER (dist/); exit status 1 if anything is wrong

Nothing is fetched: what the package depends on is taken from the environment that runs this, by a .pth file. The
package itself is not: every file of it that is imported has to be in the wheel.
"""

from __future__ import annotations

import email.message
import email.parser
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import zipfile
from pathlib import Path

PACKAGES = {"warpgarment": "warpgarment", "kernels": "warpgarment/kernels", "training": "warpgarment/training"}
OTHERS = ("LICENSE", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "constraints.txt", "pyproject.toml")
NOT_IN_ALL = {"all", "dev", "docs"}  # extras that `all` leaves out
BUILD = "import sys; from setuptools import build_meta as b; print(getattr(b, 'build_' + sys.argv[1])(sys.argv[2]))"


def expected(root: Path) -> dict[str, Path]:
    """Files of the package in the tree at `root`, by their names in the wheel: all but pages about the code."""
    found = {}
    for folder, place in PACKAGES.items():
        for file in (root / folder).rglob("*"):
            name = file.relative_to(root / folder).as_posix()
            page = file.suffix == ".md" and not name.startswith("assets/")
            if file.is_file() and "__pycache__" not in file.parts and not page:
                found[f"{place}/{name}"] = file
    return found


def build(source: Path, kind: str, into: Path) -> Path:
    """Builds an sdist or a wheel of the tree at `source` with the setuptools that is installed here."""
    ran = subprocess.run([sys.executable, "-c", BUILD, kind, str(into)], cwd=source, capture_output=True, text=True)
    if ran.returncode:
        raise SystemExit(f"{kind} of {source} failed:\n{ran.stdout}{ran.stderr}")
    return into / ran.stdout.split()[-1]


def wrong_files(wheel: Path, wanted: dict[str, Path]) -> list[str]:
    """Files that the wheel lacks, has besides, or has with other contents."""
    with zipfile.ZipFile(wheel) as archive:
        there = {name for name in archive.namelist() if ".dist-info/" not in name}
        changed = [name for name in sorted(there & wanted.keys()) if archive.read(name) != wanted[name].read_bytes()]
    return [
        *(
            f"{name} is missing: see packages and package-data in pyproject.toml"
            for name in sorted(wanted.keys() - there)
        ),
        *(f"{name} is in the wheel, and not part of the package" for name in sorted(there - wanted.keys())),
        *(f"{name} is not as in the tree" for name in changed),
    ]


def wrong_metadata(metadata: email.message.Message) -> list[str]:
    """What is missing in the metadata, and extras that `all` lacks."""
    faults = [
        f"no {key}" for key in ("Name", "Version", "Summary", "License-Expression", "License-File") if not metadata[key]
    ]
    if "# warpgarment" not in str(metadata.get_payload()):
        faults.append("the README is not the description")
    needs = [line.replace('"', "'") for line in metadata.get_all("Requires-Dist", [])]
    extras = set(metadata.get_all("Provides-Extra", []))
    held = next((line.partition("[")[2].partition("]")[0] for line in needs if line.startswith("warpgarment[")), "")
    lacking = extras - NOT_IN_ALL - set(held.split(","))
    if lacking:
        faults.append(f"the extra all lacks {', '.join(sorted(lacking))}")
    return faults


def environment(folder: Path, wheel: Path) -> Path:
    """Makes an environment with the wheel in it, and nothing else of its own; returns its interpreter."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    python = folder / ("Scripts" if os.name == "nt" else "bin") / "python"
    command = ["-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index", str(wheel)]
    subprocess.run([sys.executable, *command], check=True)
    asked = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True,
        text=True,
        check=True,
    )
    ours = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    Path(asked.stdout.strip(), "dependencies.pth").write_text("".join(f"{path}\n" for path in sorted(ours)))
    return python


def run(python: Path, folder: Path, *command: str) -> str:
    """Runs a command of the installed package in an empty folder; returns what it printed."""
    words = [str(python.with_name("warpgarment")), *command]
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    ran = subprocess.run(words, cwd=folder, env=inherited, capture_output=True, text=True)
    if ran.returncode:
        raise SystemExit(f"{' '.join(words)} ended with {ran.returncode}:\n{ran.stdout}{ran.stderr}")
    return ran.stdout


def main(root: Path, into: Path) -> int:
    """Builds, compares, installs and runs; returns the exit status."""
    into.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        tree = work / "tree"  # setuptools leaves build/ and .egg-info/ where it builds
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=root, capture_output=True, check=True).stdout.decode()
        for file in filter(None, listed.split("\0")):
            if (root / file).is_file():
                (tree / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(root / file, tree / file)
        sdist = build(tree, "sdist", into)
        with tarfile.open(sdist) as archive:
            archive.extractall(work / "sdist", filter="data")
        (unpacked,) = (work / "sdist").iterdir()
        wheel = build(unpacked, "wheel", into)
        faults = [f"{file} is not in the sdist" for file in OTHERS if not (unpacked / file).exists()]
        faults += wrong_files(wheel, expected(tree))
        with zipfile.ZipFile(wheel) as archive:
            (described,) = (entry for entry in archive.namelist() if entry.endswith(".dist-info/METADATA"))
            faults += wrong_metadata(email.parser.BytesParser().parsebytes(archive.read(described)))
        python = environment(work / "venv", wheel)
        where = "import warpgarment, warpgarment.kernels.sdf, warpgarment.training.cli as t; print(t.__file__)"
        found = subprocess.run([python, "-c", where], cwd=work, capture_output=True, text=True)
        if str(work / "venv") not in found.stdout:
            faults.append(f"the package is not imported from the environment: {found.stdout}{found.stderr}")
        print(f"{sdist.name} ({sdist.stat().st_size:,} bytes), {wheel.name} ({wheel.stat().st_size:,} bytes)")
        for fault in faults:
            print(f"  {fault}")
        if faults:
            return 1
        print(f"warpgarment {run(python, work, '--version').strip()}, in an environment of its own:")
        print(
            run(
                python, work, "demo", "--out", "demo", "--frames", "3", "--moments", "2", "--no-film", "--device", "cpu"
            )
        )
        made = {file.suffix for file in (work / "demo").rglob("*") if file.is_file()}
        if not {".usd", ".png"} <= made:
            print(f"  the demo wrote only {', '.join(sorted(made)) or 'nothing'}")
            return 1
    return 0


if __name__ == "__main__":
    here = Path(__file__).resolve().parent.parent
    sys.exit(main(here, Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else here / "dist"))
