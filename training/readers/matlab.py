"""MATLAB 5 files as plain dictionaries."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import check_plain

LARGEST = 1 << 30  # largest file [bytes]; an info.mat has some hundred thousand


def read_mat(path: str | Path, names: Sequence[str], required: Sequence[str] = ()) -> dict[str, Any]:
    """Variables of a MATLAB 5 file by name; structs become dictionaries, single elements scalars.

    SciPy's reader supports numbers, text and structs only: nothing in such a file is executed.

    Args:
        path: File to read.
        names: Names of the variables to read, if the file has them.
        required: Names of the variables that the file must have.

    Raises:
        MeshError: The file is of another kind, damaged, too large, or lacks a required variable.
        FileNotFoundError: There is no such file.
    """
    from scipy.io import loadmat, whosmat

    path = Path(path)
    check_plain(path, LARGEST)
    try:
        present = [name for name, _, _ in whosmat(str(path), appendmat=False)]
        data = loadmat(str(path), simplify_cells=True, variable_names=list(names), appendmat=False)
    except FileNotFoundError:
        raise
    except Exception as error:  # SciPy's reader raises errors of many classes
        raise MeshError(
            f"{path}: not a readable MATLAB 5 file ({type(error).__name__}: {error}). "
            "It is damaged, cut short, or of another version; MATLAB 7.3 files must be saved again as version 7."
        ) from None
    missing = [name for name in required if name not in data]
    if missing:
        raise MeshError(f"{path}: no variable named {missing[0]!r}; the file holds {', '.join(present) or 'nothing'}.")
    return {name: data[name] for name in names if name in data}
