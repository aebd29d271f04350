"""NumPy archives, never with pickled objects in them."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError

from .atomic import atomic_file


def read_npz(path: Path, required: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """All arrays of an archive.

    Args:
        path: The file.
        required: Names that must be there.

    Raises:
        MeshError: Not an archive, cut short, holding pickled objects, or without a required array.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise MeshError(f"{path} is a single array, not an .npz archive.")
            data = {key: archive[key] for key in archive.files}
    except FileNotFoundError:
        raise
    except MeshError:
        raise
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, TypeError, AttributeError):
        raise MeshError(
            f"{path}: not a readable .npz archive of plain arrays. It is damaged, cut short, or of another kind."
        ) from None
    missing = [key for key in required if key not in data]
    if missing:
        raise MeshError(
            f"{path}: no array named {missing[0]!r}; the file holds {', '.join(sorted(data)) or 'nothing'}."
        )
    return data


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays uncompressed, completely or not at all. Object arrays are refused with TypeError."""
    for key, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise TypeError(f"{key} is an object array, which would need pickle")
    named: dict[str, Any] = dict(arrays)  # Any: NumPy's stub would have each of them fit `allow_pickle` too
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **named)
