"""Records the results of the program and compares a later build with them bit for bit, for restructurings.

    python -m benchmarks.unchanged record DIR                  # with the build before; DIR is outside the repository
    python -m benchmarks.unchanged compare DIR                 # with the build after, on the same machine
    python -m benchmarks.unchanged compare DIR --only rollouts training

The parts are `rollouts`, hashes of 40 frames of both demo garments, as a batch, one by one, and by start and step;
`training`, the losses of 20 steps, single and unrolled, on data that the first build wrote; `recipes`, the checksum of
one short sequence of each recipe; `help`, the text of every verb; `names`, public names, and tensors and metadata of
the bundled networks; `wheel`, the files of the wheel, with hashes of data files. All parts run on one CPU thread.
Hashes depend on the processor and on library versions, so recordings are not kept in the repository.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import runpy
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import warpgarment as wg

FRAMES = 40
NETWORKS = ("fast", "small")
RECIPES = ("cloth3d", "layers", "seams")
TRAINING = {
    "single": ["--steps", "20", "--batch-size", "4"],
    "unrolled": ["--steps", "20", "--batch-size", "2", "--unroll.steps", "4", "--splits", "1"],
}


def digest(data: Any) -> str:
    """SHA-256 of an array's bytes, or of a text."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data.tobytes()).hexdigest()


def warpgarment(*arguments: str) -> str:
    """Runs the command line of the present build and returns its standard output."""
    command = [sys.executable, "-m", "warpgarment", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-2000:]}")
    return done.stdout


def rollouts(_: Path) -> dict[str, Any]:
    """Hashes of the positions that the bundled networks predict."""
    assets, results = wg.demo.assets(), {}
    names = sorted(assets.garments)
    garments = [assets.garments[name].garment for name in names]
    first = [assets.garments[name].first_vertices for name in names]
    body = assets.collider
    for network in NETWORKS:
        simulator = wg.Simulator.from_pretrained(network, device="cpu")
        batch = simulator.rollout(garments, body, first_vertices=first, frames=FRAMES)
        for name, motion in zip(names, batch, strict=True):
            results[f"{network} {name} in a batch"] = digest(motion.vertices)
        for name, garment, start in zip(names, garments, first, strict=True):
            motion = simulator.rollout(garment, body, first_vertices=start, frames=FRAMES)
            results[f"{network} {name} alone"] = digest(motion.vertices)
            results[f"{network} {name} status"] = digest(repr(motion.status))
        shown = body.resampled(simulator.network.config.fps)
        state = simulator.start(garments, shown.vertices[0], shown.faces, first_vertices=first)
        for frame in range(1, FRAMES // 2):
            state = simulator.step(state, shown.vertices[frame])
        for name, vertices in zip(names, state.vertices, strict=True):
            results[f"{network} {name} by steps"] = digest(vertices)
    return results


def training(folder: Path) -> dict[str, Any]:
    """Losses of short trainings on the bundled simulation of the dress, with the data of the first recording."""
    data, results = folder / "data", {}
    if not data.exists():
        runpy.run_path("examples/05_train_on_own_data.py")["write_own_data"](data, 60)
    for network in NETWORKS:
        for kind, options in TRAINING.items():
            with tempfile.TemporaryDirectory() as out:
                cache = ["--cache", f"{out}/cache", "--out", f"{out}/run", "--device", "cpu", "--threads", "1"]
                rest = ["--log-every", "1", "--statistics-batches", "2", "--ahead", "0", "--validate-every", "1000"]
                warpgarment("train", "--data", str(data), "--network", network, *cache, *rest, *options)
                lines = (Path(out) / "run" / "log.jsonl").read_text().splitlines()
            losses = [entry["loss"] for entry in map(json.loads, lines) if "loss" in entry]
            results[f"{network} {kind}"] = [loss.hex() for loss in losses]
    return results


def recipes(_: Path) -> dict[str, Any]:
    """Checksums of a short sequence of each recipe."""
    results = {}
    for recipe in RECIPES:
        with tempfile.TemporaryDirectory() as out:
            options = ["--sequences", "1", "--frames", "5", "--faces", "300", "--least-frames", "1", "--attempts", "1"]
            options += ["--bodies", "bundled", "--keep-rejected"]
            warpgarment("generate", "--out", out, "--recipe", recipe, *options)
            manifests = sorted(Path(out).rglob("manifest.json"))
            results[recipe] = {m.parent.name: json.loads(m.read_text()).get("checksum") for m in manifests}
    return results


def help_texts(_: Path) -> dict[str, Any]:
    """The text of `--help` of every verb."""
    verbs = [line.split()[0] for line in warpgarment("--help").split("verbs:")[1].splitlines() if line.startswith("  ")]
    verbs = [verb for verb in verbs if not verb.startswith("-")]
    commands = [[], *([verb] for verb in verbs), *(["dataset", part] for part in ("verify", "card", "import"))]
    return {" ".join(command): warpgarment(*command, "--help") for command in commands}


def names(_: Path) -> dict[str, Any]:
    """Public names, and tensors and metadata of the bundled networks."""
    from safetensors import safe_open

    results: dict[str, Any] = {"public": sorted(wg.__all__)}
    for path in sorted((Path(wg.__file__).parent / "assets" / "weights").glob("*.safetensors")):
        with safe_open(str(path), "pt") as stored:
            shapes = {key: list(stored.get_slice(key).get_shape()) for key in stored.keys()}
            results[path.stem] = [shapes, stored.metadata()]
    return results


def wheel(_: Path) -> dict[str, Any]:
    """Files of the wheel; a file that is not Python has its hash beside it."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", out, "."]
        subprocess.run(command, check=True, capture_output=True)
        with zipfile.ZipFile(next(Path(out).glob("*.whl"))) as files:
            inside = [n for n in files.namelist() if ".dist-info/" not in n]
            return {n: "" if n.endswith(".py") else hashlib.sha256(files.read(n)).hexdigest() for n in inside}


PARTS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "names": names,
    "help": help_texts,
    "rollouts": rollouts,
    "training": training,
    "recipes": recipes,
    "wheel": wheel,
}


def differences(before: Any, after: Any, name: str = "") -> list[str]:
    """The differences between two recordings, one line each."""
    if isinstance(before, dict) and isinstance(after, dict):
        lines = []
        for key in sorted({*before, *after}):
            label = f"{name} / {key}" if name else key
            if key not in after or key not in before:
                lines.append(f"{label}: {'gone' if key in before else 'new'}")
            else:
                lines += differences(before[key], after[key], label)
        return lines
    if before == after:
        return []
    return [f"{name}: {str(before)[:120]!r} -> {str(after)[:120]!r}"]


def main() -> int:
    """Records or compares; the exit status is 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", choices=list(PARTS), default=list(PARTS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.folder.mkdir(parents=True, exist_ok=True)
    wrong = 0
    for part in options.only:
        path = options.folder / f"{part}.json"
        results = PARTS[part](options.folder)
        if options.action == "record":
            path.write_text(json.dumps(results, indent=1))
            print(f"{part}: recorded", flush=True)
            continue
        lines = differences(json.loads(path.read_text()), json.loads(json.dumps(results)))
        wrong += len(lines)
        print(
            f"{part}: {'unchanged' if not lines else f'{len(lines)} differences'}", *lines[:40], sep="\n  ", flush=True
        )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
