"""Checkpoints: one safetensors file that holds the weights, the statistics and, as JSON, the `NetworkConfig`.

Metadata keys: `format` ("warpgarment.network"), `format_version`, `config`, and `notes`, a JSON object for whatever a
training run wants to say about itself. Nothing in a checkpoint is executed when it is read.
"""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise

from warpgarment.errors import CheckpointError
from warpgarment.network import STATISTICS, ManifoldAwareTransformer, NetworkConfig

FORMAT = "warpgarment.network"
FORMAT_VERSION = 1
WEIGHTS = Path(__file__).parent / "assets" / "weights"  # networks that ship with the package
_DTYPES = (torch.float32, torch.bfloat16, torch.float16)


def save(
    network: ManifoldAwareTransformer,
    path: str | os.PathLike[str],
    *,
    dtype: torch.dtype | None = None,
    notes: Mapping[str, object] | None = None,
) -> None:
    """Writes a checkpoint: to a temporary file beside it, then renamed, so that nobody reads half of one.

    Args:
        network: What to write.
        path: A file; its folder must exist.
        dtype: Of the weights in the file, float32 (None), bfloat16 or float16; statistics are always float32.
        notes: Anything JSON can hold, kept in the metadata.

    Raises:
        CheckpointError: A weight or statistic is not finite.
        ValueError: Another dtype.
    """
    dtype = dtype or torch.float32
    if dtype not in _DTYPES:
        raise ValueError(f"dtype must be one of {', '.join(str(d)[6:] for d in _DTYPES)}, got {str(dtype)[6:]}")
    tensors = {}
    for name, tensor in network.state_dict().items():
        tensor = tensor.detach().to("cpu", torch.float32 if name in STATISTICS else dtype).contiguous()
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{name} is not finite in {str(dtype)[6:]}; nothing was written to {path}")
        tensors[name] = tensor
    metadata = {
        "format": FORMAT,
        "format_version": str(FORMAT_VERSION),
        "config": json.dumps(dataclasses.asdict(network.config)),
        "notes": json.dumps(dict(notes or {})),
    }
    path = Path(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".partial")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(serialise(tensors, metadata=metadata))
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # mkstemp makes files that only their owner can read
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def load(path: str | os.PathLike[str], *, device: torch.device | str | None = None) -> ManifoldAwareTransformer:
    """Reads a checkpoint.

    Args:
        path: A file that `save` wrote.
        device: Where the network goes; the CPU unless said otherwise.

    Returns:
        The network in float32 and in evaluation mode.

    Raises:
        CheckpointError: No file, a truncated or foreign one, or one whose settings or tensors do not fit; says which.
    """
    config, _ = read_metadata(path)
    network = ManifoldAwareTransformer(config)
    expected = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    tensors = {}
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            found = {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}
            _check_tensors(path, expected, found)
            for name in expected:
                tensors[name] = file.get_tensor(name)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error}); the file is damaged, get it again") from error
    for name, tensor in tensors.items():
        if tensor.dtype not in _DTYPES:
            raise CheckpointError(f"{path}: {name} is {str(tensor.dtype)[6:]}, expected a floating-point tensor")
        if not torch.isfinite(tensor).all():
            raise CheckpointError(f"{path}: {name} is not finite; the network was saved after training had diverged")
        if name.endswith("_std") and name in STATISTICS and (tensor <= 0).any():
            raise CheckpointError(f"{path}: {name} must be positive, smallest is {tensor.min().item():g}")
    network.load_state_dict(tensors)
    return network.to(device or "cpu").eval()


def read_metadata(path: str | os.PathLike[str]) -> tuple[NetworkConfig, dict[str, object]]:
    """The settings and the notes of a checkpoint, without its weights.

    Raises:
        CheckpointError: As `load`.
    """
    if not Path(path).is_file():
        raise CheckpointError(f"{path}: no such file")
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            metadata = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{path}: not a safetensors file, or one cut short ({error}); get it again or check the path"
        ) from error
    if metadata.get("format") != FORMAT:
        raise CheckpointError(f"{path}: a safetensors file, but no warpgarment network (format {FORMAT!r} is missing)")
    version = metadata.get("format_version", "")
    if version != str(FORMAT_VERSION):
        raise CheckpointError(
            f"{path}: format version {version or 'missing'}, this warpgarment reads {FORMAT_VERSION}; update it"
        )
    settings = _json_object(path, "config", metadata)
    return _config(path, settings), _json_object(path, "notes", metadata)


def find(name: str | os.PathLike[str]) -> Path:
    """The file of a network that ships, or that lies in a file or folder of that name.

    Args:
        name: "default", the name of a network that ships, a checkpoint file, or a folder that holds one.

    Raises:
        CheckpointError: There is none, or several; says what there is.
    """
    path = Path(name)
    if path.is_file():
        return path
    if path.is_dir():
        files = sorted(path.glob("best.safetensors")) or sorted(path.glob("*.safetensors"))  # best: a training run's
        if len(files) != 1:
            names = ", ".join(file.name for file in files) or "none"
            raise CheckpointError(f"{path}: a folder must hold one .safetensors file, found {names}; name the file")
        return files[0]
    shipped = sorted(file.stem for file in WEIGHTS.glob("*.safetensors"))
    wanted = os.fspath(name)
    if wanted == "default":
        pointer = WEIGHTS / "default.txt"
        wanted = pointer.read_text(encoding="utf-8").strip() if pointer.is_file() else "default"
    if wanted in shipped:
        return WEIGHTS / f"{wanted}.safetensors"
    there = ", ".join(shipped) if shipped else "none in this installation"
    raise CheckpointError(f"no network {wanted!r}: neither a file, a folder, nor one that ships ({there})")


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
    try:
        value = json.loads(metadata[key])
    except (KeyError, ValueError) as error:
        raise CheckpointError(f"{path}: metadata {key!r} is missing or not JSON") from error
    if not isinstance(value, dict):
        raise CheckpointError(f"{path}: metadata {key!r} is not a JSON object")
    return value


def _config(path: object, settings: dict[str, Any]) -> NetworkConfig:
    fields = {field.name: field for field in dataclasses.fields(NetworkConfig)}
    unknown = sorted(settings.keys() - fields.keys())
    if unknown:
        raise CheckpointError(f"{path}: unknown settings {', '.join(unknown)}; written by a newer warpgarment?")
    missing = sorted(fields.keys() - settings.keys())
    if missing:
        raise CheckpointError(f"{path}: settings {', '.join(missing)} are missing")
    for name, value in settings.items():
        kind = type(fields[name].default)
        fits = isinstance(value, (int, float)) if kind is float else isinstance(value, kind)
        if not fits or (isinstance(value, bool) and kind is not bool):
            raise CheckpointError(f"{path}: setting {name} must be {kind.__name__}, got {value!r}")
    try:
        return NetworkConfig(**settings)
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from error
