"""PC16 point caches of CLOTH3D: a PC2 file whose positions are 16-bit floats.

char[12] "POINTCACHE2\\0" | int32 version = 1 | int32 points | float32 start frame | float32 frames per sample | int32
samples, little-endian; then float16 positions frame after frame. At one metre from the origin a 16-bit float is exact
to half a millimetre.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import open_plain
from warpgarment.io.pc2 import HEADER, SIGNATURE


def read_pc16(path: str | Path) -> np.ndarray:
    """Positions of a PC16 file in its own unit, float32, shape [T, V, 3]. Start and rate of the header are not used.

    Raises:
        MeshError: The signature or version is another, or the number of bytes is not that of the header.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    size = path.stat().st_size
    with open_plain(path) as file:
        head = file.read(HEADER.size)
    if len(head) < HEADER.size or not head.startswith(SIGNATURE[:11]):
        raise MeshError(f"{path}: does not start with POINTCACHE2; this is not a PC16 file, or it is cut short.")
    _, version, points, _, _, samples = HEADER.unpack(head)
    if version != 1 or points < 1 or samples < 1:
        raise MeshError(
            f"{path}: version {version} with {points:,} points and {samples:,} samples; only version 1 is known."
        )
    expected = HEADER.size + 6 * points * samples
    if size == HEADER.size + 12 * points * samples:
        raise MeshError(f"{path}: its numbers are 32-bit floats. It is a PC2 file: name it {path.stem}.pc2.")
    if size != expected:
        raise MeshError(
            f"{path}: {size:,} bytes where {samples:,} samples of {points:,} points need {expected:,}. "
            "The file is damaged or cut short: copy it again."
        )
    data = np.memmap(path, dtype="<f2", mode="r", offset=HEADER.size, shape=(samples, points, 3))
    return data.astype(np.float32)
