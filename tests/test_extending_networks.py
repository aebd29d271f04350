"""What docs/extending.md shows, carried out as it stands there, from outside the package."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from support import sequences as synthetic_sequences

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "extending.md").read_text("utf-8")


def blocks(heading: str) -> list[str]:
    """The blocks of code of a section of the page."""
    section = TEXT.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return re.findall(r"```(?:python|text)\n(.*?)```", section, re.DOTALL)


MODULE, SCRIPT = blocks("A network")
ROW, EXPRESSION, REFERENCE, READER = blocks("A feature channel")


def run(*command: str, folder: Path, path: Path) -> str:
    """Runs Python in a folder, with modules of `path` before all others; its output."""
    environment = os.environ | {"PYTHONPATH": str(path), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def test_a_network_of_a_users_own(tmp_path):
    """A reader who does what the page says would get an error, or a network of another kind."""
    data = synthetic_sequences.write_set(tmp_path / "sequences", train=2, validation=0, test=0, frames=16)
    (tmp_path / "alone.py").write_text(MODULE)
    (tmp_path / "mine.py").write_text(SCRIPT)
    output = run("mine.py", str(data), str(tmp_path / "run"), "2", folder=tmp_path, path=tmp_path)
    assert output.splitlines()[-1].startswith("Alone (10, ")
    elsewhere = (
        f"import warpgarment as wg; wg.Simulator.from_pretrained({str(tmp_path / 'run' / 'network.safetensors')!r})"
    )
    done = subprocess.run([sys.executable, "-c", elsewhere], cwd=tmp_path, capture_output=True, text=True)
    assert 'architecture must be "faces", "patches" or "layers", got \'alone\'' in done.stderr


def insert(path: Path, line: str, after: str) -> None:
    """Puts a line of the page behind a line of a file, indented as that is."""
    text, indent = path.read_text("utf-8"), " " * (len(after) - len(after.lstrip()))
    assert text.count(after) == 1, after
    path.write_text(text.replace(after, after + indent + line), "utf-8")


def test_a_feature_channel(tmp_path):
    """The page would name a place that there is not, or leave one out. On a copy of the sources, whose own tests run.

    A network that ships must not notice: its positions after three frames, bit by bit.
    """
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "warpgarment", tmp_path / "warpgarment", ignore=ignored)
    for name in ("kernels", "training"):
        shutil.copytree(ROOT / name, tmp_path / "warpgarment" / name, ignore=ignored)
    for name in ("support", "reference"):
        shutil.copytree(ROOT / "tests" / name, tmp_path / name, ignore=ignored)
    tests = ("test_channels.py", "test_face.py")
    for name in tests:
        shutil.copy(ROOT / "tests" / "kernels" / "features" / name, tmp_path)
    kernels = tmp_path / "warpgarment" / "kernels" / "features"
    insert(kernels / "channels.py", ROW, '        Channel("singular_values", 3, Kind.SCALAR),\n')
    insert(kernels / "face.py", EXPRESSION, '    features[i, wp.static(AT["signed_distance"])] = sign * distance\n')
    insert(tmp_path / "reference" / "features.py", REFERENCE, "        deformation.singular_values(phi),\n")
    (tmp_path / "check.py").write_text(
        READER
        + """
import hashlib
import sys

import warpgarment as wg
from warpgarment.kernels.features import FEATURES
from warpgarment.nn.architecture import build_network

item = wg.demo.assets().garments["tshirt"]

def moved(simulator):
    motion = simulator.rollout(item.garment, wg.demo.assets().collider, first_vertices=item.first_vertices, frames=3)
    return hashlib.sha256(motion.vertices.tobytes()).hexdigest()

if "new" in sys.argv:
    network = build_network(config)
    assert network.embed_faces.in_features == 10 * 35
    moved(wg.Simulator(network, "cpu"))
print(FEATURES, moved(wg.Simulator.from_pretrained("small", device="cpu")))
"""
    )
    (tmp_path / "old.py").write_text((tmp_path / "check.py").read_text().replace(READER, ""))
    new = run("check.py", "new", folder=tmp_path, path=tmp_path).split()[-2:]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.move(tmp_path / "old.py", elsewhere)
    old = run("old.py", folder=elsewhere, path=elsewhere).split()[-2:]
    assert (old[0], new[0]) == ("34", "35")
    assert old[1] == new[1]
    options = ["-q", "-p", "no:cacheprovider"]
    output = run("-m", "pytest", *tests, *options, folder=tmp_path, path=tmp_path)
    assert "passed" in output
    assert "area" in run("-m", "pytest", tests[0], "--collect-only", "-q", folder=tmp_path, path=tmp_path)
