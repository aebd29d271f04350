"""Materials of OBJ files (.mtl): name, base colour, opacity, and the name of a picture. Pictures are never opened."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path, PurePosixPath, PureWindowsPath

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import below, open_plain

from .record import Material, Surface, clean_name, unique_names

LARGEST, MOST = 16 << 20, 16  # bytes of a library, and how many a file may have
OURS = "# materials of a warpgarment output"  # first line; a file that lacks it is somebody's, and stays
OPTIONS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}  # numbers after options of a picture; after others comes one word


def read_libraries(path: Path, names: Iterable[str]) -> dict[str, Material]:
    """Materials of the libraries that an OBJ file names, by name.

    Libraries that are not there, lie outside of the folder, or are no text say nothing.

    Args:
        path: The OBJ file.
        names: The rests of its `mtllib` lines: names of files, with spaces in them or between them.
    """
    found: dict[str, Material] = {}
    for line in list(dict.fromkeys(names))[:MOST]:
        for name in dict.fromkeys([line, *line.split()[:MOST]]):
            try:
                library = below(path.parent, name.replace("\\", "/"), "mtllib")
                if library.is_file():
                    with open_plain(library, LARGEST) as file:
                        found = _materials(library, file.read().decode("utf-8-sig", "replace")) | found
                    break
            except (MeshError, OSError, ValueError, IndexError):
                continue
    return found


def _materials(path: Path, text: str) -> dict[str, Material]:
    found: dict[str, Material] = {}
    current = None
    for line in text.splitlines():
        words = line.split("#", 1)[0].split(None, 1)
        if len(words) < 2:
            continue
        key, rest = words[0].lower(), words[1].strip()
        try:
            if key == "newmtl":
                current = Material(clean_name(rest))
            elif current is None:
                continue
            elif key == "kd":
                r, g, b = map(float, rest.split()[:3])
                current = current._replace(color=(r, g, b))
            elif key in ("d", "tr"):
                value = float(rest.split()[-1])
                current = current._replace(opacity=value if key == "d" else 1.0 - value)
            elif key == "map_kd":
                current = current._replace(texture=placed(path.parent, _picture(rest)))
        except ValueError:
            continue  # a line of another kind: `Kd spectral file`, or a damaged one
        found[current.name] = current
    return found


def _picture(rest: str) -> str:
    """The file's name, after options such as `-s 1 1 1`."""
    words = rest.split(" ")
    while words and words[0].startswith("-") and len(words) > 1:
        words = words[1 + OPTIONS.get(words[0], 1) :]
    return " ".join(words).strip()


def placed(folder: Path, name: str) -> str:
    """A picture's file as an absolute path where there is one beside the file that names it, otherwise the name."""
    if not name or "://" in name or PureWindowsPath(name).drive or PurePosixPath(name).is_absolute() or "\0" in name:
        return name
    try:
        path = folder.resolve() / name.replace("\\", "/")
        return os.path.normpath(path) if len(name) < 1000 and path.is_file() else name
    except (OSError, ValueError):
        return name


def named_from(folder: Path, texture: str) -> str:
    """A picture's file as a file in a folder names it: relative where it lies on the same disk, with slashes."""
    if not os.path.isabs(texture):
        return texture
    try:
        return Path(os.path.relpath(texture, folder.resolve())).as_posix()
    except ValueError:  # another drive
        return texture


def material_names(surface: Surface) -> list[str]:
    """Names of the materials, which differ."""
    return unique_names([material.name for material in surface.materials])


def mtl_text(surface: Surface, folder: Path) -> str:
    """A library of the materials.

    Args:
        surface: The surface.
        folder: Where the library will lie.
    """
    lines = [OURS]
    for name, material in zip(material_names(surface), surface.materials, strict=True):
        lines += ["", f"newmtl {name}"]
        if material.color is not None:
            lines.append("Kd {:.6g} {:.6g} {:.6g}".format(*material.color))
        if material.opacity is not None:
            lines.append(f"d {material.opacity:.6g}")
        if material.texture:
            lines.append(f"map_Kd {named_from(folder, material.texture)}")
    return "\n".join(lines) + "\n"


def library_beside(path: Path) -> Path:
    """Where the library of an OBJ file goes: its name with .mtl, unless somebody else's file has that name."""
    for number in range(1000):
        library = path.with_name(f"{path.stem}{f'_{number}' if number else ''}.mtl")
        if not library.exists():
            return library
        try:
            with open_plain(library) as file:
                if file.readline(len(OURS) + 2).decode("utf-8", "replace").strip() == OURS:
                    return library
        except (MeshError, OSError):
            continue
    raise MeshError(f"{path}: there are a thousand .mtl files of this name beside it. Choose another name.")
