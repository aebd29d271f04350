"""Detection of a file's or folder's format from its contents, and one function that reads all formats."""

from __future__ import annotations

import mmap
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import open_plain, read_json
from warpgarment.io.pc2 import HEADER, SIGNATURE

from . import cloth3d, dlayers
from .cloth3d import read_cloth3d
from .dlayers import read_dlayers
from .files import recording
from .recording import Recording
from .vto import read_vto

READERS: dict[str, Callable[..., Recording]] = {
    "cloth3d": read_cloth3d,
    "vto": read_vto,
    "dlayers": read_dlayers,
    "pc2": recording,
    "obj": recording,
    "usd": recording,
    "npz": recording,
}
FORMATS = (*READERS, "amass")


def read_recording(path: str | Path, format: str | None = None, **options: Any) -> Recording:
    """Reads a sample of a public data set, or an animation of one garment.

    Args:
        path: File or folder to read.
        format: Format, one of `READERS`; None for the result of :func:`detect`.
        options: Options of the format's reader; all readers take `body` and `clean`.

    Raises:
        MeshError: The format is not known or holds no garment, or the files are damaged or do not fit each other.
        FileNotFoundError: There is no such file.
        TypeError: The format's reader does not have one of the options.
    """
    kind = format or detect(path)
    if kind == "amass":
        raise MeshError(
            f"{path} is an AMASS motion: it moves a body and has no garment. Read it with "
            "warpgarment.bodies.amass.read_amass, or give its folder to `warpgarment generate --motions`."
        )
    if kind not in READERS:
        raise MeshError(f"the format {kind!r} is not known; there are {', '.join(READERS)}.")
    return READERS[kind](path, **options)


def detect(path: str | Path) -> str:
    """The format of a file or folder, one of `FORMATS`. Nothing is executed, and only a small part is read.

    Raises:
        MeshError: The format is none of the known ones; the message lists them.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"No such file: {path}")
    kind = _folder(path) if path.is_dir() else _file(path)
    if kind is None:
        raise MeshError(
            f"{path}: not recognised. Known are the folder of a CLOTH3D sample ({cloth3d.INFO} and .pc16) or of a "
            f"D-LAYERS sample ({dlayers.META} and .pkl), a VTO sequence (.pkl), a folder of .obj, .pc2, USD, .npz, and "
            "AMASS motions (.npz)."
        )
    return kind


def _folder(path: Path) -> str | None:
    if (path / cloth3d.INFO).is_file():
        return "cloth3d"
    if (path / dlayers.META).is_file():
        try:
            meta = read_json(path / dlayers.META)
        except MeshError:
            return "dlayers"  # its reader reports the fault
        parts = [meta, meta.get("simulate")] if isinstance(meta, dict) else []
        return "dlayers" if any(isinstance(part, dict) and "garment" in part for part in parts) else None
    return "obj" if next(path.glob("*.obj"), None) else None


def _file(path: Path) -> str | None:
    with open_plain(path) as file:
        head = file.read(HEADER.size)
    if head.startswith(SIGNATURE[:11]):
        return _point_cache(path, head)
    if head.startswith((b"PXR-USDC", b"#usda")):
        return "usd"
    if head.startswith(b"MATLAB 5.0 MAT-file"):
        raise MeshError(f"{path} describes a CLOTH3D sample. Give the folder it lies in.")
    if head.startswith(b"PK\x03\x04"):
        return _archive(path)
    if head[:1] == b"\x80" or head[:1] in (b"(", b"}"):
        return _pickle(path)
    return None


def _point_cache(path: Path, head: bytes) -> str:
    points, samples = (HEADER.unpack(head)[i] for i in (2, 5)) if len(head) == HEADER.size else (0, 0)
    if path.stat().st_size == HEADER.size + 6 * points * samples and points * samples > 0:
        raise MeshError(f"{path} is a PC16 cache of a CLOTH3D sample. Give the folder it lies in.")
    return "pc2"


def _archive(path: Path) -> str | None:
    try:
        with zipfile.ZipFile(path) as archive:
            names = {Path(name).stem for name in archive.namelist() if name.endswith(".npy")}
            stage = any(name.lower().endswith((".usd", ".usda", ".usdc")) for name in archive.namelist()[:1])
    except (zipfile.BadZipFile, OSError):
        return "npz" if path.suffix.lower() == ".npz" else None  # the reader of .npz reports the fault
    if stage:
        return "usd"
    if {"poses", "trans"} <= names and "vertices" not in names:
        return "amass"
    if {"vertices", "faces", "pose", "translation"} <= names:
        return "vto"
    return "npz" if "faces" in names else None


def _pickle(path: Path) -> str | None:
    """The format of a pickle, from the words in the file; it is not read as a pickle here."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data.find(b"tpose") >= 0 and data.find(b"vertices") >= 0:
            raise MeshError(f"{path} is a garment of a D-LAYERS sample. Give the folder it lies in.")
        return "vto" if data.find(b"vertices") >= 0 and data.find(b"faces") >= 0 else None
