"""Times every stage against a reference in the same run, and writes a table.

    python -m benchmarks                     # the device at hand
    python -m benchmarks --faces 1000 2000   # other garment sizes

References: libigl for signed distances, SciPy's SuperLU for the two linear systems (prefactored for Poisson, factored
in every call for the refinement, as the paper does it), NumPy for deformation gradients. Each figure is the median of
several calls; the ratio is reference time over ours. Results: benchmarks/results/<device>.json and .md.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from . import stages, step

RESULTS = Path(__file__).parent / "results"


def median_ms(call: Callable[[], object], device: torch.device, repeats: int = 9) -> float:
    """Median time of a call [ms], after two calls to warm up."""

    def finish() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    times = []
    for number in range(repeats + 2):
        finish()
        began = time.perf_counter()
        call()
        finish()
        if number >= 2:
            times.append(1e3 * (time.perf_counter() - began))
    return statistics.median(times)


def machine(device: torch.device) -> dict[str, str]:
    """What the figures were measured on."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    packages = ("warpgarment", "warp-lang", "torch", "numpy", "scipy", "libigl")
    versions = {n: importlib.metadata.version(n) for n in packages}
    return {"device": name, "torch threads": str(torch.get_num_threads()), **versions}


def main() -> None:
    """Runs all benchmarks."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--faces", type=int, nargs="+", default=[1000, 2000, 5000])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--weights", default="default")
    options = parser.parse_args()
    device = torch.device(options.device)
    if device.type == "cpu":
        torch.set_num_threads(1)
    rows = []
    for faces in options.faces:
        for row in (*stages.rows(faces, device, median_ms), *step.rows(faces, device, options.weights)):
            rows.append(row)
            reference = f"{row['reference_ms']:.2f} ms {row['reference']}" if row.get("reference_ms") else "-"
            print(f"{row['faces']:>6,} faces  {row['stage']:<34} {row['ms']:>8.2f} ms   {reference}", flush=True)
    RESULTS.mkdir(exist_ok=True)
    about = machine(device)
    target = RESULTS / device.type
    target.with_suffix(".json").write_text(json.dumps({"machine": about, "rows": rows}, indent=1))
    target.with_suffix(".md").write_text(markdown(about, rows))
    print(f"written {target.relative_to(Path.cwd()) if target.is_relative_to(Path.cwd()) else target}.md")


def markdown(about: dict[str, str], rows: list[dict]) -> str:
    """The results as a table."""
    lines = ["# " + ", ".join(f"{k} {v}" for k, v in about.items()), ""]
    lines += ["`python -m benchmarks`, medians. Ratio: reference time over ours.", ""]
    lines += ["| faces | stage | ms | reference | ms | ratio |", "| ---: | --- | ---: | --- | ---: | ---: |"]
    for row in rows:
        reference = row.get("reference_ms")
        compared = f"{row['reference']} | {reference:.2f} | {reference / row['ms']:.1f}" if reference else "- | - | -"
        lines.append(f"| {row['faces']:,} | {row['stage']} | {row['ms']:.2f} | {compared} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
