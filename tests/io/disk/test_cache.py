"""If these failed, a stale or damaged file would pass for a garment's distances, or two processes would spoil one."""

import os
import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest
from support.surfaces import skirt

from warpgarment.io.disk import cache
from warpgarment.objects.garment import Garment

EXPECTED = {"a": ("float32", (3, None))}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPGARMENT_CACHE", str(tmp_path))
    monkeypatch.delenv(cache.OFF, raising=False)
    return tmp_path


class Counted:
    """Makes an array, and counts how often it was asked to."""

    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"a": np.arange(6, dtype=np.float32).reshape(3, 2)}


def ask(compute, *inputs):
    found = cache.remembered("kind-1", [np.arange(4), *inputs], EXPECTED, compute)
    np.testing.assert_array_equal(found["a"], [[0, 1], [2, 3], [4, 5]])


def test_tests_have_a_cache_of_their_own():
    """Garments of tests would fill the cache of whoever runs them."""
    assert cache.cache_folder().parent == Path(tempfile.gettempdir())
    assert cache.cache_folder().is_dir()
    assert os.environ["WARPGARMENT_CACHE"] == str(cache.cache_folder())  # what processes inherit


def test_hit_miss_and_off(folder, monkeypatch):
    """The same would be computed twice, other inputs would get it too, or the switch would not work."""
    compute = Counted()
    ask(compute, 0.5)
    ask(compute, 0.5)
    assert compute.calls == 1
    ask(compute, 0.25)
    assert compute.calls == 2
    assert len(list(folder.iterdir())) == 2
    monkeypatch.setenv(cache.OFF, "1")
    ask(compute, 0.5)
    assert compute.calls == 3


@pytest.mark.parametrize("damage", ["flipped", "cut", "empty", "text", "foreign"])
def test_damaged_and_foreign_files_are_written_again(folder, damage):
    """A flipped bit would move cloth; a file cut short would stop the program, each time again."""
    compute = Counted()
    ask(compute)
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    if damage == "foreign":
        cache.save_file({"a": np.zeros((2, 2), np.float32)}, path)
    else:
        flipped = whole[:-5] + bytes([whole[-5] ^ 1]) + whole[-4:]
        path.write_bytes({"flipped": flipped, "cut": whole[:-3], "empty": b"", "text": b"not a tensor"}[damage])
    ask(compute)
    assert compute.calls == 2
    assert path.read_bytes() == whole
    ask(compute)
    assert compute.calls == 2


def test_a_flipped_bit_anywhere_is_noticed(folder):
    """One bit of the file is another, in its header, its checksum or its numbers, and other distances come out. Every
    bit of a file in turn."""
    ask(Counted())
    (path,) = folder.iterdir()
    whole, noticed = path.read_bytes(), 0
    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        found = cache._read(path, EXPECTED)
        noticed += found is None
        assert found is None or np.array_equal(found["a"], [[0, 1], [2, 3], [4, 5]]), f"bit {bit}"
    assert noticed >= 8 * 24, "every bit of the numbers, at least"


def test_writers_at_the_same_time(folder):
    """Two processes would leave half a file each: all compute at once, and one whole file is left."""
    gate, compute = threading.Barrier(8), Counted()

    def slow():
        gate.wait(timeout=20)
        return compute()

    threads = [threading.Thread(target=ask, args=(slow,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert compute.calls == 8
    assert len(list(folder.iterdir())) == 1
    ask(compute)
    assert compute.calls == 8


def test_old_files_go_when_there_are_too_many(folder, monkeypatch):
    """The folder would grow without end. Another kind of file stays."""
    (folder / "other.txt").write_text("mine")
    monkeypatch.setattr(cache, "TOTAL", 1)
    for value in range(3):
        ask(Counted(), value)
    assert sorted(path.suffix for path in folder.iterdir()) == [".safetensors", ".txt"]


def test_a_folder_that_cannot_be_written_to_is_no_error(folder, monkeypatch):
    """A read-only home would stop a simulation for the sake of a cache."""
    (folder / "file").write_text("")
    monkeypatch.setenv("WARPGARMENT_CACHE", str(folder / "file"))
    ask(Counted())


def test_garments_keep_their_distances_on_disk(folder, monkeypatch):
    """Distances would be searched for again at each start, or a garment given those of another."""
    monkeypatch.setattr("warpgarment.objects.garment.KEPT", 50)
    vertices, faces = skirt(12, 5, None)
    first, again, moved = Garment(vertices, faces), Garment(vertices, faces), Garment(vertices * 2, faces)
    distances, pooled = first.geodesics, first.pooled_geodesics
    with monkeypatch.context() as patch:
        for name in ("geodesics.face_geodesics", "pooled_geodesics.pooled_geodesics"):
            patch.setattr(f"warpgarment.geometry.{name}", lambda *_: pytest.fail("computed again"))
        np.testing.assert_array_equal(again.geodesics, distances)
        for a, b in zip(again.pooled_geodesics, pooled, strict=True):
            np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(moved.geodesics, 2 * distances, rtol=1e-5)


def test_a_full_disk_is_no_error(folder):
    """A disk without room would stop a simulation for the sake of a cache: the writer's own error is no OSError."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40, before[1]))
    try:
        ask(Counted())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(folder.iterdir()) == []
