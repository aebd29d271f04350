"""Pickles: plain data comes back as it was, everything else is refused, and nothing in a file ever runs."""

from __future__ import annotations

import os
import pickle
import struct
import sys
from collections import OrderedDict

import numpy as np
import pytest

from warpgarment.training.readers import PickleRefused, read_pickle, unpickle

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)


class Runs:
    """Runs a shell command when unpickled in the usual way."""

    def __init__(self, command: str):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def refused(path, data: bytes, match: str) -> None:
    path.write_bytes(data)
    with pytest.raises(PickleRefused, match=match):
        read_pickle(path)


def short_text(text: str) -> bytes:
    """The opcode SHORT_BINUNICODE."""
    return b"\x8c" + bytes([len(text)]) + text.encode()


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_plain_data_comes_back_as_python_wrote_it(tmp_path, protocol):
    """If this fails, arrays are read with other values, types or orders than were pickled, exactly."""
    cube = np.arange(24).reshape(2, 3, 4)
    arrays = [cube.astype(code) for code in ("?", "i1", "<i2", "<i4", ">i8", "u1", "<u2", "<u4", "<u8", "<f2", "<f8")]
    arrays += [cube.astype("<f4"), np.asfortranarray(cube.astype("<f4")), cube.astype(">f4"), cube[:, ::2].astype("f4")]
    arrays += [cube.transpose(1, 0, 2), cube[::-1], np.float32(2.5) * np.ones(()), np.zeros((3, 0, 3), np.float32)]
    arrays += [np.array(["a", "bcd"]), np.array([b"xy", b"z"])]
    plain = {
        "numbers": [1, -7, 2**40, -(2**70), 0.1, True, None, float("inf")],
        "text": ("a b", "ü€", b"\x00\xff", bytearray(b"ab"), ""),
        "nest": {"in": {3: [(), [], {}, (1, (2, (3, 4, 5, 6)))]}},
        "ordered": OrderedDict([("z", 1), ("a", 2)]),
        "scalars": [np.float64(0.1), np.int32(-3), np.bool_(True)],
    }
    path = tmp_path / "plain.pkl"
    path.write_bytes(pickle.dumps(plain | {"arrays": arrays, "again": arrays}, protocol=protocol))
    if protocol < 5:  # bytearray is a class call before protocol 5, and refused
        refused(path, path.read_bytes(), "bytearray")
        plain["text"] = plain["text"][:3]
        path.write_bytes(pickle.dumps(plain | {"arrays": arrays, "again": arrays}, protocol=protocol))
    read = read_pickle(path)
    assert {k: read[k] for k in ("numbers", "nest", "ordered", "scalars")} == {
        k: plain[k] for k in ("numbers", "nest", "ordered", "scalars")
    }
    assert read["text"] == plain["text"]
    assert [type(s) for s in read["scalars"]] == [np.float64, np.int32, np.bool_]
    assert read["again"][0] is read["arrays"][0] or protocol == 0 or read["again"] is read["arrays"]
    for before, after in zip(arrays, read["arrays"], strict=True):
        assert after.dtype.newbyteorder("=") == before.dtype.newbyteorder("=")  # NumPy may turn bytes round on reading
        np.testing.assert_array_equal(after, before)


def test_arrays_of_python_2_are_read(tmp_path):
    """If this fails, data sets pickled by Python 2 cannot be converted. The bytes are laid out by hand."""
    values = struct.pack("<4f", 1.0, -2.5, 3.0, 0.125)
    data = (
        b"\x80\x02}q\x00U\x08verticesq\x01cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x02K\x02\x86cnumpy\ndtype\nU\x02f4K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK"
        b"\x00tb\x89U\x10" + values + b"tbs."
    )
    path = tmp_path / "two.pkl"
    path.write_bytes(data)
    np.testing.assert_array_equal(read_pickle(path)["vertices"], [[1.0, -2.5], [3.0, 0.125]])


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("place", ["top", "value", "array", "key"])
def test_commands_in_pickles_do_not_run(tmp_path, protocol, place):
    """If this fails, opening a data set runs a command that somebody put into it."""
    marker = tmp_path / "ran"
    evil = Runs(f"touch {marker}")
    content = {
        "top": evil,
        "value": {"vertices": np.zeros((2, 3)), "conf": [evil]},
        "array": {"vertices": np.array([evil, None], dtype=object)},
        "key": {evil: 3},
    }[place]
    match = "array type of Python objects" if place == "array" else "system"
    refused(tmp_path / "evil.pkl", pickle.dumps(content, protocol=protocol), match)
    assert not marker.exists()
    pickle.loads(pickle.dumps(evil, protocol=protocol))  # the same bytes do run in the usual way
    assert marker.exists()


def test_the_refusal_names_the_global_and_its_place(tmp_path):
    """If this fails, a user cannot see what is wrong with a file, or is not told that nothing ran."""
    path = tmp_path / "eval.pkl"
    refused(path, b"\x80\x04}X\x01\x00\x00\x00acbuiltins\neval\n(Vprint(1)\ntRs.", r"builtins\.eval' at byte 9 refused")
    with pytest.raises(PickleRefused, match=r"nothing of the file was executed.*save it as \.npz"):
        read_pickle(path)


def test_nothing_is_imported(tmp_path, monkeypatch):
    """If this fails, a file can make Python import a module, which runs it."""
    marker = tmp_path / "imported"
    (tmp_path / "module_of_a_stranger.py").write_text(f"open({str(marker)!r}, 'w')\n")
    monkeypatch.syspath_prepend(tmp_path)
    refused(tmp_path / "a.pkl", b"cmodule_of_a_stranger\nx\n.", "global 'module_of_a_stranger.x' at byte 0")
    stacked = b"\x80\x04" + short_text("module_of_a_stranger") + short_text("x.y") + b"\x93."
    refused(tmp_path / "b.pkl", stacked, r"global 'module_of_a_stranger\.x\.y'")
    assert "module_of_a_stranger" not in sys.modules
    assert not marker.exists()


RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\n"
DTYPE = b"cnumpy\ndtype\n"


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"(Vecho\nios\nsystem\n.", "opcode INST"),
        (b"(cos\nsystem\nVecho\no.", "global 'os.system'"),
        (b"(cnumpy\nndarray\nK\x03o.", "opcode OBJ"),
        (b"\x80\x02cnumpy\nndarray\nK\x03\x85\x81.", "opcode NEWOBJ"),
        (b"\x80\x04cnumpy\nndarray\n)}\x92.", "opcode NEWOBJ_EX"),
        (b"\x80\x02\x82\x01.", "opcode EXT1"),
        (b"Pname\n.", "opcode PERSID"),
        (b"\x80\x05\x97.", "opcode NEXT_BUFFER"),
        (b"\x80\x04\x8f.", "opcode EMPTY_SET"),
        (b"cnumpy\nmatrix\n.", r"global 'numpy\.matrix'"),
        (b"cnumpy\nload\n.", r"global 'numpy\.load'"),
        (b"cnumpy.core.multiarray\nfromfile\n.", "fromfile"),
        (b"cbuiltins\ngetattr\n.", "getattr"),
        (RECONSTRUCT + DTYPE + b"K\x00\x85Vb\n\x87R.", "a subclass of numpy.ndarray"),
        (b"cnumpy\nndarray\nK\x03\x85R.", "a call of an object of type NdarrayToken"),
        (b"Vtext\nK\x03\x85R.", "a call of an object of type str"),
        (b"}}b.", "a state for an object of type dict"),
        (b"K\x05K\x06b.", "a state for an object of type int"),
        (DTYPE + b"VO8\n\x85R.", "array type of Python objects"),
        (DTYPE + b"Vf4,O\n\x85R.", "array type that is not plain"),
        (DTYPE + b"VV8\n\x85R.", "array type that is not plain"),
        (DTYPE + b"Vf4\n\x85R(K\x03V<\nVn\nNNtb.", "structured array type"),
        (b"c_codecs\nencode\nVa\nVrot13\n\x86R.", "_codecs.encode of something"),
        (b"]K\x01K\x02s.", "items for an object of type list"),
        (b"}K\x01\x85K\x02s.", "a dictionary key of type tuple"),
        (b"\x80\x09N.", "pickle protocol 9"),
    ],
)
def test_everything_else_is_refused_by_name(tmp_path, data, match):
    """If this fails, some opcode or global reaches further than plain data."""
    refused(tmp_path / "other.pkl", data, match)


def array_bytes(shape: bytes, data: bytes, code: bytes = b"u1") -> bytes:
    """A pickled array: `shape` and `data` are pieces of pickle that push a tuple and bytes."""
    dtype = DTYPE + b"V" + code + b"\n\x85R(K\x03V<\nNNNK\x00K\x00K\x00tb"
    return RECONSTRUCT + b"cnumpy\nndarray\nK\x00\x85Vb\n\x87R(K\x01" + shape + dtype + b"\x89" + data + b"tb"


def test_arrays_account_for_their_bytes(tmp_path):
    """If this fails, a shape makes a reader allocate memory that the file does not fill, or read past its end."""
    path, six = tmp_path / "array.pkl", b"C\x06" + bytes(range(6))
    path.write_bytes(array_bytes(b"K\x02K\x03\x86", six) + b".")
    np.testing.assert_array_equal(read_pickle(path), [[0, 1, 2], [3, 4, 5]])
    for shape in (b"K\x02K\x02\x86", b"J\xff\xff\xff\x7fJ\xff\xff\xff\x7f\x86", b"K\x07\x85"):
        refused(path, array_bytes(shape, six) + b".", r"shape \[.*\] and type uint8 with 6 bytes")
    for shape in (b"J\xff\xff\xff\xff\x85", b"V6\n\x85", b"N", b"(" + b"K\x01" * 9 + b"t"):
        refused(path, array_bytes(shape, six) + b".", "an array shape that is not one")
    refused(path, array_bytes(b"K\x06\x85", b"]") + b".", "an array of Python objects")


def test_bombs_do_not_go_off(tmp_path, monkeypatch):
    """If this fails, a small file fills memory or keeps the reader busy."""
    path = tmp_path / "bomb.pkl"
    text = b"V" + b"x" * 2_000_000 + b"\np0\n0"  # kept once, encoded or laid out over and over
    again = b"]" + b"c_codecs\nencode\ng0\nVlatin1\n\x86Ra" * 50
    refused(path, text + again + b".", "unfolds to many times the size of the file")
    data = b"B" + struct.pack("<I", 2_000_000) + bytes(2_000_000) + b"p0\n0"
    arrays = b"]" + (array_bytes(b"J\x80\x84\x1e\x00\x85", b"g0\n") + b"a") * 50
    refused(path, data + arrays + b".", "unfolds to many times the size of the file")
    refused(path, b"\x80\x04\x8e" + struct.pack("<Q", 1 << 40) + b"abc.", "not a readable pickle")
    refused(path, b"\x8b" + struct.pack("<i", 1000) + b"\x01" * 1000 + b".", "integer of 7,993 bits")
    monkeypatch.setattr(unpickle, "OPCODES", 1000)
    refused(path, b"(" * 2000 + b".", "more than 1,000 opcodes")
    monkeypatch.setattr(unpickle, "LARGEST", 1000)
    refused(path, b"N" * 1001 + b".", "more than 1,000 are not read")


def test_nests_are_read_without_being_walked(tmp_path):
    """If this fails, deep or self-similar nests overflow the stack or take for ever."""
    path = tmp_path / "nest.pkl"
    path.write_bytes(b"\x80\x02" + b"]" * 20_000 + b"a" * 19_999 + b".")
    assert len(read_pickle(path)) == 1
    laughs = b"\x80\x02]q\x00" + b"".join(
        b"](" + b"h" + bytes([n]) + (b"h" + bytes([n])) * 9 + b"eq" + bytes([n + 1]) for n in range(40)
    )  # forty levels of ten references: 10^40 leaves
    path.write_bytes(b"\x80\x02(" + laughs[2:] + b"l.")
    assert len(read_pickle(path)) == 41
    path.write_bytes(b"\x80\x02Nr\xff\xff\xff\x7f.")  # place 2^31 - 1 of the memo
    assert read_pickle(path) is None


def test_damaged_pickles_are_named(tmp_path):
    """If this fails, a file cut short is reported as something else, or read as whole."""
    path = tmp_path / "cut.pkl"
    whole = pickle.dumps({"vertices": np.zeros((20, 3), np.float32)}, protocol=4)
    for data in (b"", whole[:30], whole[:-1], b"hello there", b"\x80\x04N0.", b"NN.", b"h\x05.", b"\x80\x04(a."):
        refused(path, data, "not a readable pickle.*damaged, cut short, or of another kind")
