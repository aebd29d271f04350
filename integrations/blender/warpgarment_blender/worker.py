"""Simulates one job: run by a Python that has warpgarment, `python worker.py FOLDER`; Blender is not needed.

FOLDER holds job.json (network, device, material, wind, clean) and job.npz: rest and first [V,3], faces [F,3] and pins
of the garment, body [T,U,3] and body_faces [G,3], fps and start, in metres with Y up. The result is result.npz with
vertices [T,V,3], of the body's frames. Progress goes to the standard error, as warpgarment shows it; the last line of
the standard output is an object of JSON: {"warnings": [...]}, or {"error": "..."} where the exit status is 1.
"""

from __future__ import annotations

import json
import sys
import traceback
import warnings
from pathlib import Path
from typing import Any

import numpy as np


def simulate(folder: Path) -> None:
    """Reads the job of a folder and writes its result."""
    import warpgarment as wg

    options = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    with np.load(folder / "job.npz", allow_pickle=False) as data:
        arrays = {name: data[name] for name in data.files}
    told: dict[str, Any] = {"pins": arrays["pins"], "name": options["name"]}
    if options["clean"]:
        garment = wg.Garment.cleaned_from(arrays["rest"], arrays["faces"], keep=True, **told)
    else:
        garment = wg.Garment(arrays["rest"], arrays["faces"], **told)
    if len(garment.vertices) != len(arrays["rest"]):
        raise ValueError("the garment has vertices that are not finite. Repair its mesh.")
    body = wg.BodyMotion(arrays["body"], arrays["body_faces"], float(arrays["fps"]), start=float(arrays["start"]))
    given: dict[str, Any] = {"first_vertices": arrays["first"], "out_fps": "body", "progress": True}
    if options["material"]:
        given["materials"] = wg.Material.preset(options["material"])
    if any(options["wind"]):
        given["wind"] = wg.Wind.of_velocities(options["wind"])
    if options["itself"]:
        given["layers"] = True
    simulator = wg.Simulator.from_pretrained(options["network"], device=options["device"] or None)
    motion = simulator.rollout(garment, body, **given)
    if not np.isfinite(motion.vertices).all():
        raise ValueError(f"the simulation stopped after {motion.frames - 1} frames: {motion.status[-1].message}")
    np.savez(folder / "result.npz", vertices=motion.vertices)


def main() -> int:
    """Simulates, and says how it went; returns the exit status."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", UserWarning)
        try:
            simulate(Path(sys.argv[1]))
        except Exception as error:
            traceback.print_exc()
            print(json.dumps({"error": " ".join(f"{type(error).__name__}: {error}".split())}))
            return 1
    print(json.dumps({"warnings": list(dict.fromkeys(" ".join(str(w.message).split()) for w in heard))}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
