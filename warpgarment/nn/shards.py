"""The files of a checkpoint: one safetensors file, or a folder of several with an index, as on the Hugging Face Hub.

    base/model-00001-of-00002.safetensors      tensors, and the metadata of the whole checkpoint
    base/model-00002-of-00002.safetensors      the others, and the same metadata
    base/model.safetensors.index.json          {"metadata": {"total_size": bytes}, "weight_map": {tensor: file}}

The metadata of each shard also hold `shard` ("1 of 2") and `digest`, the SHA-256 of all tensors of all shards, by which
shards of different checkpoints differ even if everything else about them agrees.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise

from warpgarment.errors import CheckpointError, MeshError
from warpgarment.io.disk.atomic import atomic_folder
from warpgarment.io.disk.plain import JSON_LARGEST, check_plain, read_plain

from .bounds import checked_json

SINGLE = "model.safetensors"  # name of the file if one is enough; there is no index then
INDEX = "model.safetensors.index.json"
_SHARD = re.compile(r"model-\d{5}-of-\d{5}\.safetensors")
_FILE = re.compile(r"\w[\w.-]*\.safetensors", re.ASCII)  # a name in the folder itself, no path
_AGAIN = "get the checkpoint again"


@dataclass(frozen=True)
class Contents:
    """Contents of the headers of a checkpoint's files.

    Attributes:
        path: The file or folder.
        metadata: Metadata that all shards share.
        shapes: Shape of each tensor, by name.
        files: File that holds each tensor, by name.
        total_size: Bytes of all tensors according to the index; None for a single file.
    """

    path: Path
    metadata: Mapping[str, str]
    shapes: Mapping[str, tuple[int, ...]]
    files: Mapping[str, Path]
    total_size: int | None = None

    def tensors(self) -> dict[str, torch.Tensor]:
        """Reads all tensors, on the CPU, as they are stored.

        Raises:
            CheckpointError: A file is damaged, or the shards hold tensors that were not saved together.
        """
        tensors: dict[str, torch.Tensor] = {}
        for path in sorted(set(self.files.values())):
            try:
                with safe_open(path, framework="pt", device="cpu") as file:
                    tensors |= {name: file.get_tensor(name) for name, there in self.files.items() if there == path}
            except (SafetensorError, OSError) as error:
                raise CheckpointError(f"{path}: cannot be read ({error}); the file is damaged, get it again") from error
        if self.total_size is not None:
            size = sum(tensor.nbytes for tensor in tensors.values())
            if size != self.total_size:
                raise CheckpointError(
                    f"{self.path}: {INDEX} gives {self.total_size:,} bytes, its shards hold {size:,}; {_AGAIN}"
                )
            if _digest(tensors) != self.metadata.get("digest"):
                raise CheckpointError(
                    f"{self.path}: its shards do not hold the tensors that were saved together (digest); {_AGAIN}"
                )
        return tensors


def write(
    folder: Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, str], max_shard_bytes: int
) -> list[Path]:
    """Writes tensors to a folder, which appears whole or not at all and replaces an older checkpoint of its name.

    Args:
        folder: Folder to write; it may exist if it holds nothing but a checkpoint.
        tensors: Contiguous tensors on the CPU, by name.
        metadata: Metadata of the checkpoint, which every shard repeats.
        max_shard_bytes: Largest size of a file with its header [bytes]. If one file is enough, it is model.safetensors.

    Returns:
        The files, the index last.

    Raises:
        ValueError: A tensor is larger than a shard may be.
        FileExistsError: The folder holds something else.
    """
    whole = {**metadata, "digest": _digest(tensors)}
    shards = _split(tensors, max_shard_bytes, 128 + len(json.dumps(whole)))
    names = [SINGLE]
    if len(shards) > 1:
        names = [f"model-{k:05d}-of-{len(shards):05d}.safetensors" for k in range(1, len(shards) + 1)]
    with atomic_folder(folder, "model*.safetensors*") as partial:
        for number, (name, members) in enumerate(zip(names, shards, strict=True), 1):
            about = {**whole, "shard": f"{number} of {len(shards)}"} if len(shards) > 1 else dict(metadata)
            (partial / name).write_bytes(serialise({key: tensors[key] for key in members}, metadata=about))
        if len(shards) > 1:
            where = {key: name for name, members in zip(names, shards, strict=True) for key in members}
            total = sum(tensor.nbytes for tensor in tensors.values())
            index = {"metadata": {"total_size": total}, "weight_map": dict(sorted(where.items()))}
            (partial / INDEX).write_text(json.dumps(index, indent=2) + "\n", "utf-8")
            names.append(INDEX)
    return [Path(folder) / name for name in names]


def locate(path: str | os.PathLike[str]) -> Path:
    """Finds the checkpoint at a path.

    Args:
        path: A file, a folder with an index, or a folder that holds one file. Of several files, best.safetensors is
            taken, which training writes.

    Returns:
        The file, or the folder with an index.

    Raises:
        CheckpointError: There is none, or several; the message says what there is.
    """
    path = Path(path)
    if path.is_file():
        return path
    if not path.is_dir():
        raise CheckpointError(f"{path}: no such file or folder")
    if (path / INDEX).is_file():
        return path
    files = sorted(file for file in path.glob("*.safetensors") if not file.name.startswith("."))
    if files and all(_SHARD.fullmatch(file.name) for file in files):
        raise CheckpointError(f"{path}: {INDEX}, which says what its {len(files)} shards hold, is missing; {_AGAIN}")
    files = [file for file in files if file.name == "best.safetensors"] or files
    if len(files) != 1:
        names = ", ".join(file.name for file in files) or "none"
        raise CheckpointError(
            f"{path}: a folder must hold one .safetensors file, or shards and {INDEX}, found {names}; name the file"
        )
    return files[0]


def contents(path: str | os.PathLike[str]) -> Contents:
    """Reads the headers of a checkpoint's files and checks that they belong together.

    Raises:
        CheckpointError: There is no checkpoint; a file is missing, cut short, of another format or of another
            checkpoint; or the index is damaged, does not fit the shards, or names files outside the folder.
    """
    path = locate(path)
    if path.is_dir():
        return _sharded(path)
    metadata, shapes = _header(path)
    if "shard" in metadata:
        raise CheckpointError(f"{path}: is shard {metadata['shard']} of a checkpoint; name its folder instead")
    return Contents(path, metadata, shapes, dict.fromkeys(shapes, path))


def _sharded(folder: Path) -> Contents:
    weight_map, total_size = _read_index(folder)
    files = sorted(set(weight_map.values()))
    missing = [name for name in files if not (folder / name).is_file()]
    if missing:
        raise CheckpointError(f"{folder}: {len(missing)} of {len(files)} shards are missing (first: {missing[0]})")
    common: dict[str, str] = {}
    shapes: dict[str, tuple[int, ...]] = {}
    holder: dict[str, str] = {}
    for name in files:
        metadata, found = _header(folder / name)
        metadata.pop("shard", None)
        common = common or metadata
        different = sorted(key for key in {*common, *metadata} if common.get(key) != metadata.get(key))
        if different:
            raise CheckpointError(
                f"{folder}: {name} belongs to another checkpoint than {files[0]} (its {', '.join(different)} differ); "
                f"{_AGAIN}"
            )
        for tensor, shape in found.items():
            if tensor in holder:
                raise CheckpointError(f"{folder}: {tensor} is in two shards, {holder[tensor]} and {name}; {_AGAIN}")
            if weight_map.get(tensor) != name:
                told = f"says it is in {weight_map[tensor]}" if tensor in weight_map else "does not list it"
                raise CheckpointError(f"{folder}: {name} holds {tensor}, {INDEX} {told}; {_AGAIN}")
            holder[tensor], shapes[tensor] = name, shape
    absent = sorted(weight_map.keys() - holder.keys())
    if absent:
        raise CheckpointError(
            f"{folder}: {len(absent)} tensors of {INDEX} are not in their shards (first: {absent[0]}); {_AGAIN}"
        )
    return Contents(folder, common, shapes, {t: folder / name for t, name in holder.items()}, total_size)


def _read_index(folder: Path) -> tuple[dict[str, str], int]:
    """Name of the file that holds each tensor, and the size of all tensors [bytes]."""
    path = folder / INDEX
    try:
        text = read_plain(path, JSON_LARGEST).decode("utf-8")
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: is not JSON ({error}); {_AGAIN}") from error
    index = checked_json(path, "the index", text)
    weight_map, about = index.get("weight_map"), index.get("metadata")
    total = about.get("total_size") if isinstance(about, dict) else None
    if not isinstance(weight_map, dict) or not weight_map or type(total) is not int:
        raise CheckpointError(f"{path}: weight_map or metadata.total_size is missing; {_AGAIN}")
    for tensor, name in weight_map.items():
        if not isinstance(name, str) or not _FILE.fullmatch(name):
            raise CheckpointError(
                f"{path}: says {tensor} is in {name!r}, which is no .safetensors file of this folder; do not use it"
            )
    return weight_map, total


def _header(path: Path) -> tuple[dict[str, str], dict[str, tuple[int, ...]]]:
    """Metadata and shapes of one file."""
    try:
        check_plain(path)
        with safe_open(path, framework="pt", device="cpu") as file:
            return dict(file.metadata() or {}), {k: tuple(file.get_slice(k).get_shape()) for k in file.keys()}
    except (SafetensorError, OSError, MeshError) as error:
        raise CheckpointError(
            f"{path}: not a safetensors file, or one cut short ({error}); get it again or check the path"
        ) from error


def _split(tensors: Mapping[str, torch.Tensor], limit: int, overhead: int) -> list[list[str]]:
    """Divides tensors, in their order, among files: a new file begins when the next tensor does not fit."""
    shards: list[list[str]] = [[]]
    filled = overhead
    for name, tensor in tensors.items():
        size = tensor.nbytes + len(name) + 128 + 8 * tensor.dim()  # with an upper bound of its entry in the header
        if overhead + size > limit:
            raise ValueError(f"max_shard_bytes is {limit:,}, too little for {name} alone, {overhead + size:,} bytes")
        if filled + size > limit:
            shards.append([])
            filled = overhead
        shards[-1].append(name)
        filled += size
    return shards


def _digest(tensors: Mapping[str, torch.Tensor]) -> str:
    """SHA-256 of names, types, shapes and bytes; it does not depend on the order of the tensors."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        total.update(f"{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
        total.update(tensor.contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return total.hexdigest()
