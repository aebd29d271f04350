"""The facts about a data set on which its page is based."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .sequence import list_sequences, read_manifest
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
        """Reads the manifests of a set."""
        manifests = {folder: read_manifest(folder) for folder in list_sequences(root, status=None)}
        good = {folder: m for folder, m in manifests.items() if m.get("status") == "good"}
        rejected = [m for m in manifests.values() if m.get("status") == "rejected"]
        rejected += [attempt for m in manifests.values() for attempt in m.get("rejected_attempts", [])]
        return cls(root, read_set_manifest(root) or {}, good, rejected)
