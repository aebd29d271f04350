"""Checkpoints: safetensors that hold the weights, the statistics and, as JSON, the `NetworkConfig`.

One file, or a folder of shards with an index (`shards.py`). Its metadata have the keys `kind` ("warpgarment.network"),
`format_version`, `config`, `notes` (a JSON object of any facts about the training run) and `format` ("pt", without
which the tools of the Hugging Face Hub refuse a file; in older checkpoints it holds the value of `kind`). Nothing in a
checkpoint is executed when it is read.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors.torch import save as serialise

from warpgarment.errors import CheckpointError
from warpgarment.io.disk.atomic import atomic_file

from . import hub, shards
from .architecture import ARCHITECTURES, architecture, build_network, check_name
from .bounds import check_settings, checked_json
from .config import NetworkConfig
from .device import device_of

if TYPE_CHECKING:
    from .network import GarmentNetwork

KIND = "warpgarment.network"
FORMAT_VERSION = 1
WEIGHTS = Path(__file__).parents[1] / "assets" / "weights"  # networks that ship with the package
FIRST = {  # settings that every checkpoint must have; a missing later one takes its default
    "embedding",
    "layers",
    "feed_forward",
    "heads",
    "manifold_heads",
    "dropout",
    "history",
    "geodesic_power",
    "geodesic_radius",
    "residual",
    "heading",
    "norm_first",
    "activation",
    "fps",
}
_DTYPES = (torch.float32, torch.bfloat16, torch.float16)


def save(
    network: GarmentNetwork,
    path: str | os.PathLike[str],
    *,
    dtype: torch.dtype | None = None,
    notes: Mapping[str, object] | None = None,
    max_shard_bytes: int | None = None,
) -> None:
    """Writes a checkpoint under a temporary name and renames it, so that nobody reads an incomplete one.

    Args:
        network: The network to write.
        path: A file, or with `max_shard_bytes` a folder.
        dtype: Type of the weights in the file: float32 (None), bfloat16 or float16; statistics are always float32.
        notes: Facts about the network that JSON can hold, stored in the metadata.
        max_shard_bytes: Largest size of a file [bytes]; a folder with an index is written, in the layout of Hugging
            Face. None writes a single file.

    Raises:
        CheckpointError: A weight or statistic is not finite.
        ValueError: The dtype is another one, or a tensor is larger than a shard may be.
        FileExistsError: The folder holds something other than a checkpoint.
    """
    dtype = dtype or torch.float32
    if dtype not in _DTYPES:
        raise ValueError(f"dtype must be one of {', '.join(str(d)[6:] for d in _DTYPES)}, got {str(dtype)[6:]}")
    tensors = {}
    for name, tensor in network.state_dict().items():
        tensor = tensor.detach().to("cpu", torch.float32 if name in network.statistics else dtype).contiguous()
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{name} is not finite in {str(dtype)[6:]}; nothing was written to {path}")
        tensors[name] = tensor
    metadata = {
        "format": "pt",
        "kind": KIND,
        "format_version": str(FORMAT_VERSION),
        "config": json.dumps(network.config.as_dict()),
        "notes": json.dumps(dict(notes or {})),
    }
    if max_shard_bytes is not None:
        shards.write(Path(path), tensors, metadata, max_shard_bytes)
        return
    with atomic_file(Path(path)) as temporary:
        temporary.write_bytes(serialise(tensors, metadata=metadata))


def load(path: str | os.PathLike[str], *, device: torch.device | str | None = None) -> GarmentNetwork:
    """Reads a checkpoint.

    Args:
        path: A file or folder that `save` wrote.
        device: Device of the network; None for the CPU.

    Returns:
        The network, of the kind that its config names, in float32 and in evaluation mode.

    Raises:
        CheckpointError: There is no file, it is truncated or of another format, shards do not belong together, or
            settings or tensors do not fit; the message says which.
    """
    contents = shards.contents(path)
    path = contents.path
    config, _ = _described(contents)
    with torch.device("meta"):  # only shapes: nothing is allocated before the tensors of the file have these shapes
        network = build_network(config)
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    _check_tensors(path, expected, contents.shapes)
    network = build_network(config)
    tensors = contents.tensors()
    for name, tensor in tensors.items():
        if tensor.dtype not in _DTYPES:
            raise CheckpointError(f"{path}: {name} is {str(tensor.dtype)[6:]}, expected a floating-point tensor")
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{path}: {name} is not finite; the network was saved after training had diverged")
        if name.endswith("_std") and name in network.statistics and (tensor <= 0).any():
            raise CheckpointError(f"{path}: {name} must be positive, smallest is {tensor.min().item():g}")
    network.load_state_dict(tensors)
    return network.to(device or "cpu").eval()


def read_metadata(path: str | os.PathLike[str]) -> tuple[NetworkConfig, dict[str, object]]:
    """The settings and the notes of a checkpoint, file or folder, without its weights.

    Raises:
        CheckpointError: As for `load`.
    """
    return _described(shards.contents(path))


def find(name: str | os.PathLike[str], *, device: torch.device | str | None = None) -> Path:
    """Finds a checkpoint by name: first as a path, then among the networks that ship, then on the Hugging Face Hub.

    Args:
        name: A checkpoint file, or a folder that holds one; "default" or the name of a network that ships; or a
            repository of the Hugging Face Hub, `owner/name` or `owner/name@revision`, which is fetched.
        device: Device on which the network will run. It decides what "default" is: on a GPU `base` if that ships,
            otherwise the name in default.txt beside the weights. None takes a GPU if there is one, as in `Simulator`.

    Returns:
        A file, or a folder of shards.

    Raises:
        CheckpointError: There is none, or several; the message says what there is and what was tried.
        MissingExtra: It can only be a repository, and huggingface-hub is not installed.
    """
    if Path(name).exists():
        return shards.locate(name)
    ships = shipped()
    wanted = os.fspath(name)
    if wanted == "default":
        wanted = _default(ships, device)
    if wanted in ships:
        return shards.locate(ships[wanted])
    there = ", ".join(sorted(ships)) if ships else "none in this installation"
    tried = f"no network {wanted!r}: neither a file, a folder, nor one that ships ({there})"
    if not hub.is_repository(wanted):
        raise CheckpointError(tried)
    folder = hub.fetch(wanted, tried)
    try:
        return shards.locate(folder)
    except CheckpointError as error:
        raise CheckpointError(f"{wanted} on the Hugging Face Hub holds no network: {error}") from error


def shipped() -> dict[str, Path]:
    """Networks that ship with the package, by name: files, and folders of shards."""
    files = {file.stem: file for file in WEIGHTS.glob("*.safetensors")}
    return files | {index.parent.name: index.parent for index in WEIGHTS.glob(f"*/{shards.INDEX}")}


def shipped_reads() -> dict[str, frozenset[str]]:
    """The optional inputs that each network that ships reads (`GarmentNetwork.reads`), by name."""
    found = {}
    for name, place in sorted(shipped().items()):
        with torch.device("meta"):  # only its settings are read
            found[name] = build_network(read_metadata(place)[0]).reads
    return found


def _default(ships: Mapping[str, Path], device: torch.device | str | None) -> str:
    # only the kind of device counts here: the caller that runs the network checks that there is one
    if device is None:
        gpu = torch.cuda.is_available()
    else:
        gpu = str(device).partition(":")[0] == "cuda" or device_of(device).type != "cpu"
    if gpu and "base" in ships:
        return "base"
    pointer = WEIGHTS / "default.txt"
    return pointer.read_text(encoding="utf-8").strip() if pointer.is_file() else "default"


def _described(contents: shards.Contents) -> tuple[NetworkConfig, dict[str, object]]:
    path, metadata = contents.path, contents.metadata
    if metadata.get("kind", metadata.get("format")) != KIND:
        raise CheckpointError(f"{path}: a safetensors file, but no warpgarment network (kind {KIND!r} is missing)")
    version = metadata.get("format_version", "")
    if version != str(FORMAT_VERSION):
        raise CheckpointError(
            f"{path}: format version {version or 'missing'}, this warpgarment reads {FORMAT_VERSION}; update it"
        )
    settings = _json_object(path, "config", metadata)
    check_settings(path, settings, len(contents.shapes))
    return _config(path, settings), _json_object(path, "notes", metadata)


def _check_tensors(path: object, expected: Mapping[str, tuple], found: Mapping[str, tuple]) -> None:
    missing = sorted(expected.keys() - found.keys())
    if missing:
        raise CheckpointError(f"{path}: {len(missing)} tensors are missing (first: {missing[0]})")
    extra = sorted(found.keys() - expected.keys())
    if extra:
        raise CheckpointError(f"{path}: {len(extra)} tensors do not belong to its config (first: {extra[0]})")
    for name, shape in expected.items():
        if found[name] != shape:
            raise CheckpointError(f"{path}: {name} has shape {list(found[name])}, its config says {list(shape)}")


def _json_object(path: object, key: str, metadata: Mapping[str, str]) -> dict[str, Any]:
    if key not in metadata:
        raise CheckpointError(f"{path}: metadata {key!r} is missing or not JSON")
    return checked_json(path, f"metadata {key!r}", metadata[key])


def _config(path: object, settings: dict[str, Any]) -> NetworkConfig:
    name = settings.get("architecture")
    if isinstance(name, str):
        try:
            check_name(name)
        except ValueError as error:
            raise CheckpointError(f"{path}: {error}") from None
    described = architecture(name).config if isinstance(name, str) and name in ARCHITECTURES else NetworkConfig
    fields = {field.name: field for field in dataclasses.fields(described)}
    unknown = sorted(settings.keys() - fields.keys())
    if unknown:
        raise CheckpointError(f"{path}: unknown settings {', '.join(unknown)}; written by a newer warpgarment?")
    missing = sorted(FIRST - settings.keys())
    if missing:
        raise CheckpointError(f"{path}: settings {', '.join(missing)} are missing")
    for name, value in settings.items():
        kind = type(fields[name].default)
        if kind is tuple and isinstance(value, list) and all(isinstance(part, str) for part in value):
            settings[name] = value = tuple(value)  # JSON has no tuples
        fits = isinstance(value, (int, float)) if kind is float else isinstance(value, kind)
        if not fits or (isinstance(value, bool) and kind is not bool):
            raise CheckpointError(f"{path}: setting {name} must be {kind.__name__}, got {value!r}")
    try:
        return described(**settings)
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from error
