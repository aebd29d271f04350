"""The errors a user can cause and act on."""

from __future__ import annotations


class MeshError(ValueError):
    """Bad geometry: names the element, how many there are, and what to do."""


class CheckpointError(ValueError):
    """A checkpoint that cannot be read, is damaged, or belongs to another version."""


class NotEnoughMemory(MemoryError):
    """A batch that would not fit in memory: names the parts, their sizes, the memory, and the setting that helps."""


class MissingExtra(ImportError):
    """An optional package is not installed.

    Args:
        extra: Name of this package's extra that installs it, such as ``usd``.
        purpose: Feature that needs it, as the subject of a sentence.
    """

    def __init__(self, extra: str, purpose: str = "This"):
        self.extra = extra
        super().__init__(f'{purpose} needs an optional package: pip install "warpgarment[{extra}]"')


class DressingError(ValueError):
    """A garment that cannot be put on a body: says why, in figures, and what to do."""


class UsageError(ValueError):
    """Options that parse but do not fit each other or the files they name."""


class OutputError(OSError):
    """An output that cannot be written: the disk is full or read-only, the name is not possible, an encoder failed."""
