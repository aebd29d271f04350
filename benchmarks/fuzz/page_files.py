"""Sound files that training and evaluation write for themselves, and what their readers make of a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.bodies.rest import PHENOTYPES, RestBody
from warpgarment.io.npz import write_npz
from warpgarment.view import markdown

from .shapes import box

Facts = dict[str, Any]
NOTES = {"steps": 3}


def write_evaluation(folder: Path) -> Path:
    """The result of an evaluation."""
    from warpgarment.nn.config import NetworkConfig

    figures = {"mean_vertex_error_cm": 1.5, "finite": True, "max_penetration_m": 0.001}
    row = {"sequence": "a", "start": "cold", "category": "dress", "motion": "clip", "frames": 30}
    rows = [row | {"sequence": name, "network": figures, "skinned": figures, "rigid": figures} for name in "abc"]
    mean = {"cold": {method: figures | {"sequences": 3} for method in ("network", "skinned", "rigid")}}
    about = {"file": "a.safetensors", "config": NetworkConfig().as_dict(), "notes": NOTES}
    result = {"network": about, "mean": mean, "sequences": rows, "frames_predicted": 90, "skipped": {"d": "too short"}}
    (folder / "evaluation.json").write_text(json.dumps(result | {"settings": {"split": "test"}}))
    return folder / "evaluation.json"


def evaluation(path: Path) -> Facts:
    """What the page of a network shows of it."""
    from warpgarment.nn.config import NetworkConfig
    from warpgarment.training.evaluate.model_card import chosen, read_evaluation
    from warpgarment.training.evaluate.model_card_page import figures

    found = read_evaluation(path, NetworkConfig().as_dict(), NOTES)
    cases = [(case.role, case.row["sequence"], case.file) for case in chosen(found["sequences"])]
    return {"cases": repr(cases), "page": "\n".join(figures(found))}


def write_log(folder: Path) -> Path:
    """The log of a training."""
    lines = [json.dumps({"step": k, "seconds": 0.5 * k, "loss": 1.0 / (k + 1)}) for k in range(20)]
    lines.insert(10, json.dumps({"step": 10, "rollout_error_cm": 3.5}))
    (folder / "log.jsonl").write_text("\n".join(lines) + "\n")
    return folder / "log.jsonl"


def log(path: Path) -> Facts:
    """What a run that goes on keeps of it, and what a page shows."""
    from warpgarment.training.evaluate.model_card import read_log
    from warpgarment.training.train.log import RunLog

    shown = read_log(path)
    RunLog(path.parent, resumed=12).close()
    kept = [line.strip() for line in path.read_text("utf-8").splitlines()]
    return {"shown": json.dumps(shown), "steps": [line["step"] for line in shown], "kept": kept}


def write_row(folder: Path) -> Path:
    """The record of a row of a table."""
    record = {"settings": {"steps": 3, "seed": 0}, "data": {"train": 3, "validation": 1, "sha256": "ab"}}
    record |= {
        "complete": True,
        "file": "best.safetensors",
        "sha256": "ab",
        "steps": 3,
        "hours": 0.1,
        "validation": 2.5,
    }
    (folder / "row.json").write_text(json.dumps(record))
    return folder / "row.json"


def row(path: Path) -> Facts:
    """The same."""
    from warpgarment.training.tables.runs import read_record

    found = read_record(path.parent)
    return {"text": json.dumps(found, sort_keys=True)}


def write_rest_body(folder: Path) -> Path:
    """A body at rest with its bones."""
    vertices, faces = box()
    count = len(vertices)
    write_npz(folder / "body.npz", {
        "vertices": vertices, "faces": faces, "joints": np.zeros((2, 3), np.float32),
        "bone_names": np.array(["Hips", "Head"]), "bone_parents": np.array([-1, 0], np.int32),
        "bone_indices": np.zeros((count, 2), np.uint8), "bone_weights": np.full((count, 2), 0.5, np.float32),
        "phenotype": np.full(len(PHENOTYPES), 0.5),
    })  # fmt: skip
    return folder / "body.npz"


def rest_body(path: Path) -> Facts:
    """What poses and garments are made from."""
    found = RestBody.load(path)
    assert all(0 <= i < len(found.bone_names) for i in found.bone_indices.reshape(-1).tolist())
    facts = {"vertices": found.vertices, "faces": found.faces, "joints": found.joints, "weights": found.bone_weights}
    return facts | {"phenotype": np.array(list(found.phenotype.values())), "names": list(found.bone_names)}


def text(path: Path) -> Facts:
    """A text of strangers in a page: no tag, and no cell of a table."""
    plain = path.read_bytes().decode("utf-8", "replace")
    cell = markdown.table(["a", "b"], [[markdown.escape(plain), markdown.code(plain)]])[-1]
    assert "\n" not in cell, "a line break"
    return {"page": cell}
