"""The tree of an Ogawa file, looked at before Alembic's library is, which trusts what is inside.

Header: "Ogawa", 0xff, version, and the place of the first group. A group is the number of its children (uint64) and
their places; with the top bit set, a child is data: its length (uint64) and its bytes. Place 0 is an empty one. A group
is written after its children, and so lies behind them.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import open_plain

DATA = 1 << 63
HEADER = 16  # bytes before the first group or data


def check_structure(path: Path) -> None:
    """Refuses a file in which a group or data lies outside the file, or a group before its children.

    Raises:
        MeshError: There is one.
    """
    with open_plain(path) as file:
        size = os.fstat(file.fileno()).st_size

        def word(place: int) -> int:
            file.seek(place)
            return int(struct.unpack("<Q", file.read(8))[0])

        def bad(place: int) -> MeshError:
            return MeshError(
                f"{path}: what should be at byte {place:,} of {size:,} is not. It is damaged or cut short."
            )

        if size < HEADER:
            raise bad(size)
        seen: set[int] = set()
        waiting = [word(8)]
        while waiting:
            place = waiting.pop()
            if place in seen or not place & ~DATA:
                continue
            seen.add(place)
            start = place & ~DATA
            if start < HEADER or start + 8 > size:
                raise bad(start)
            count = word(start)
            if count > (size - start - 8) // (1 if place & DATA else 8):
                raise bad(start)
            if not place & DATA:
                children = file.read(8 * count)
                if len(children) < 8 * count:
                    raise bad(start)
                for child in struct.unpack(f"<{count}Q", children):
                    if child & ~DATA >= start:
                        raise bad(start)
                    waiting.append(child)
