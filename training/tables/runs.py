"""Trained rows: each in a folder of its own, trained once, with the settings that all rows of a table share.

`row.json` in the folder holds the settings and data of the run, and whether it is complete. A complete run is used as
it is; an interrupted one is continued; one with other settings, other data or another budget is refused, never
overwritten.
"""

from __future__ import annotations

import gc
import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warpgarment.errors import CheckpointError
from warpgarment.io.disk.atomic import atomic_file
from warpgarment.io.disk.plain import read_json
from warpgarment.nn import checkpoint
from warpgarment.training.data.schema import shown
from warpgarment.training.data.sequence import read_manifest
from warpgarment.training.train.config import TrainConfig
from warpgarment.training.train.start import train
from warpgarment.training.train.training_set import folders_of

from .settings import described, differences

RECORD = "row.json"
_KINDS: dict[str, tuple[type, ...]] = {  # of its entries
    "settings": (dict,), "data": (dict,), "complete": (bool,), "file": (str,), "sha256": (str,), "steps": (int,),
    "hours": (int, float), "validation": (int, float, str),
}  # fmt: skip


class RunMismatch(ValueError):
    """A folder holds another run than the one of this row; the message lists the differences."""


@dataclass(frozen=True)
class Run:
    """A trained row.

    Attributes:
        file: Checkpoint of the network that was best in the validation rollouts.
        steps: Number of training steps.
        hours: Time of the training [h].
        validation: Error of its best validation rollouts [cm]; None if there were none.
    """

    file: Path
    steps: int | None
    hours: float | None
    validation: float | None = None


def trained(folder: Path, config: TrainConfig, data: dict[str, Any]) -> Run:
    """The run of a row; a run that is not complete is trained, or its training is continued.

    Args:
        folder: Folder of the run.
        config: Settings of the run; `out` and `resume` are set here.
        data: Identity of the data, from `identity`.

    Raises:
        RunMismatch: The folder holds another run, or the training stopped before its budget was spent.
    """
    wanted = {"settings": described(config), "data": data}
    record = read_record(folder)
    if record is None:
        if folder.is_dir() and any(folder.iterdir()):
            raise RunMismatch(f"{folder} holds files but no {RECORD}: this command did not start it. Give other --runs")
        _write(folder, wanted | {"complete": False})
    else:
        _check_same(folder, record, wanted)
        if record.get("complete"):
            return _complete(folder, record, config)
    file = train(replace(config, out=folder, resume=True))
    gc.collect()  # sequences and loader of the run refer to each other, and the next row loads its own
    if config.steps is not None:
        done = _notes(folder / "network.safetensors").get("steps")
        if done not in (None, config.steps):
            raise RunMismatch(f"{folder}: training stopped after {done} of {config.steps} steps; run it again")
    notes = _notes(folder / "network.safetensors")  # those of the last step; `file` may be of an earlier step
    record = wanted | {"complete": True, "file": Path(file).name, "sha256": _checksum(Path(file))}
    record |= {"steps": notes.get("steps"), "hours": notes.get("hours"), "validation": notes.get("rollout_error_cm")}
    _write(folder, record)
    return _complete(folder, record, config)


def identity(root: Path) -> dict[str, Any]:
    """The data of a run: name, and the checksum of all sequences for training and validation."""
    digest, count = hashlib.sha256(), {}
    for split in ("train", "validation"):
        folders = folders_of(root, split, {})  # those of training, which reports the sequences it skips
        count[split] = len(folders)
        for folder in folders:
            digest.update(json.dumps([split, folder.name, read_manifest(folder).get("checksums")]).encode())
    return {"train": count["train"], "validation": count["validation"], "sha256": digest.hexdigest()}


def _check_same(folder: Path, record: dict[str, Any], wanted: dict[str, Any]) -> None:
    # A setting that was introduced later has its default value in older records.
    settings = described(TrainConfig(data=Path(), out=Path(), steps=1)) | record.get("settings", {})
    parts = [differences(record.get("data", {}), wanted["data"]), differences(settings, wanted["settings"])]
    changed = [*(f"data {text}" for text in parts[0]), *parts[1]]
    if changed:
        more = f", and {len(changed) - 4} more" if len(changed) > 4 else ""
        raise RunMismatch(
            f"{folder} holds a run with other settings: {'; '.join(changed[:4])}{more}. Every row of a table has the "
            "same budget: give the settings it was made with, or other --runs"
        )


def _complete(folder: Path, record: dict[str, Any], config: TrainConfig) -> Run:
    """The network of a complete run, after a check that it is the one of the record."""
    file = folder / str(record.get("file"))
    if not file.is_file() or _checksum(file) != record.get("sha256"):
        raise RunMismatch(f"{folder}: {file.name} is missing or another than {RECORD} says; remove the folder")
    shape = checkpoint.read_metadata(file)[0].as_dict()
    if shape != config.network_config().as_dict():
        raise RunMismatch(f"{file}: {'; '.join(differences(shape, config.network_config().as_dict()))}")
    error = record.get("validation")  # the name of a number, such as "inf", if all validation rollouts failed
    return Run(file, record.get("steps"), record.get("hours"), error if isinstance(error, float) else None)


def read_record(folder: Path) -> dict[str, Any] | None:
    try:
        record = read_json(folder / RECORD)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise RunMismatch(f"{folder / RECORD} cannot be read ({error}); remove the folder") from error
    if not isinstance(record, dict):
        raise RunMismatch(f"{folder / RECORD} is not a JSON object; remove the folder")
    wrong = [key for key, kinds in _KINDS.items() if not isinstance(record.get(key), (*kinds, type(None)))]
    if wrong or Path(record.get("file") or "network").name != (record.get("file") or "network"):
        raise RunMismatch(
            f"{folder / RECORD} says {shown(record.get((wrong or ['file'])[0]))} for {(wrong or ['file'])[0]}; "
            "remove the folder"
        )
    return record


def _write(folder: Path, record: dict[str, Any]) -> None:
    with atomic_file(folder / RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=1), "utf-8")


def _notes(path: Path) -> dict[str, Any]:
    try:
        return dict(checkpoint.read_metadata(path)[1])
    except CheckpointError:
        return {}


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
