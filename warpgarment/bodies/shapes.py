"""Which body a motion of bones moves: the one in the package, Anny's, one in a file, or a model of SMPL's family."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

from warpgarment.errors import MeshError, UsageError
from warpgarment.io.npz import read_npz

from .rest import PHENOTYPES, RestBody, bundled_body
from .smpl import KEYS, SmplModel

Shape: TypeAlias = RestBody | SmplModel

KNOWN = "bundled, anny, anny with values (anny,height=0.7,weight=0.3), or an .npz of SMPL, SMPL-H or SMPL-X"


def shape_of(shape: str | os.PathLike[str] | Shape | None) -> Shape:
    """The body of a name or a file.

    Args:
        shape: "bundled" or None, the body in the package; "anny", with values between 0 and 1 behind commas (gender,
            age, muscle, weight, height, proportions); an .npz of SMPL's family, or one that `RestBody.save` wrote; or
            a body, which is returned.

    Raises:
        UsageError: There is no such body.
        MissingExtra: Anny is not installed (extra ``bodies``).
        MeshError: The file holds something else.
        FileNotFoundError: There is no such file.
    """
    if isinstance(shape, (RestBody, SmplModel)):
        return shape
    name = "bundled" if shape is None else os.fspath(shape)
    kind, _, values = name.partition(",")
    if kind == "bundled" and not values:
        return bundled_body()
    if kind == "anny":
        return _anny(name, values)
    suffix = Path(name).suffix.lower()
    if suffix == ".pkl":
        raise UsageError(f"body {name}: pickled files run code when they are read, and are not. Save it as .npz.")
    if suffix != ".npz":
        raise UsageError(f"body {name!r} is not known; there are {KNOWN}.")
    status = os.stat(name)
    return _from_file(os.path.realpath(name), status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _anny(name: str, values: str) -> RestBody:
    phenotype = {}
    for part in filter(None, values.split(",")):
        key, _, value = (word.strip() for word in part.partition("="))
        try:
            number = float(value)
        except ValueError:
            number = -1.0
        if key not in PHENOTYPES or not 0.0 <= number <= 1.0:
            raise UsageError(
                f"body {name!r}: {part!r} is no value of Anny's. They are {', '.join(PHENOTYPES)}, from 0 to 1: "
                "height=0.7."
            )
        phenotype[key] = number
    from .anny import anny_bodies

    return anny_bodies().rest(**phenotype)


@lru_cache(maxsize=2)
def _from_file(path: str, changed: int, size: int) -> Shape:
    names = read_npz(Path(path), (), lambda key: key in ("vertices", "v_template"))
    if "v_template" in names:
        return SmplModel.load(path)
    if "vertices" in names:
        return RestBody.load(path)
    raise MeshError(
        f"{path} is no body: it has neither {', '.join(KEYS)} (SMPL's family) nor what RestBody.save writes."
    )
