"""Files of strangers: only plain ones are opened, and names in them stay in their folder."""

from __future__ import annotations

import os
import tracemalloc

import pytest

from warpgarment.errors import MeshError
from warpgarment.io.disk.plain import JSON_DEEPEST, JSON_LARGEST, below, open_plain, read_json, read_plain


def test_not_plain(tmp_path):
    """A pipe would be waited for, for ever, and a folder would end in an error of Python."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name, message in (("pipe", "is a pipe"), ("folder", "is a folder")):
        with pytest.raises(MeshError, match=message):
            open_plain(tmp_path / name)
    with pytest.raises(MeshError, match="a device or socket"):
        open_plain("/dev/null")
    with pytest.raises(FileNotFoundError):
        open_plain(tmp_path / "absent")


def test_large_json_is_not_read(tmp_path):
    """Gigabytes of a sparse file would be read."""
    with open(tmp_path / "a.json", "wb") as file:
        file.truncate(3 << 30)
    with pytest.raises(MeshError, match=f"3,221,225,472 bytes.* {JSON_LARGEST:,} at most"):
        read_json(tmp_path / "a.json")


def test_a_hole_is_no_text(tmp_path):
    """A sparse file under the name of a text would be read into gigabytes of zeros; they are found in the first."""
    with open(tmp_path / "a.obj", "wb") as file:
        file.write(b"v 0 0 0\n")
        file.truncate(2 << 30)
    tracemalloc.start()
    with pytest.raises(MeshError, match=r"a\.obj: binary data"):
        read_plain(tmp_path / "a.obj", text=True)
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()
    with pytest.raises(MeshError, match="2,147,483,648 bytes"):
        read_plain(tmp_path / "a.obj", 1 << 20)


@pytest.mark.parametrize("depth", [JSON_DEEPEST + 1, 900, 200_000])
def test_deep_json(tmp_path, depth):
    """Deep nesting would be a RecursionError, here or in whoever writes it again."""
    (tmp_path / "a.json").write_text('{"a":' * depth + "1" + "}" * depth)
    with pytest.raises(MeshError, match=f"nested more than {JSON_DEEPEST} deep"):
        read_json(tmp_path / "a.json")
    (tmp_path / "a.json").write_text("[" * JSON_DEEPEST + "]" * JSON_DEEPEST)
    assert isinstance(read_json(tmp_path / "a.json"), list)


def test_no_json(tmp_path):
    """A damaged file would be an error of Python's decoder."""
    for data in (b"{", b"\xff\xfe{", b"", b'{"a": ' + b"9" * 5000 + b"}"):
        (tmp_path / "a.json").write_bytes(data)
        with pytest.raises(MeshError, match=r"a\.json is not JSON"):
            read_json(tmp_path / "a.json")


def test_names_stay_in_their_folder(tmp_path):
    """A file elsewhere on the disk would be read because another file names it."""
    (tmp_path / "set" / "clips").mkdir(parents=True)
    (tmp_path / "secret.txt").write_text("x")
    (tmp_path / "set" / "clips" / "walk.txt").write_text("x")
    (tmp_path / "set" / "out").symlink_to(tmp_path)
    (tmp_path / "set" / "clips" / "same.txt").symlink_to("walk.txt")
    root = tmp_path / "set"
    for name in ("clips/walk.txt", "clips/../clips/walk.txt", "clips/same.txt"):
        assert below(root, name, "meta: clip") == (root / "clips" / "walk.txt").resolve()
    refused = (
        "../secret.txt",
        "clips/../../secret.txt",
        str(tmp_path / "secret.txt"),
        "out/secret.txt",
        "C:/secret.txt",
    )
    for name in (*refused, "a" * 300, "a/" * 3000, "", None, ["clips"], "a\0b"):
        with pytest.raises(MeshError, match=r"^meta: clip"):
            below(root, name, "meta: clip")
