"""The facts about a data set on which its page is based."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpgarment.errors import MeshError

from .sequence import MANIFEST, list_sequences, read_manifest
from .set_manifest import read_set_manifest

Values = dict[str, dict[str, list[float]]]  # quantity -> split -> one value per sequence or garment


@dataclass(frozen=True)
class Facts:
    """Manifests of a data set: `common` of the set, `good` by folder, and those of `rejected` sequences."""

    root: Path
    common: dict[str, Any]
    good: dict[Path, dict[str, Any]]
    rejected: list[dict[str, Any]]

    @classmethod
    def of(cls, root: Path) -> Facts:
        """Reads the manifests of a set.

        Raises:
            MeshError: One of them is damaged, or a good sequence has no frames or rate.
        """
        manifests = {folder: read_manifest(folder) for folder in list_sequences(root, status=None)}
        good = {folder: m for folder, m in manifests.items() if m.get("status") == "good"}
        for folder, manifest in good.items():
            absent = [key for key in ("frames", "fps") if not manifest.get(key)]
            if absent:
                raise MeshError(f"{folder / MANIFEST} does not say {absent[0]}. See `warpgarment dataset verify`.")
        rejected = [m for m in manifests.values() if m.get("status") == "rejected"]
        rejected += [attempt for m in manifests.values() for attempt in m.get("rejected_attempts", [])]
        return cls(root, read_set_manifest(root) or {}, good, rejected)
