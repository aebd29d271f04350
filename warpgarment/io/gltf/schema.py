"""What the entries of a glTF document must be, as far as they are read: checked once, before anything comes of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
LARGEST = 1 << 53  # of a count, place or number

Check = Callable[[str, Any], None]


class Damaged(ValueError):
    """A document that is not glTF, or does not fit itself; `read_gltf` makes an error of it that names the file."""


def _kind(what: str, fits: Callable[[Any], bool]) -> Check:
    def check(where: str, value: Any) -> None:
        if not fits(value):
            raise Damaged(f"{where} is {repr(value)[:40]}, not {what}")

    return check


def _is_number(value: Any) -> bool:
    plain = isinstance(value, (int, float)) and not isinstance(value, bool)
    return plain and -LARGEST <= value <= LARGEST and math.isfinite(value)


def _is_whole(value: Any) -> bool:
    return _is_number(value) and value >= 0 and value == int(value)


def _each(one: Check, length: int | None = None) -> Check:
    """A list, each entry of which passes a check."""

    def check(where: str, value: Any) -> None:
        if not isinstance(value, list) or (length is not None and len(value) != length):
            raise Damaged(f"{where} is no list" + ("" if length is None else f" of {length}"))
        for k, entry in enumerate(value):
            one(f"{where}[{k}]", entry)

    return check


def _values(one: Check) -> Check:
    """An object, each value of which passes a check."""

    def check(where: str, value: Any) -> None:
        if not isinstance(value, dict):
            raise Damaged(f"{where} is no object")
        for key, entry in value.items():
            one(f"{where}.{key[:40]}", entry)

    return check


def _object(needed: Mapping[str, Check], optional: Mapping[str, Check]) -> Check:
    """An object with entries that must be there, and others that may be; what is not named is not looked at."""

    def check(where: str, value: Any) -> None:
        if not isinstance(value, dict):
            raise Damaged(f"{where} is no object")
        for key in needed:
            if key not in value:
                raise Damaged(f"{where} has no {key}")
        for key, one in {**needed, **optional}.items():
            if key in value:
                one(f"{where}.{key}", value[key])

    return check


INDEX = _kind("the number of an entry", lambda v: isinstance(v, int) and _is_whole(v))
COUNT = _kind("a count", _is_whole)
NUMBER = _kind("a number", _is_number)
TEXT = _kind("a text", lambda v: isinstance(v, str))
YES = _kind("true or false", lambda v: isinstance(v, bool))
COMPONENT = _kind("a type of numbers", lambda v: isinstance(v, int) and v in KINDS)
WIDTH = _kind("a shape", lambda v: isinstance(v, str) and v in WIDTHS)

_PRIMITIVE = _object(
    {"attributes": _values(INDEX)}, {"indices": INDEX, "mode": INDEX, "targets": _each(_values(INDEX))}
)
_SPARSE = _object(
    {
        "count": COUNT,
        "indices": _object({"bufferView": INDEX, "componentType": COMPONENT}, {"byteOffset": COUNT}),
        "values": _object({"bufferView": INDEX}, {"byteOffset": COUNT}),
    },
    {},
)
_NODE = {
    "children": _each(INDEX), "mesh": INDEX, "skin": INDEX, "weights": _each(NUMBER), "matrix": _each(NUMBER, 16),
    "translation": _each(NUMBER, 3), "rotation": _each(NUMBER, 4), "scale": _each(NUMBER, 3),
}  # fmt: skip
DOCUMENT = _object(
    {"asset": _object({"version": TEXT}, {})},
    {
        "extensionsRequired": _each(TEXT),
        "scene": INDEX,
        "scenes": _each(_object({}, {"nodes": _each(INDEX)})),
        "nodes": _each(_object({}, _NODE)),
        "meshes": _each(_object({"primitives": _each(_PRIMITIVE)}, {"weights": _each(NUMBER)})),
        "skins": _each(_object({"joints": _each(INDEX)}, {"inverseBindMatrices": INDEX})),
        "accessors": _each(
            _object(
                {"componentType": COMPONENT, "type": WIDTH},
                {"count": COUNT, "bufferView": INDEX, "byteOffset": COUNT, "normalized": YES, "sparse": _SPARSE},
            )
        ),
        "bufferViews": _each(
            _object({"buffer": INDEX, "byteLength": COUNT}, {"byteOffset": COUNT, "byteStride": COUNT})
        ),
        "buffers": _each(_object({"byteLength": COUNT}, {"uri": TEXT})),
    },
)
ANIMATION = _object(
    {
        "channels": _each(_object({"sampler": INDEX, "target": _object({"path": TEXT}, {"node": INDEX})}, {})),
        "samplers": _each(_object({"input": INDEX, "output": INDEX}, {"interpolation": TEXT})),
    },
    {},
)
