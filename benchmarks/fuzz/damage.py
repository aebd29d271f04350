"""Damage that is done to the bytes and to the text of files, whatever they hold.

Every function takes the bytes of a file and a source of random numbers, and returns other bytes; None where it has no
hold on them. Those of `HARMLESS` change nothing of what a file says.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from random import Random

Damage = Callable[[bytes, Random], "bytes | None"]

NUMBERS = (
    "nan", "inf", "-inf", "1e39", "-1e39", "1e400", "1e30", "0", "-1", "-2147483649", "2147483647", "4294967295",
    "999999999999999999999999", "9" * 400, "0x10", "1,5", "", "null", "true", '"x"', "[]", "1e", "--1", "٣", "½", "1_0",
)  # fmt: skip
_WORD = re.compile(rb"(?<![\w.])-?\d+(\.\d+)?([eE][-+]?\d+)?")
_SHAPES = ("<f", "<d", "<i", "<I", "<q", "<H", "B")
_SPECIAL: dict[str, tuple[float, ...]] = {
    "f": (float("nan"), float("inf"), -3.4e38, 1e30, 0.0, -1.0),
    "d": (float("nan"), float("-inf"), 1e308, 1e39, 0.0),
    "i": (-1, 2**31 - 1, -(2**31), 0, 1, 65536),
    "I": (2**32 - 1, 2**31, 0, 1, 2**30),
    "q": (-1, 2**63 - 1, 2**40, 0, 2**32),
    "H": (0, 1, 65535, 32768),
    "B": (0, 1, 127, 128, 255),
}


def _place(data: bytes, rng: Random) -> int:
    """A place in a file: half of the time near its beginning, where headers are. An empty one has none but 0."""
    if not data:
        return 0
    return rng.randrange(min(len(data), 256) if rng.random() < 0.5 else len(data))


def _span(data: bytes, rng: Random) -> tuple[int, int]:
    start = _place(data, rng)
    return start, min(len(data), start + rng.choice((1, 2, 4, 12, 64, 500, 5000)))


def cut(data: bytes, rng: Random) -> bytes | None:
    """The end is missing: some bytes of it, or most of the file."""
    return (
        data[: max(0, len(data) - rng.choice((1, 2, 4, 8, 100)))] if rng.random() < 0.3 else data[: _place(data, rng)]
    )


def flip(data: bytes, rng: Random) -> bytes | None:
    """Single bits are others."""
    if not data:
        return None
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        changed[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def overwrite(data: bytes, rng: Random) -> bytes | None:
    """A block is zeros, ones or noise."""
    start, end = _span(data, rng)
    filling = (bytes, lambda n: b"\xff" * n, rng.randbytes)[rng.randrange(3)]
    return data[:start] + filling(end - start) + data[end:]


def splice(data: bytes, rng: Random) -> bytes | None:
    """A block is copied to another place, over what is there or between it."""
    start, end = _span(data, rng)
    to = _place(data, rng)
    return data[:to] + data[start:end] + data[to if rng.random() < 0.5 else to + end - start :]


def remove(data: bytes, rng: Random) -> bytes | None:
    """A block is missing in the middle."""
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def append(data: bytes, rng: Random) -> bytes | None:
    """There is more at the end: noise, zeros, or the file again."""
    return data + (rng.randbytes(rng.randrange(1, 300)), bytes(rng.randrange(1, 5000)), data)[rng.randrange(3)]


def number(data: bytes, rng: Random) -> bytes | None:
    """Bytes that may be a number are another: NaN, infinite, huge or negative."""
    shape = rng.choice(_SHAPES)
    size = struct.calcsize(shape)
    if len(data) < size:
        return None
    at = min(_place(data, rng) // size * size if rng.random() < 0.7 else _place(data, rng), len(data) - size)
    return data[:at] + struct.pack(shape, rng.choice(_SPECIAL[shape[-1]])) + data[at + size :]


def nothing(data: bytes, rng: Random) -> bytes | None:
    """The file is empty, or a single byte."""
    return rng.choice((b"", data[:1], b"\n", b"\0"))


def other_number(data: bytes, rng: Random) -> bytes | None:
    """A number of a text is huge, negative, not finite, of another type, or missing."""
    found = list(_WORD.finditer(data))
    if not found:
        return None
    for match in sorted(rng.sample(found, min(len(found), rng.choice((1, 1, 1, 3)))), key=lambda m: -m.start()):
        data = data[: match.start()] + rng.choice(NUMBERS).encode() + data[match.end() :]
    return data


def _line(data: bytes, rng: Random) -> tuple[list[bytes], int]:
    lines = data.split(b"\n")
    return lines, rng.randrange(min(len(lines), 20) if rng.random() < 0.4 else len(lines))


def lines_again(data: bytes, rng: Random) -> bytes | None:
    """Lines are there twice, or a great many times."""
    lines, at = _line(data, rng)
    block = lines[at : at + rng.choice((1, 1, 5))]
    return b"\n".join([*lines[:at], *block * rng.choice((2, 2, 300)), *lines[at + len(block) :]])


def lines_apart(data: bytes, rng: Random) -> bytes | None:
    """Lines are in another order."""
    lines, at = _line(data, rng)
    other = rng.randrange(len(lines))
    lines[at], lines[other] = lines[other], lines[at]
    if rng.random() < 0.2:
        rng.shuffle(lines)
    return b"\n".join(lines)


def lines_gone(data: bytes, rng: Random) -> bytes | None:
    """Lines are missing."""
    lines, at = _line(data, rng)
    return b"\n".join(lines[:at] + lines[at + rng.choice((1, 1, 2, 10)) :])


def words(data: bytes, rng: Random) -> bytes | None:
    """Words of a line are missing, doubled, exchanged, or others."""
    lines, at = _line(data, rng)
    parts = lines[at].split(b" ")
    k = rng.randrange(len(parts))
    change = rng.randrange(4)
    if change == 0:
        del parts[k]
    elif change == 1:
        parts.insert(k, parts[k])
    elif change == 2:
        parts[k] = rng.choice((b"", b"nan", b"\xff\xfe", b"{", b'"', b"x" * 3000, b"#", b"\\", b"\r", b"-", b"1e999"))
    else:
        rng.shuffle(parts)
    lines[at] = b" ".join(parts)
    return b"\n".join(lines)


def deep(data: bytes, rng: Random) -> bytes | None:
    """Brackets within brackets, many thousands of them."""
    opening = rng.choice((b"[", b"{", b"(", b'{"a":', b"{ "))
    at = _place(data, rng)
    return data[:at] + opening * rng.choice((40, 5000, 100_000)) + data[at:]


def spaces(data: bytes, rng: Random) -> bytes | None:
    """Spaces at the ends of lines: nothing changes."""
    return b"\n".join(line + b" " * rng.randrange(3) for line in data.split(b"\n"))


def returns(data: bytes, rng: Random) -> bytes | None:
    """Lines end as on Windows: nothing changes."""
    return data.replace(b"\n", b"\r\n") if b"\r" not in data else None


BYTES: tuple[Damage, ...] = (cut, cut, flip, flip, overwrite, splice, remove, append, number, number, nothing)
COPIES: tuple[Damage, ...] = (cut, cut, append, nothing)
TEXT: tuple[Damage, ...] = (other_number, other_number, lines_again, lines_apart, lines_gone, words, words, deep)
HARMLESS: tuple[Damage, ...] = (spaces, returns)
