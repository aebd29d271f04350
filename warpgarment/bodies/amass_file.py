"""AMASS motions as moving bodies: .npz files of joint angles.

Every .npz is asked whether it is one, so what reads the angles is loaded for those alone.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from warpgarment.io.data import Format, MotionData, ReadOptions
from warpgarment.io.disk.plain import open_plain


def is_amass(path: str | Path) -> bool:
    """Whether an .npz holds joint angles, and no positions; False for a file that is no archive."""
    try:
        with open_plain(Path(path)) as file, zipfile.ZipFile(file) as archive:
            names = set(archive.namelist())
    except (OSError, ValueError, EOFError, RuntimeError, NotImplementedError, zipfile.BadZipFile):
        return False
    return {"poses.npy", "trans.npy"} <= names and "vertices.npy" not in names


def _read(path: Path, options: ReadOptions) -> MotionData:
    from .moved import from_amass

    return from_amass(path, options)


FORMAT = Format(read_motion=_read, axis=True, bones=True, recognised=is_amass)
