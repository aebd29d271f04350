"""Reads pickles of plain data and executes nothing in them.

A pickle is a program for a stack machine. Python's own machine imports the names in the file and calls them, so that a
data file can run commands. The machine here cannot, for these reasons:

- **It imports and looks up nothing.** A global in the file is a pair of words, which is compared with those of `KNOWN`;
  any other is refused, with its name and place. For a known global an inert token is put on the stack.
- **It calls nothing that the file chose.** Of the opcodes that call, instantiate or set state, OBJ, INST, NEWOBJ,
  NEWOBJ_EX, EXT, PERSID and the out-of-band buffers are refused. REDUCE and BUILD lead to functions of
  `unpickle_arrays`, selected by token, which check the type of every argument. The stack can hold None, bool, int,
  float, str, bytes, list, tuple, dict, tokens and arrays of numbers: none has a method that comes from a file.
- **Arrays hold numbers or text of fixed width.** The type is matched with a pattern before NumPy sees it. Arrays of
  Python objects, which would be pickles of their own, records and subclasses are refused.
- **It cannot run for ever or fill memory.** There are no jumps; opcodes are counted; each operand is a piece of the
  file; bytes that are decoded or become arrays count against a budget of a few times the file's size, so that naming
  one piece a thousand times gains nothing; shapes must account for every byte; integers are short; nothing here
  recurses, and keys of dictionaries are scalars, so nested containers are never walked, compared or hashed.

Opcodes are parsed by `pickletools.genops` of the standard library, which does nothing else.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import check_plain, read_plain

from .unpickle_arrays import ArrayMaker, NdarrayToken, PendingDtype, Refusal

LARGEST = 4 << 30  # largest file [bytes]
OPCODES = 5_000_000
SHARE, SPARE = 4, 1 << 20  # budget of bytes for arrays and text: multiple of the file's size, and constant part
BITS = 128  # largest length of an integer

CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
OPERANDS = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
    "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
KEYS = (str, bytes, int, float, np.generic, type(None))


class PickleRefused(MeshError):
    """A pickle that is damaged or holds something other than plain data. Nothing in it was executed."""


class Token:
    """A function that a pickle may name. It cannot be called; REDUCE compares tokens by identity."""


RECONSTRUCT, SCALAR, FROMBUFFER, DTYPE, ENCODE, NO_BYTES, ORDERED_DICT = (Token() for _ in range(7))
KNOWN: dict[tuple[str, str], Token | NdarrayToken] = {
    ("numpy", "ndarray"): NdarrayToken(),
    ("numpy", "dtype"): DTYPE,
    ("numpy.core.multiarray", "_reconstruct"): RECONSTRUCT,
    ("numpy._core.multiarray", "_reconstruct"): RECONSTRUCT,
    ("numpy.core.multiarray", "scalar"): SCALAR,
    ("numpy._core.multiarray", "scalar"): SCALAR,
    ("numpy.core.numeric", "_frombuffer"): FROMBUFFER,
    ("numpy._core.numeric", "_frombuffer"): FROMBUFFER,
    ("_codecs", "encode"): ENCODE,
    ("__builtin__", "bytes"): NO_BYTES,  # called without arguments, it is b"" of protocols below 3
    ("collections", "OrderedDict"): ORDERED_DICT,
}


def read_pickle(path: str | Path) -> Any:
    """The plain data of a pickle: dictionaries, lists, tuples, text, numbers, and NumPy arrays of numbers or text.

    Raises:
        PickleRefused: The file holds anything else (the message names it and its byte), or is damaged.
        FileNotFoundError: There is no such file.
    """
    path = Path(path)
    check_plain(path)
    size = path.stat().st_size
    if size > LARGEST:
        raise PickleRefused(f"{path}: {size:,} bytes; more than {LARGEST:,} are not read.")
    machine, position = _Machine(SHARE * size + SPARE), 0
    try:
        for count, (opcode, operand, place) in enumerate(pickletools.genops(BytesIO(read_plain(path)))):
            position = place or 0
            if count >= OPCODES:
                raise Refusal(f"more than {OPCODES:,} opcodes")
            if opcode.name == "STOP":
                return machine.result()
            machine.step(opcode.name, operand)
        raise ValueError("no end")
    except Refusal as refusal:
        raise PickleRefused(
            f"{path}: {refusal} at byte {position:,} refused. Only plain NumPy arrays, dictionaries, lists, text and "
            "numbers are read; nothing of the file was executed. If you trust it, save it as .npz where it was made."
        ) from None
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, MemoryError, SystemError) as error:
        raise PickleRefused(
            f"{path}: not a readable pickle ({type(error).__name__} after byte {position:,}: {str(error)[:200]}). "
            "It is damaged, cut short, or of another kind."
        ) from None


class _Machine:
    """The stack, the memo, and the effect of each opcode on them."""

    def __init__(self, budget: int):
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.make = ArrayMaker(budget)

    def step(self, name: str, operand: Any) -> None:
        """Carries out one opcode."""
        if name in OPERANDS:
            if isinstance(operand, int) and operand.bit_length() > BITS:
                raise Refusal(f"an integer of {operand.bit_length():,} bits")
            self.stack.append(bytes(operand) if isinstance(operand, bytearray) else operand)
        elif name in CONSTANTS:
            self.stack.append(CONSTANTS[name])
        elif name in ACTIONS:
            ACTIONS[name](self, operand)
        else:
            raise Refusal(f"the opcode {name}")

    def result(self) -> Any:
        """The one object that is left at the end."""
        if len(self.stack) != 1 or self.marks:
            raise ValueError(f"{len(self.stack)} objects are left at the end")
        return self.stack[0]

    def take(self, count: int) -> list[Any]:
        """Removes and returns the topmost objects."""
        if len(self.stack) < count:
            raise IndexError("the stack is empty")
        items = self.stack[len(self.stack) - count :]
        del self.stack[len(self.stack) - count :]
        return items

    def take_marked(self) -> list[Any]:
        """Removes and returns the objects above the last mark."""
        mark = self.marks.pop()
        return self.take(max(len(self.stack) - mark, 0))

    def push(self, item: Any) -> None:
        self.stack.append(item)

    def pop(self) -> None:
        if self.marks and self.marks[-1] == len(self.stack):
            self.marks.pop()
        else:
            self.stack.pop()

    def protocol(self, version: int) -> None:
        if version > 5:
            raise Refusal(f"pickle protocol {version}")

    def remember(self, index: int) -> None:
        self.memo[index] = self.stack[-1]

    def extend(self, items: list[Any]) -> None:
        self._top(list).extend(items)

    def set_items(self, items: list[Any]) -> None:
        target = self._top(dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, KEYS):
                raise Refusal(f"a dictionary key of type {type(key).__name__}")
            target[key] = value

    def name(self, module: Any, name: Any) -> None:
        known = KNOWN.get((module, name)) if isinstance(module, str) and isinstance(name, str) else None
        if known is None:
            raise Refusal(f"the global {f'{module}.{name}'[:100]!r}")
        self.stack.append(known)

    def reduce(self, token: Any, arguments: Any) -> None:
        make = self.make
        calls: dict[Token, Callable[..., Any]] = {
            RECONSTRUCT: make.array,
            SCALAR: make.scalar,
            FROMBUFFER: make.buffer,
            DTYPE: make.dtype,
            ENCODE: make.encoded,
            NO_BYTES: lambda: b"",
            ORDERED_DICT: lambda: {},
        }
        if not isinstance(token, Token) or not isinstance(arguments, tuple):
            raise Refusal(f"a call of an object of type {type(token).__name__}")
        self.stack.append(calls[token](*arguments))

    def build(self, state: Any) -> None:
        target = self.stack[-1]
        if isinstance(target, PendingDtype) and isinstance(state, tuple):
            target.set_state(*state)
        elif isinstance(target, np.ndarray) and target.shape == (0,) and isinstance(state, tuple):
            self.make.fill(target, *state)
        else:
            raise Refusal(f"a state for an object of type {type(target).__name__}")

    def _top(self, kind: type) -> Any:
        if not isinstance(self.stack[-1], kind):
            raise Refusal(f"items for an object of type {type(self.stack[-1]).__name__}")
        return self.stack[-1]


ACTIONS = {
    "PROTO": _Machine.protocol,
    "FRAME": lambda machine, _: None,
    "MARK": lambda machine, _: machine.marks.append(len(machine.stack)),
    "POP": lambda machine, _: machine.pop(),
    "POP_MARK": lambda machine, _: machine.take_marked(),
    "DUP": lambda machine, _: machine.push(machine.stack[-1]),
    "MEMOIZE": lambda machine, _: machine.remember(len(machine.memo)),
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "LIST": lambda machine, _: machine.push(machine.take_marked()),
    "APPEND": lambda machine, _: machine.extend(machine.take(1)),
    "APPENDS": lambda machine, _: machine.extend(machine.take_marked()),
    "EMPTY_TUPLE": lambda machine, _: machine.push(()),
    "TUPLE": lambda machine, _: machine.push(tuple(machine.take_marked())),
    "TUPLE1": lambda machine, _: machine.push(tuple(machine.take(1))),
    "TUPLE2": lambda machine, _: machine.push(tuple(machine.take(2))),
    "TUPLE3": lambda machine, _: machine.push(tuple(machine.take(3))),
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "SETITEM": lambda machine, _: machine.set_items(machine.take(2)),
    "SETITEMS": lambda machine, _: machine.set_items(machine.take_marked()),
    "GLOBAL": lambda machine, words: machine.name(*words.split(" ", 1)),
    "STACK_GLOBAL": lambda machine, _: machine.name(*machine.take(2)),
    "REDUCE": lambda machine, _: machine.reduce(*machine.take(2)),
    "BUILD": lambda machine, _: machine.build(*machine.take(1)),
}
ACTIONS |= dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), lambda machine, index: machine.remember(int(index)))
ACTIONS |= dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda machine, i: machine.push(machine.memo[int(i)]))


def _dictionary(machine: _Machine, _: Any) -> None:
    items = machine.take_marked()
    machine.push({})
    machine.set_items(items)


ACTIONS["DICT"] = _dictionary
